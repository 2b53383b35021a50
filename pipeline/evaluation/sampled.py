"""How good an agent is: played on the environment as it is, never on a training variant of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

from mdp.array_types import Floats
from pipeline.evaluation.mask_telling import player
from pipeline.finite_numbers import FinitePlayer, check_numbers

# The agents of these packages take any number of observations at once.
KNOWN_LIBRARIES = ("agents", "stable_baselines3")


# Where nothing that an agent does makes a difference, sums may differ by this much.
ROUNDING = 1e-12

# By so many standard errors a mean is above what no policy exceeds only where something is wrong.
BEYOND_CHANCE = 6.0
# Of fewer episodes that cannot be said: all of them may have begun where returns are high.
FEWEST_TO_TELL = 10


@dataclass(frozen=True)
class Yardstick:
    """What returns on an environment are measured against.

    Attributes:
        optimum: the highest expected return that any policy has under the time limit. Where that
            is not known, a return that no policy exceeds.
        baseline: the highest of uniformly random actions and of each constant action.
        at_least: where the optimum is not known, a return that a policy was seen to reach: the
            optimum is bracketed by the two. None where it is known.
    """

    optimum: float
    baseline: float
    at_least: float | None = None

    def gap(self, expected_return: float) -> float:
        """How far a return stays behind the optimum, or of a bracket behind its upper end."""
        return self.optimum - expected_return

    def score(self, expected_return: float) -> float:
        """The return on a scale where 1 is the optimum and 0 the best random or constant policy.

        Of a bracket it is measured by the upper end: between 0 and 1 it never says too much.
        """
        rounding = ROUNDING * max(1.0, abs(self.optimum))
        if self.optimum - self.baseline <= rounding:
            return 1.0 if expected_return >= self.optimum - rounding else 0.0
        return (expected_return - self.baseline) / (self.optimum - self.baseline)

    @property
    def lower_end(self) -> Yardstick:
        """What measures by the lower end of a bracket; of a known optimum the same."""
        return self if self.at_least is None else Yardstick(self.at_least, self.baseline)

    def figures(self, expected_return: float) -> dict[str, float]:
        """How a return measures, as JSON; of a bracket by both of its ends."""
        found = {
            "optimum": self.optimum,
            "baseline": self.baseline,
            "gap": self.gap(expected_return),
            "score": self.score(expected_return),
        }
        if self.at_least is not None:
            found |= {
                "optimum_at_least": self.at_least,
                "gap_at_least": self.lower_end.gap(expected_return),
                "score_at_most": self.lower_end.score(expected_return),
            }
        return found


@dataclass(frozen=True)
class Evaluation:
    """How good an agent is: episodes that it has played, or their exact expectation.

    Attributes:
        returns: undiscounted return of each episode, shape (n_episodes,); the expected return,
            shape (1,), where that is exact.
        lengths: number of steps, likewise.
        successes: whether each episode succeeded, or the probability of it, likewise; None where
            the environment does not say.
        exact_std: standard deviation of an episode's return, where it is exact; None where
            episodes were sampled.
        yardstick: what to measure the return against, where it is known.
    """

    returns: Floats
    lengths: NDArray[np.floating[Any] | np.integer[Any]]
    successes: NDArray[np.bool_ | np.floating[Any]] | None
    exact_std: float | None = None
    yardstick: Yardstick | None = None

    @property
    def is_exact(self) -> bool:
        """Whether the figures are expectations, computed rather than sampled."""
        return self.exact_std is not None

    @cached_property
    def mean_return(self) -> float:
        """Mean of the returns."""
        return float(self.returns.mean())

    @cached_property
    def mean_length(self) -> float:
        """Mean number of steps of an episode."""
        return float(self.lengths.mean())

    @cached_property
    def std_return(self) -> float:
        """Standard deviation of an episode's return."""
        return float(self.returns.std()) if self.exact_std is None else self.exact_std

    @cached_property
    def success_rate(self) -> float | None:
        """Share of the episodes that succeed, if the environment says so."""
        return None if self.successes is None else float(self.successes.mean())

    @property
    def beats_optimum(self) -> bool:
        """Whether the mean is above what no policy exceeds, by more than chance can explain.

        Then the environment is not the one that the bracket is of, or the bracket is wrong.
        """
        if self.yardstick is None or self.yardstick.at_least is None:
            return False
        if len(self.returns) < FEWEST_TO_TELL:
            return False
        error = self.std_return / math.sqrt(len(self.returns) - 1)
        # Monitor rounds returns to six digits.
        return self.mean_return - BEYOND_CHANCE * error > self.yardstick.optimum + 1e-6

    def measured_by(self, yardstick: Yardstick | None) -> Evaluation:
        """The same figures, with what to measure them against."""
        return replace(self, yardstick=yardstick)

    def joined(self, more: Evaluation) -> Evaluation:
        """These episodes and further ones of the same agent, all of them sampled."""
        both = None
        if self.successes is not None and more.successes is not None:
            both = np.concatenate([self.successes, more.successes])
        returns = np.concatenate([self.returns, more.returns])
        return Evaluation(returns, np.concatenate([self.lengths, more.lengths]), both)

    def summary(self) -> dict[str, Any]:
        """The figures as JSON."""
        figures: dict[str, Any] = {
            "mean_return": self.mean_return,
            "std_return": self.std_return,
            "mean_length": self.mean_length,
            "success_rate": self.success_rate,
            "exact": self.is_exact,
            "n_episodes": None if self.is_exact else len(self.returns),
        }
        if self.yardstick is not None:
            figures |= self.yardstick.figures(self.mean_return)
        if self.beats_optimum:
            figures["beats_optimum"] = True
        return figures


