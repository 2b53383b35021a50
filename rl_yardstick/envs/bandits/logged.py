"""Logged pulls in a CSV file, and replay of policies on them.

Each row is one pull, under a header with the columns ``arm``, ``reward`` and, if known,
``propensity``, the probability that the arm was chosen. All other columns are the context.
"""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, BinaryIO

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from rl_yardstick.envs.bandits.bandit import MAX_ARMS, Bandit
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.safe_files.files import UnsafeFileError, opened

if TYPE_CHECKING:
    import pandas as pd

ARM, REWARD, PROPENSITY = "arm", "reward", "propensity"

MAX_BYTES = 1 << 30
# An arm's linear model of the context needs the square of this in numbers.
MAX_COLUMNS = 1000
# Bounds within which squares of numbers, and the weights of rare pulls, stay usable.
MAX_NUMBER, MIN_PROPENSITY = 1e15, 1e-9
NUMBER = "a finite number of no more than 1e15"


# The valid values of a column: in words, and as a check of numbers.
_CONTEXT = f"{NUMBER}: text can only be all of the context", np.isfinite
_WANTED: Mapping[str, tuple[str, Callable[[Floats], Bools]]] = {
    ARM: (
        f"a whole number from 0 to {MAX_ARMS - 1}",
        lambda values: (values >= 0) & (values < MAX_ARMS) & (values == np.floor(values)),
    ),
    REWARD: (NUMBER, np.isfinite),
    PROPENSITY: (
        f"a probability from {MIN_PROPENSITY} to 1",
        lambda values: (values >= MIN_PROPENSITY) & (values <= 1),
    ),
}


def some(names: Sequence[str]) -> str:
    """The first of some names, as a message lists them."""
    text = ", ".join(names[:12])
    return text if len(names) <= 12 else f"{text} and {len(names) - 12:,} more"


@dataclass(frozen=True, eq=False)
class LoggedData:
    """Logged pulls, in the order of the file."""

    source: str  # the file, for messages
    context_names: tuple[str, ...]  # the columns that make up the context, d of them
    contexts: Floats  # before each pull, shape (n, d); text is given as its index in `categories`
    arms: Ints  # shape (n,)
    rewards: Floats  # shape (n,)
    propensities: Floats | None  # the probability that each arm was chosen, shape (n,)
    categories: tuple[str, ...] | None = None  # the values of a context of text, in order

    def __len__(self) -> int:
        return len(self.arms)

    @property
    def n_arms(self) -> int:
        """One more than the highest arm that was pulled."""
        return int(self.arms.max()) + 1

    @property
    def observation_space(self) -> spaces.Space[Any]:
        """The space of the contexts: Discrete as `ReplayBandit` says, or a Box within bounds."""
        if not self.context_names:
            return spaces.Discrete(1)
        if self.categories is not None:
            return spaces.Discrete(len(self.categories))
        if len(self.context_names) == 1:
            values = np.unique(self.contexts)
            if np.array_equal(values, np.arange(len(values))):
                return spaces.Discrete(len(values))
        rounded = self.contexts.astype(np.float32)
        return spaces.Box(rounded.min(axis=0), rounded.max(axis=0), dtype=np.float32)

    def observations(self, space: spaces.Space[Any]) -> NDArray[Any]:
        """The contexts as observations in a given observation space.

        Shape (n,) for Discrete, (n, d) for a Box; a ValueError if they do not fit.
        """
        n_columns = len(self.context_names)
        if isinstance(space, spaces.Box) and space.shape == (n_columns,) and not self.categories:
            return self.contexts.astype(np.float32)
        if isinstance(space, spaces.Discrete):
            codes = self.contexts.astype(np.int64)
            if space.n == 1 and not n_columns:
                return np.zeros(len(self), np.int64)
            n_words = len(self.categories or ())
            fits = n_columns == 1 and np.array_equal(codes, self.contexts)
            if fits and n_words in {0, space.n} and codes.min() >= 0 and codes.max() < space.n:
                return codes[:, 0]
        context = f"the context {some(self.context_names)}" if n_columns else "no context"
        words = "" if self.categories is None else f" with {len(self.categories)} values of text"
        raise ValueError(f"{self.source} has {context}{words}, the agent observes {space}")


