"""Ratings: exact returns, on the scale from the baseline to the optimum, with what explains them.

`rate` is for Python; `rated_file` is what the command does with each file.
"""

from __future__ import annotations

import html
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl_yardstick import mdp
from rl_yardstick.diagnosis.explanation import Explanation, explanation_of_policy
from rl_yardstick.mdp.transition_model import Bools, Floats, TransitionModel
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation, Yardstick
from rl_yardstick.rating.tables import Table, as_table, environment_in, tables_in
from rl_yardstick.rating.worlds import SEED, Env, World, world_of
from rl_yardstick.safe_files.files import UnsafeFileError
from rl_yardstick.safe_files.tables import read_table_file

# Another order of actions, or another slipperiness, is worth a line if a table that scores less
# than POOR scores at least GOOD with it, and MUCH_BETTER than without.
POOR, GOOD, MUCH_BETTER = 0.9, 0.5, 0.3
MOST_ACTIONS_ORDERED, MOST_OUTCOMES_ORDERED = 6, 3_000_000_000
MOST_OUTCOMES_OF_TIES = 1_000_000_000
MODELS = (".zip",)


@dataclass(frozen=True)
class Ties:
    """The states in which several actions have the highest value."""

    n_states: int  #: among those that can be reached
    n_met: int  #: among those that the policy of first indices meets
    #: the lowest and the highest return over all ways to break ties; None if not computed
    least: float | None = None
    most: float | None = None


@dataclass(frozen=True, eq=False)
class Rating:
    """How good something is on an environment."""

    name: str  #: what was rated
    environment: str
    evaluation: Evaluation  #: exact where the model is known; else of sampled episodes
    notes: tuple[str, ...] = ()  #: what to know about it, the most important first
    ties: Ties | None = None  #: of a table of values, where the model is known
    never_updated: tuple[int, int] | None = None  #: states met, and others, with equal values
    explanation: Explanation | None = None  #: where it loses
    map: tuple[str, ...] = ()  #: a grid world with the actions that it takes

    @property
    def mean_return(self) -> float:
        """The expected return of an episode, or the mean of those sampled."""
        return self.evaluation.mean_return

    @property
    def yardstick(self) -> Yardstick | None:
        """The scale of returns, where the optimum is known or bracketed."""
        return self.evaluation.yardstick

    @property
    def optimum(self) -> float | None:
        """The highest expected return of any policy, or an upper bound; None if unknown."""
        return None if self.yardstick is None else self.yardstick.optimum

    @property
    def score(self) -> float | None:
        """1 at the optimum, 0 at the best random or constant policy; None if unknown."""
        return None if self.yardstick is None else self.yardstick.score(self.mean_return)

    @property
    def success_rate(self) -> float | None:
        """The share of successful episodes, if there is such a thing."""
        return self.evaluation.success_rate

    def as_data(self) -> dict[str, Any]:
        """The rating as JSON."""
        found: dict[str, Any] = {"name": self.name, "environment": self.environment}
        found |= self.evaluation.summary()
        found |= {"ties": None if self.ties is None else vars(self.ties)}
        met, elsewhere = (None, None) if self.never_updated is None else self.never_updated
        found |= {"never_updated_met": met, "never_updated_elsewhere": elsewhere}
        why = None if self.explanation is None else self.explanation.as_data()
        return {**found, "notes": self.notes, "map": self.map, "explanation": why}

    def __str__(self) -> str:
        told = [f"{name} {number:.4g}" for name, number in self._figures()]
        lines = [f"{self.name} on {self.environment}: {', '.join(told)}", *self.notes, *self.map]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        heads = "".join(f"<th>{name}</th>" for name, _ in self._figures())
        cells = "".join(f"<td>{number:.4g}</td>" for _, number in self._figures())
        notes = "".join(f"<li>{html.escape(note)}</li>" for note in self.notes)
        drawn = html.escape("\n".join(self.map))
        title = html.escape(f"{self.name} on {self.environment}")
        return (
            f"<table><caption>{title}</caption><tr>{heads}</tr><tr>{cells}</tr></table>"
            f"<ul>{notes}</ul><pre>{drawn}</pre>"
        )

    def _figures(self) -> Iterator[tuple[str, float]]:
        yield "return", self.mean_return
        others = ("optimum", self.optimum), ("score", self.score), ("success", self.success_rate)
        yield from ((name, number) for name, number in others if number is not None)


# --- tables ---------------------------------------------------------------------------------------