def evaluate(
    model: BaseAlgorithm, env: VecEnv, n_episodes: int, seed: int | None, deterministic: bool = True
) -> Evaluation:
    """Play ``n_episodes``, the same ones each time that ``seed`` is the same.

    Args:
        model: the agent.
        env: environments to play on, with a time limit.
        n_episodes: how many episodes, shared evenly between the environments.
        seed: of the environments; None to go on with the episodes that come next.
        deterministic: play the policy's best action rather than sample one.

    Raises:
        NotFiniteError: if an observation or a return is not finite.
    """
    successes: list[bool] = []

    def note_success(local: dict[str, Any], _: dict[str, Any]) -> None:
        if local["done"] and "is_success" in local["info"]:
            successes.append(bool(local["info"]["is_success"]))

    # Others that play have no count of their own.
    when = f"in the evaluation at step {getattr(model, 'num_timesteps', 0):,}"
    if seed is not None:
        env.seed(seed)
    watched: Any = FinitePlayer(player(model, env), when)
    returns, lengths = evaluate_policy(
        watched,
        env,
        n_eval_episodes=n_episodes,
        deterministic=deterministic,
        return_episode_rewards=True,
        callback=note_success,
        warn=False,
    )
    check_numbers(returns, "return", when)
    return Evaluation(
        np.asarray(returns, dtype=np.float64),
        np.asarray(lengths, dtype=np.int64),
        np.array(successes) if len(successes) == n_episodes else None,
    )


def takes_batches(model: BaseAlgorithm) -> bool:
    """Whether an agent can be asked for the actions of several environments at once."""
    if type(model).__module__.partition(".")[0] in KNOWN_LIBRARIES:
        return True
    sample: Any = model.observation_space.sample()
    try:
        if isinstance(sample, dict):
            twice: Any = {name: np.stack([part, part]) for name, part in sample.items()}
        else:
            twice = np.stack([sample, sample])
        actions, _ = model.predict(twice, deterministic=True)
    except Exception:  # noqa: BLE001  # a stranger's code can fail in any way
        return False
    return len(np.atleast_1d(actions)) == 2


def evaluation_seed(seed: int, purpose: int) -> int:
    """A seed for evaluations that lies apart from training's and from other purposes'.

    Args:
        seed: the run's seed.
        purpose: 1 during training, 2 at its end, 3 when playing.
    """
    stream = np.random.SeedSequence(seed, spawn_key=(purpose,))
    return int(stream.generate_state(1)[0] % 2**31)