def read_log(path: str | Path, own_names: Mapping[str, str] = MappingProxyType({})) -> LoggedData:
    """Read logged pulls.

    Args:
        path: a CSV file, separated by commas, with a header; see the module.
        own_names: the file's own names of the columns ``arm``, ``reward`` and ``propensity``.

    Raises:
        ValueError: if it cannot be read, a column is missing or duplicated, a row is too short or
            too long, an arm is not a whole number from 0, a number not finite or beyond 1e15, or a
            propensity not from 1e-9 to 1. The message names file and row.
    """
    try:
        with opened(Path(path), MAX_BYTES) as binary:
            found = _read_columns(binary, own_names)
    except (OSError, UnsafeFileError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error).strip()
        raise ValueError(f"cannot read {path}: {reason}") from error
    names = tuple(name for name in found if name not in _WANTED)
    categories = None
    if len(names) == 1 and np.isnan(_as_numbers(found[names[0]])).all():
        text = found[names[0]].astype("category")
        categories, found[names[0]] = tuple(text.cat.categories), text.cat.codes
    columns = {name: _numbers(str(path), name, column) for name, column in found.items()}
    contexts = [columns[name] for name in names]
    return LoggedData(
        source=str(path),
        context_names=names,
        contexts=np.stack(contexts, axis=1) if names else np.empty((len(columns[ARM]), 0)),
        arms=columns[ARM].astype(np.int64),
        rewards=columns[REWARD],
        propensities=columns.get(PROPENSITY),
        categories=categories,
    )


def _read_columns(binary: BinaryIO, own_names: Mapping[str, str]) -> dict[str, pd.Series[Any]]:
    """The columns of a log by name, each of numbers or of text."""
    import pandas as pd

    settings: Any = {
        "encoding": "utf-8-sig",
        "skipinitialspace": True,
        "keep_default_na": False,
        "low_memory": False,
    }
    header = pd.read_csv(binary, header=None, nrows=1, dtype=str, **settings).iloc[0].tolist()
    if len(header) > MAX_COLUMNS:
        raise ValueError(f"it has {len(header):,} columns, more than {MAX_COLUMNS:,}")
    meant = {own: name for name, own in own_names.items()}
    header = [meant.get(name, name) for name in header]
    for name in (ARM, REWARD, *header):
        if header.count(name) != 1:
            number = "no" if name not in header else "more than one"
            raise ValueError(f"it has {number} column {name!r}, but {some(header)}")
    binary.seek(0)
    frame = pd.read_csv(binary, **settings).rename(columns=meant)
    if not isinstance(frame.index, pd.RangeIndex):
        raise ValueError("its rows have more values than its header")
    if not len(frame):
        raise ValueError("it holds no pulls: a header and a row for each are needed")
    columns = {name: frame.iloc[:, i] for i, name in enumerate(header)}
    if not header[0] and columns[""].tolist() == list(range(len(frame))):
        warnings.warn("the log's first column, which counts the rows, is left out", stacklevel=2)
        del columns[""]
    return {
        name: column if column.dtype.kind in "if" else column.astype(str).str.strip()
        for name, column in columns.items()
    }


def _as_numbers(column: pd.Series[Any]) -> Floats:
    """The values of a column, shape (n,); NaN for text."""
    import pandas as pd

    values: Floats = pd.to_numeric(column, errors="coerce").to_numpy(np.float64)
    return values


def _numbers(source: str, name: str, column: pd.Series[Any]) -> Floats:
    """The values of a column, shape (n,); ValueError for the first one that is invalid."""
    values = _as_numbers(column)
    wanted, valid = _WANTED.get(name, _CONTEXT)
    wrong = np.flatnonzero(~((np.abs(values) <= MAX_NUMBER) & valid(values)))
    if len(wrong):
        text = str(column.iloc[wrong[0]])
        shown = text if len(text) <= 60 else f"{text[:60]}..."
        raise ValueError(f"{source}, row {wrong[0] + 1}: {name} is {shown!r}, it must be {wanted}")
    return values


def log_uniformly(env: gym.Env[Any, Any], n: int, seed: int, path: str | Path) -> None:
    """Pull arms uniformly at random, and write the log for `read_log`.

    Args:
        env: a bandit as `gymnasium.make` returns it; its observations are Discrete, or a Box of
            one axis.
        n: the number of pulls; episodes follow each other where one is too short.
        seed: the seed of the environment and of the arms.
        path: the file to write.
    """
    assert isinstance(env.action_space, spaces.Discrete)
    n_arms = int(env.action_space.n)
    # A separate stream: the environment uses that of the seed itself.
    arms = np.random.default_rng([seed, 1]).integers(n_arms, size=n).tolist()
    space = env.observation_space
    if isinstance(space, spaces.Discrete):
        names = ["context"] if space.n > 1 else []
    else:
        assert isinstance(space, spaces.Box)
        names = [f"feature_{i}" for i in range(space.shape[0])]
    context, _ = env.reset(seed=seed)
    with Path(path).open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*names, ARM, REWARD, PROPENSITY])
        for arm in arms:
            shown = np.ravel(context).tolist()[: len(names)]
            context, reward, terminated, truncated, _ = env.step(arm)
            writer.writerow([*shown, arm, reward, 1 / n_arms])
            if terminated or truncated:
                context, _ = env.reset()