def rated_table(table: Table, world: World, name: str, with_details: bool = False) -> Rating:
    """The rating of a table on a world whose rows it has."""
    exact = world.exact
    if exact is None:
        return Rating(name, world.name, world.played(_by_table(table, world)), _notes_of(table))
    values, model = table.values[world.row_of_state], exact.model
    policy: NDArray[Any] = values if table.is_policy else values.argmax(axis=1)
    evaluation, notes = exact.worth(policy), list(table.notes)
    blank = _are_equal(values) & (not table.is_policy)
    ties = never = None
    if not table.is_policy:
        greedy = policy
        met = mdp.state_visitation(model, greedy, exact.horizon) > 0
        ties = _ties(values, met, world)
        unsure = blank & model.reachable
        never = int((unsure & met).sum()), int((unsure & ~met).sum())
        notes = [*_on_learning(table, ties, never, evaluation), *notes]
        other = _on_other_orders(
            table, world, greedy, exact.yardstick.score(evaluation.mean_return)
        )
        notes = [*other, *notes]
    explained, drawn = None, ()
    if with_details:
        explained = explained_policy(world, policy)
        likeliest = policy if policy.ndim == 1 else policy.argmax(axis=1)
        drawn = world.map_of(likeliest, blank)
    return Rating(name, world.name, evaluation, tuple(notes), ties, never, explained, drawn)


def explained_policy(world: World, policy: NDArray[Any]) -> Explanation | None:
    """Where a policy loses; None in worlds that are too large."""
    assert world.exact is not None
    try:
        return explanation_of_policy(world.env, world.exact, policy)
    except ValueError:
        return None


def _by_table(table: Table, world: World) -> Callable[[Any], int]:
    """The actions of a table, those of a stochastic policy from a generator of its own."""
    start, rng = int(world.env.action_space.start), np.random.default_rng(SEED)  # type: ignore[attr-defined]
    greedy = table.values.argmax(axis=1)

    def act(observation: Any) -> int:
        row = world.row_of(observation)
        if not table.is_policy:
            return start + int(greedy[row])
        return start + int(rng.choice(table.values.shape[1], p=table.values[row]))

    return act


def _notes_of(table: Table) -> tuple[str, ...]:
    """The notes on a table whose states are met by episodes alone."""
    is_new = not table.is_policy and not table.values.any()
    return ("never trained: every value is 0",) * is_new + table.notes


def _are_equal(values: Floats) -> Bools:
    """The states whose finite values are all the same, shape (S,)."""
    known = np.isfinite(values)
    low = np.where(known, values, np.inf).min(axis=1)
    high = np.where(known, values, -np.inf).max(axis=1)
    return np.asarray(low >= high)


def _ties(values: Floats, met: Bools, world: World) -> Ties:
    """The ties of values (S, A), and the returns of all ways to break them."""
    exact = world.exact
    assert exact is not None
    model, best = exact.model, values == values.max(axis=1, keepdims=True)
    tied = (best.sum(axis=1) > 1) & model.reachable
    n_states, n_met = int(tied.sum()), int((tied & met).sum())
    is_large = model.prob.size * exact.horizon > MOST_OUTCOMES_OF_TIES
    # Where observations hide the state, planning would break ties of one observation in many ways.
    if not n_states or is_large or exact.scale is not None:
        return Ties(n_states, n_met)
    turned = replace(model, reward=-model.reward, reward_variance=None)
    most, least = (
        mdp.finite_horizon_optimum(one, exact.horizon, mask=best).start_value
        for one in (model, turned)
    )
    return Ties(n_states, n_met, -least, most)


def _on_learning(
    table: Table, ties: Ties, never: tuple[int, int], evaluation: Evaluation
) -> Iterator[str]:
    """Whether it was trained, and what its ties and its states without an update mean."""
    first = table.values.flat[0]
    if (table.values == first).all():
        yield f"never trained: every value is {first:g}"
        return
    if n_missing := int((~table.filled).sum()):
        yield f"{n_missing} of {len(table.filled)} states are not in it"
    if ties.n_states:
        told = f"{ties.n_states} states tie ({ties.n_met} on its way), the first action is taken"
        if ties.least is not None and ties.most is not None:
            apart = ties.most - ties.least > 1e-9 * max(1.0, abs(ties.most))
            others = f"other choices return {ties.least:.4g} to {ties.most:.4g}"
            told += f": {others}" if apart else ": no choice changes the return"
        yield told
    if never[0]:
        yield f"{never[0]} states on its way were never updated: all their values are equal"


