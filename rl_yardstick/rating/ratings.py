"""Ratings: exact returns, on the scale from the baseline to the optimum, with what explains them.

`rate` is for Python; `rated_file` is what the command does with each file.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rl_yardstick import mdp
from rl_yardstick.diagnosis.explanation import Explanation, explanation_of_policy
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.pipeline.errors import UserError, shown
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation
from rl_yardstick.pipeline.run import RECORD
from rl_yardstick.rating.tables import Table, as_table, tables_in
from rl_yardstick.rating.worlds import N_EPISODES, SEED, Env, World, world_of
from rl_yardstick.safe_files.files import UnsafeFileError
from rl_yardstick.safe_files.tables import read_table_file

# Another order of actions, or another slipperiness, is worth a line if a table that scores less
# than POOR scores at least GOOD with it, and MUCH_BETTER than without.
POOR, GOOD, MUCH_BETTER = 0.9, 0.5, 0.3
MOST_ACTIONS_ORDERED, MOST_OUTCOMES_ORDERED = 6, 1_000_000_000
MOST_OUTCOMES_OF_TIES = 1_000_000_000


@dataclass(frozen=True, eq=False, repr=False)
class Rating:
    """How good something is on an environment."""

    name: str  #: what was rated
    environment: str
    evaluation: Evaluation  #: exact where the model is known; else of sampled episodes
    notes: tuple[str, ...] = ()  #: what to know about it, the most important first
    #: of a table of values, where the model is known: the states, among those that can be reached,
    #: in which several actions have the top value (``ties``, and ``ties_met`` on its way), the
    #: range of the returns of all ways to break them (``ties_least``, ``ties_most``), and states
    #: with equal values on its way and elsewhere (``equal_met``, ``equal_elsewhere``)
    facts: Mapping[str, Any] = field(default_factory=dict)
    explanation: Explanation | None = None  #: where it loses
    map: str = ""  #: a grid world with the actions that it takes

    @property
    def figures(self) -> dict[str, Any]:
        """Return, optimum, baseline, score, success rate and others by name; also attributes."""
        found = self.evaluation.summary()
        first = "mean_return", "optimum", "baseline", "score", "success_rate"
        return {**{name: found.get(name) for name in first}, **found, **self.facts}

    def __getattr__(self, name: str) -> Any:
        figures = {} if name.startswith("_") else self.figures
        if name not in figures:
            raise AttributeError(f"a rating has no {name}: it has {', '.join(figures)}")
        return figures[name]

    def as_data(self) -> dict[str, Any]:
        """The rating as JSON."""
        why = None if self.explanation is None else self.explanation.as_data()
        found = {"name": self.name, "environment": self.environment, **self.figures}
        return {**found, "notes": self.notes, "map": self.map, "explanation": why}

    def __repr__(self) -> str:
        known = [(name, self.figures[name]) for name in list(self.figures)[:5]]
        told = ", ".join(f"{name} {number:.4g}" for name, number in known if number is not None)
        return "\n".join([f"{self.name} on {self.environment}: {told}", *self.notes, self.map])

    def _repr_html_(self) -> str:
        first, *rest = map(html.escape, repr(self).split("\n"))
        rows = first.partition(": ")[2].split(", ")
        cells = "".join(f"<tr><th>{row.replace(' ', '</th><td>')}</td></tr>" for row in rows)
        title, below = first.partition(": ")[0], "\n".join(rest)
        return f"<table><caption>{title}</caption>{cells}</table><pre>{below}</pre>"


# --- tables ---------------------------------------------------------------------------------------


def rated_table(table: Table, world: World, name: str, with_details: bool = False) -> Rating:
    """The rating of a table on a world whose rows it has."""
    notes, exact = list(table.notes), world.exact
    is_blank = not table.is_policy and bool((table.values == table.values.flat[0]).all())
    if is_blank:
        notes.insert(0, f"never trained: every value is {table.values.flat[0]:g}")
    if exact is None:
        n, best = world.rows.n_actions, table.values.argmax(axis=1)
        chances = table.values if table.is_policy else np.eye(n)[best]
        return _sampled(world, lambda obs: chances[world.row_of(obs)], name, notes)
    rows, model = world.rows_of_states(), exact.model
    values = table.values[rows]
    policy: NDArray[Any] = values if table.is_policy else values.argmax(axis=1)
    evaluation = exact.worth(policy)
    equal, facts = np.zeros(len(values), np.bool_), dict[str, Any]()
    if not table.is_policy:
        met = mdp.state_visitation(model, policy, exact.horizon) > 0
        equal = _are_equal(values) & model.reachable
        lacking = ~table.filled[rows] & model.reachable
        counted = {"equal_met": equal & met, "equal_elsewhere": equal & ~met, "missing": lacking}
        facts = _ties(values, met, exact)
        facts |= {fact: int(states.sum()) for fact, states in counted.items()}
        if not is_blank:
            better = _better_ways(world, policy, exact.yardstick.score(evaluation.mean_return))
            notes = [*better, *_on_values(facts), *notes]
    rating = Rating(name, world.name, evaluation, tuple(notes), facts)
    return _with_details(rating, world, policy, equal) if with_details else rating


def _with_details(rating: Rating, world: World, policy: NDArray[Any], equal: Bools) -> Rating:
    assert world.exact is not None
    explained = None
    with suppress(UserError):  # horizon times states are too many
        explained = explanation_of_policy(world.env, world.exact, policy)
    drawn = world.map_of(policy if policy.ndim == 1 else policy.argmax(axis=1), equal)
    return replace(rating, explanation=explained, map=drawn)


def _sampled(
    world: World, chances: Callable[[Any], Floats], name: str, notes: Sequence[str] = ()
) -> Rating:
    """A rating by episodes, from the probabilities of actions at an observation."""
    start, rng = int(getattr(world.env.action_space, "start", 0)), np.random.default_rng(SEED)
    found = world.played(lambda obs: start + int(rng.choice(len(p := chances(obs)), p=p)))
    return Rating(name, world.name, found, (*notes, f"sampled, {N_EPISODES} episodes"))


def _are_equal(values: Floats) -> Bools:
    """The states whose finite values are all the same, shape (S,)."""
    known = np.isfinite(values)
    low, high = np.where(known, values, np.inf), np.where(known, values, -np.inf)
    return np.asarray(low.min(axis=1) >= high.max(axis=1))


def _ties(values: Floats, met: Bools, exact: ExactEvaluator) -> dict[str, Any]:
    """The ties of values (S, A), and the range of the returns of all ways to break them."""
    model, best = exact.model, values == values.max(axis=1, keepdims=True)
    tied = (best.sum(axis=1) > 1) & model.reachable
    found: dict[str, Any] = {"ties": int(tied.sum()), "ties_met": int((tied & met).sum())}
    # Where observations hide the state, planning would break ties of one observation in many ways.
    if exact.scale is None and model.prob.size * exact.horizon <= MOST_OUTCOMES_OF_TIES:
        turned = replace(model, reward=-model.reward, reward_variance=None)
        for name, one, sign in (("ties_least", turned, -1), ("ties_most", model, 1)):
            plan = mdp.finite_horizon_optimum(one, exact.horizon, mask=best)
            found[name] = 0.0 + sign * plan.start_value
    return found


def _on_values(facts: Mapping[str, Any]) -> Iterator[str]:
    """What ties, states without an update, and missing states mean."""
    least, most = facts.get("ties_least", -np.inf), facts.get("ties_most", np.inf)
    if facts["ties"] and most - least > 1e-9 * max(1.0, abs(most)):
        told = f"; others return {least:.4g} to {most:.4g}" if most < np.inf else ""
        met = f"{facts['ties']} states, {facts['ties_met']} on its way"
        yield f"ties in {met}: takes the first{told}"
    if facts["equal_met"] + facts["equal_elsewhere"]:
        told = f"{facts['equal_met']} states on its way, {facts['equal_elsewhere']} elsewhere"
        yield f"never updated (all values equal): {told}"
    if facts["missing"]:
        yield f"lacks {facts['missing']} of the states that can be reached"
    if facts["ties"] and most - least <= 1e-9 * max(1.0, abs(most)):
        yield "its ties do not change the return"


def _better_ways(world: World, policy: Ints, score: float) -> Iterator[str]:
    """Another order of the actions, or another lake, if a table scores much better with it."""
    exact, other = world.exact, world.other if score < POOR else None
    assert exact is not None
    needed = max(GOOD, score + MUCH_BETTER)

    def scored(evaluator: ExactEvaluator, policy: Ints) -> float:
        found = mdp.policy_return(evaluator.model, policy, evaluator.horizon)
        return evaluator.yardstick.score(found.expected_return)

    if other is not None and other.exact is not None:
        slips, found = other.env_kwargs["is_slippery"], scored(other.exact, policy)
        if found >= needed:
            yield f"with is_slippery:{str(slips).lower()} it would score {floored(found)}"
    n, n_outcomes = exact.model.n_actions, exact.model.prob.size * exact.horizon
    if score < POOR and n <= MOST_ACTIONS_ORDERED and exact.yardstick.has_scale:
        orders = list(permutations(range(n)))
        if len(orders) * n_outcomes <= MOST_OUTCOMES_ORDERED:
            found, order = max((scored(exact, np.array(one)[policy]), one) for one in orders)
            if found >= needed:
                names = world.rows.actions or [str(action) for action in range(n)]
                ordered = ", ".join(names[action] for action in order)
                yield f"with actions ordered {ordered} it would score {floored(found)}"


def floored(score: float) -> str:
    """A score with two decimals, rounded down: only the optimum is 1."""
    return f"{np.floor(100 * score + 1e-6) / 100:g}"


# --- functions, objects and models ----------------------------------------------------------------


def rated_function(act: Callable[[Any], Any], world: World, name: str) -> Rating:
    """The rating of a function from an observation to an action or to probabilities of actions."""
    actions: Any = world.env.action_space
    if not isinstance(actions, gym.spaces.Discrete):
        told = (f"sampled, {N_EPISODES} episodes",)
        return Rating(name, world.name, world.played(act), told)
    start, n = int(actions.start), int(actions.n)

    def chances(observation: Any) -> Floats:
        answer = act(observation)
        found = np.zeros(0)
        with suppress(ValueError, TypeError):  # no numbers
            told = answer[0] if isinstance(answer, tuple) else answer
            found = np.asarray(told, np.float64).ravel()
        if found.size == 1 and found[0] - start in range(n):
            return np.asarray(np.eye(n)[int(found[0]) - start])
        if found.size == n and (found >= 0).all() and abs(found.sum() - 1) <= 1e-5:
            return np.asarray(found / found.sum())
        needed = f"it must return an action or {n} probabilities"
        raise UserError(f"{name} returns {shown(answer)} at {shown(observation)}: {needed}")

    if world.exact is None:
        return _sampled(world, chances, name)
    observed = world.observed()
    first, second = ([chances(obs) for obs in observed.values()] for _ in range(2))
    if not np.array_equal(first, second):
        return _sampled(world, chances, name, ["it draws its actions, or remembers"])
    policy = np.full((world.exact.model.n_states, n), 1 / n)
    policy[list(observed)] = first
    rating = Rating(name, world.name, world.exact.worth(policy))
    return _with_details(rating, world, policy, np.zeros(len(policy), np.bool_))


def acting(what: Any) -> Callable[[Any], Any] | None:
    """The function of anything that acts: an object with a method for it, or a function."""
    for method in ("predict", "act", "get_action"):
        found: Any = getattr(what, method, None)
        if callable(found):
            is_library = method == "predict" and hasattr(what, "observation_space")
            return partial(found, deterministic=True) if is_library else found
    return what if callable(what) else None


def is_model(path: Path) -> bool:
    """Whether a path is a model's zip or the folder of a run, and no folder of tables."""
    if path.is_dir():
        return (path / RECORD).is_file() or any(path.glob("*/args.yml"))
    return path.suffix == ".zip"