# The relative tolerance between a propensity and 1 / n_arms: files hold rounded numbers.
TOLERANCE = 0.02


class ReplayBandit(Bandit):
    """Replay of logged pulls, of which only those of the same arm count.

    ## Description
    What would another policy have earned on the users of a log? If the log chose its arms uniformly
    at random, replay answers without bias: go through the log, let the policy choose for each
    context, and count the rows where it chooses the logged arm, because only there the reward is
    known (Li, Chu, Langford and Wang, "Unbiased offline evaluation of contextual-bandit-based news
    article recommendation algorithms", 2011). About one row in `n_arms` counts. The policy's mean
    reward is estimated by the return divided by `matched_pulls`.

    ## Action Space
    `Discrete(n_arms)`: the arm to pull; the propensities determine their number.

    ## Observation Space
    `Discrete(1)` if the log has no context; `Discrete(n)` if its context is one column of text, or
    one that holds every whole number from 0 to n - 1; else `Box` with a float32 for each column.
    Text is numbered in alphabetical order.

    ## Rewards
    The logged reward where the arm is the logged one; otherwise 0.

    ## Starting State
    The context of the first row.

    ## Episode End
    The episode is truncated after the last row, or after `max_episode_steps` where that is given
    to `gymnasium.make`.

    ## Information
    `step` gives `matched`, whether the arm was the logged one; `matched_pulls`, how often that has
    been so in this episode; and `feedback_due`, always True. `reset` gives nothing. The best arm is
    not known, so there is no regret.

    If `matched` is False, the reward is unknown, and an agent must not learn from it. The bandit
    agents skip it. Other agents, such as DQN, learn from the reward of 0. With uniform logging this
    divides their estimate for each arm by `n_arms`, and does not change the order of the arms. No
    random numbers are drawn.

    ## Arguments
    - `log`: the path to a CSV file with the columns `arm`, `reward` and `propensity`, and one for
      each part of the context; see `envs.bandits.logged`. Every propensity must be one in
      `n_arms`, within 2 %.
    - `render_mode=None`: `"ansi"`, `"rgb_array"` or `"human"`
    """

    kind = "replay"

    def __init__(self, log: str | Path | None = None, render_mode: str | None = None) -> None:
        if not isinstance(log, str | Path):
            raise ValueError(f"log must be the path to a CSV file of logged pulls, not {log!r}")
        data = read_log(log)
        n_arms = _number_of_arms(data)
        super().__init__(n_arms, data.observation_space, pulls=len(data), render_mode=render_mode)
        self.data = data
        observations = data.observations(data.observation_space)
        self._contexts = observations.tolist() if observations.ndim == 1 else list(observations)
        self.matched_pulls = 0
        self.context = self._contexts[0]

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Choose an arm for the context of the present row.

        Raises:
            ValueError: if there is no such arm, or no row left.
        """
        arm, row = self._checked(action), self.pulls_done
        if row == self.pulls:
            raise ValueError(f"{self.data.source} has {self.pulls} rows: call reset after the last")
        self.pulls_done += 1
        matched = arm == int(self.data.arms[row])
        self.matched_pulls += matched
        reward = float(self.data.rewards[row]) if matched else 0.0
        before = self.context
        # After the last row there is no next context: the context stays.
        self.context = self._contexts[min(self.pulls_done, self.pulls - 1)]
        info = {
            "matched": matched,
            "matched_pulls": self.matched_pulls,
            "feedback_due": True,
        }
        if matched:
            self._show_pull(before, arm, reward)
        return self.context, reward, False, self.pulls_done == self.pulls, info

    def _begin(self) -> None:
        self.matched_pulls = 0
        self.context = self._contexts[0]


def _number_of_arms(data: LoggedData) -> int:
    """The number of arms of a uniform log; ValueError if it is not uniform, or does not say."""
    if data.propensities is None:
        raise ValueError(
            f"{data.source} has no column 'propensity': replay needs one, each value the "
            "probability with which the arm was chosen"
        )
    n_arms = max(data.n_arms, round(1 / float(np.median(data.propensities))), 2)
    wrong = np.flatnonzero(np.abs(data.propensities * n_arms - 1) > TOLERANCE)
    if len(wrong):
        raise ValueError(
            f"{data.source} did not choose among its {n_arms} arms uniformly: the propensity of "
            f"pull {wrong[0] + 1} is {data.propensities[wrong[0]]:g}, not {1 / n_arms:.4g}; use "
            f"inverse propensities instead: compare --logged {data.source} --policy RUN"
        )
    return n_arms