def _on_other_orders(table: Table, world: World, greedy: NDArray[Any], score: float) -> list[str]:
    """Whether another order of the actions, or another lake, makes a table much better."""
    exact = world.exact
    assert exact is not None
    if score >= POOR or not exact.yardstick.has_scale or (table.values == table.values[0, 0]).all():
        return []
    told, needed = [], max(GOOD, score + MUCH_BETTER)
    other = world.other
    if other is not None and other.exact is not None:
        found = other.exact.yardstick.score(_return_of(other.exact.model, greedy, other))
        if found >= needed:
            word = f"is_slippery:{str(other.env_kwargs['is_slippery']).lower()}"
            told.append(f"with --env-kwargs {word} it scores {_shown(found)}")
    n = exact.model.n_actions
    orders = [order for order in permutations(range(n)) if n <= MOST_ACTIONS_ORDERED][1:]
    if len(orders) * exact.model.prob.size * exact.horizon > MOST_OUTCOMES_ORDERED:
        return told
    scores = [
        exact.yardstick.score(_return_of(exact.model, np.array(order)[greedy], world))
        for order in orders
    ]
    best = int(np.argmax(scores)) if scores else 0
    if scores and scores[best] >= needed:
        names = world.rows.actions or [str(action) for action in range(n)]
        ordered = ", ".join(names[action] for action in orders[best])
        told.append(f"with actions ordered {ordered} it would score {_shown(scores[best])}")
    return told


def _shown(score: float) -> str:
    return f"{np.floor(100 * score + 1e-6) / 100:g}"


def _return_of(model: TransitionModel, policy: NDArray[Any], world: World) -> float:
    assert world.exact is not None
    return mdp.policy_return(model, policy, world.exact.horizon).expected_return


# --- functions, objects and models ----------------------------------------------------------------


def rated_function(act: Callable[[Any], Any], world: World, name: str) -> Rating:
    """The rating of a function from an observation to an action or to probabilities of actions."""
    start, n = int(getattr(world.env.action_space, "start", 0)), world.rows.n_actions
    rng = np.random.default_rng(SEED)

    def chances(observation: Any) -> Floats:
        answer = act(observation)
        found = np.asarray(answer[0] if isinstance(answer, tuple) else answer)
        if found.size == 1 and 0 <= int(found.ravel()[0]) - start < n:
            return np.eye(n)[int(found.ravel()[0]) - start]
        row = found.ravel().astype(np.float64)
        if row.shape == (n,) and (row >= 0).all() and abs(row.sum() - 1) <= 1e-5:
            return row
        told = "an action or probabilities of actions"
        raise UserError(f"{name} must return {told}: at {observation!r} it returns {answer!r}")

    if world.exact is None:
        played = world.played(lambda obs: start + int(rng.choice(n, p=chances(obs))))
        return Rating(name, world.name, played)
    states = world.states_observed()
    first, second = ({s: chances(obs) for s, obs in states.items()} for _ in range(2))
    if any(not np.array_equal(first[state], second[state]) for state in states):
        played = world.played(lambda obs: start + int(rng.choice(n, p=chances(obs))))
        return Rating(name, world.name, played, ("it draws its actions: episodes are sampled",))
    policy = np.full((world.exact.model.n_states, n), 1 / n)
    for state, row in first.items():
        policy[state] = row
    nothing = np.zeros(len(policy), np.bool_)
    drawn = world.map_of(policy.argmax(axis=1), nothing)
    explained = explained_policy(world, policy)
    return Rating(name, world.name, world.exact.worth(policy), explanation=explained, map=drawn)


def acting(what: Any) -> Callable[[Any], Any] | None:
    """The function of anything that acts: a function, or an object with a method for it."""
    predict = getattr(what, "predict", None)
    if callable(predict):
        is_model = "stable_baselines3" in sys.modules and hasattr(what, "observation_space")
        return (lambda obs: predict(obs, deterministic=True)) if is_model else predict
    for method in ("act", "get_action"):
        if callable(getattr(what, method, None)):
            found: Callable[[Any], Any] = getattr(what, method)
            return found
    return what if callable(what) else None


def rated_model(path: Path, wanted: Mapping[str, Any], with_details: bool = False) -> Rating:
    """The rating of a zip or a run folder, which is evaluated as after its training.

    ``wanted`` are fields of `pipeline.models.Wanted`.
    """
    from rich.console import Console

    from rl_yardstick.diagnosis.explanation import explanation
    from rl_yardstick.pipeline.evaluation.judge import Judge
    from rl_yardstick.pipeline.models import Wanted, find_model, load_agent
    from rl_yardstick.pipeline.playing import playing_env

    found = find_model(Wanted(path=path, **wanted))
    spec = found.spec
    with closing(playing_env(found, None)) as env:
        agent = load_agent(found, env)
    judge = Judge(spec, agent, Console(quiet=True))
    with closing(judge.env):
        evaluation = judge.evaluator.at_the_end(agent)
    explained = None
    if with_details and judge.exact is not None:
        explained = explanation(spec, agent, judge.exact)
    return Rating(str(path), f"{spec.env_id}", evaluation, (spec.algo,), explanation=explained)