def rated_model(path: Path, wanted: Mapping[str, Any], with_details: bool = False) -> Rating:
    """The rating of a zip or a run folder, evaluated as after its training.

    ``wanted`` are fields of `pipeline.models.Wanted`.
    """
    from rich.console import Console

    from rl_yardstick.diagnosis.explanation import explanation
    from rl_yardstick.pipeline.evaluation.judge import Judge
    from rl_yardstick.pipeline.models import Wanted, find_model, load_agent
    from rl_yardstick.pipeline.playing import playing_env

    found = find_model(Wanted(path=path, **wanted))
    with closing(playing_env(found, None)) as env:
        agent = load_agent(found, env)
    judge, explained = Judge(found.spec, agent, Console(quiet=True)), None
    with closing(judge.env):
        evaluation = judge.evaluator.at_the_end(agent)
    if with_details and judge.exact is not None:
        explained = explanation(found.spec, agent, judge.exact)
    told = () if evaluation.is_exact else (f"sampled, {len(evaluation.returns)} episodes",)
    notes = (found.spec.algo, *told)
    return Rating(str(path), found.spec.env_id, evaluation, notes, explanation=explained)


# --- files ----------------------------------------------------------------------------------------


def rated_file(
    path: Path, world: Callable[[str | None], World], with_details: bool = False
) -> dict[str, Rating]:
    """The ratings of the tables in a file, by name.

    ``world`` is called with the id of an environment that the file names, or None.

    Raises:
        UserError: if the file cannot be read, or holds no table that fits.
    """
    try:
        content = read_table_file(path)
    except UnsafeFileError as error:
        raise UserError(f"{path} {str(error).removeprefix(f'{path} ')}") from error
    except OSError as error:
        raise UserError(f"{path}: {(error.strerror or str(error)).lower()}") from error
    # As the course of Hugging Face writes it.
    named = content.get("env_id") if isinstance(content, Mapping) else None
    named = named if isinstance(named, str) else None
    there = world(named)
    rated, misfit = {}, UserError(f"{path} holds no table: {there.rows.shape()}")
    for entry, one in tables_in(content).items():
        name = f"{path}[{entry}]" if entry else str(path)
        try:
            rating = rated_table(as_table(one, there.rows), there, name, with_details)
        except UserError as error:  # another entry may be the table
            misfit = UserError(f"{name} {error}")
            continue
        notes = (f"its file names {named}",) if named and named != there.env_id else ()
        rated[name] = replace(rating, notes=(*notes, *rating.notes))
    if not rated:
        raise misfit
    return rated


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
    if isinstance(what, str | Path) and is_model(Path(what)) and not isinstance(env, gym.Env):
        return rated_model(Path(what), {"env_id": env, "env_kwargs": kwargs}, with_details=True)

    def world(named: str | None) -> World:
        if env is None and named is None:
            raise UserError(f"{shown(what)}: give the id of its environment")
        return world_of(env or str(named), kwargs, bins)

    if isinstance(what, str | Path):
        found = rated_file(Path(what), world, with_details=True)
        if len(found) > 1 and not next(iter(found)).endswith("[sum]"):
            raise UserError(f"{what} holds several tables, {', '.join(found)}: load and rate one")
        return next(iter(found.values()))
    there, name = world(None), getattr(what, "__name__", type(what).__name__)
    act = None if isinstance(what, np.ndarray | Mapping | list | tuple) else acting(what)
    if act is not None:
        return rated_function(act, there, name)
    tables = tables_in(what)
    if not tables:
        raise UserError(f"{name} is no table: {there.rows.shape()}")
    table = as_table(next(iter(tables.values())), there.rows)
    return rated_table(table, there, name, with_details=True)