# --- files ----------------------------------------------------------------------------------------


def rated_file(
    path: Path, world: Callable[[str | None], World], with_details: bool = False
) -> list[tuple[str, Rating | UserError]]:
    """The ratings of the tables in a file, each with its name, or why one cannot be rated.

    ``world`` is called with the id of an environment that the file names, or None.

    Raises:
        UserError: if the file cannot be read, or holds no table.
    """
    try:
        content = read_table_file(path)
    except UnsafeFileError as error:
        fault = str(error).removeprefix(f"{path} ")
        raise UserError(f"{path} {fault}") from error
    except OSError as error:
        raise UserError(f"{path}: {(error.strerror or str(error)).lower()}") from error
    named = environment_in(content)
    there, tables = world(named), tables_in(content)
    if not tables:
        raise UserError(f"{path} holds no table: {there.name} needs {there.rows.shape}")
    rated: list[tuple[str, Rating | UserError]] = []
    for entry, one in tables.items():
        name = f"{path}[{entry}]" if entry else str(path)
        try:
            rating = rated_table(as_table(one, there.rows), there, name, with_details)
        except UserError as error:
            rated.append((name, UserError(f"{name} {error}")))
            continue
        if named and named != there.env_id:
            note = f"its file names {named}, it is rated on {there.name}"
            rating = replace(rating, notes=(note, *rating.notes))
        rated.append((name, rating))
    if any(isinstance(rating, Rating) for _, rating in rated):  # of a network, some weights may fit
        return [(name, rating) for name, rating in rated if isinstance(rating, Rating)]
    return rated[:1]


def is_model(path: Path) -> bool:
    """Whether a path is a zip or the folder of a run, and no folder of tables."""
    if path.is_file():
        return path.suffix in MODELS
    return path.is_dir() and ((path / "run.json").is_file() or any(path.glob("*/args.yml")))


def rate(
    what: Any, env: str | Env | None = None, *, bins: Mapping[str, Any] | None = None, **kwargs: Any
) -> Rating:
    """Rate a table, a model, a function or an agent against the exact optimum.

    Args:
        what: an array of states x actions; a dictionary by state, or by state and action; a
            function from an observation to an action or to probabilities of actions; an object
            with `predict`, `act` or `get_action`; or the path of a file with a table, of a model
            zip or of a run folder. Files are read as data.
        env: an environment's id, or an environment. It may be left out for a run folder, and for
            a file that names its environment.
        bins: arguments of `envs.wrappers.DiscretizeObservation`, for tables of bins.
        kwargs: arguments of the environment.

    Raises:
        UserError: if it cannot be rated on that environment, in one line that says why.
    """
    name = getattr(what, "__name__", type(what).__name__)
    if isinstance(what, str | Path):
        path, given = Path(what), env

        def world(named: str | None) -> World:
            if given is None and named is None:
                raise UserError(f"{path} names no environment: give its id")
            return world_of(given or str(named), kwargs, bins)

        if is_model(path) and (env is None or isinstance(env, str)):
            wanted = {"env_id": env, "env_kwargs": kwargs}
            return rated_model(path, wanted, with_details=True)
        found = rated_file(path, world, with_details=True)
        if len(found) > 1:
            names = ", ".join(name for name, _ in found)
            raise UserError(f"{path} holds several tables: {names}; load it, and rate one")
        if isinstance(found[0][1], UserError):
            raise found[0][1]
        return found[0][1]
    if env is None:
        raise UserError(f"on which environment? Give its id, or an object: rate({name}, 'ID')")
    there = world_of(env, kwargs, bins)
    act = None if isinstance(what, np.ndarray | Mapping | list | tuple) else acting(what)
    if act is not None:
        return rated_function(act, there, name)
    tables = tables_in(what)
    if len(tables) != 1:
        raise UserError(f"{name} is no table: {there.name} needs {there.rows.shape}")
    (table,) = tables.values()
    return rated_table(as_table(table, there.rows), there, name, with_details=True)


def reason(error: Exception) -> str:
    """Why something could not be rated, in one line."""
    return one_line(error)
