"""Ratings: exact returns on the scale from baseline to optimum, with what explains them."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import permutations
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from rl_yardstick import mdp
from rl_yardstick.diagnosis.explanation import Explanation, explanation_of_policy
from rl_yardstick.envs.layout import action_names
from rl_yardstick.mdp.transition_model import Bools, Floats, Ints
from rl_yardstick.pipeline.errors import UserError, one_line, shown
from rl_yardstick.pipeline.evaluation.exact import ExactEvaluator
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation
from rl_yardstick.pipeline.run import RECORD
from rl_yardstick.rating.tables import Table, as_table, tables_in
from rl_yardstick.rating.worlds import N_EPISODES, SEED, Env, World, world_of
from rl_yardstick.safe_files.files import UnsafeFileError
from rl_yardstick.safe_files.tables import read_table_file

# Another order of actions is worth a line if a table that scores less than POOR scores at least
# GOOD with it, and MUCH_BETTER than without.
POOR, GOOD, MUCH_BETTER = 0.9, 0.5, 0.3
MOST_ACTIONS, MOST_OUTCOMES = 6, 1_000_000_000  # to try orders of actions, or to break ties


@dataclass(frozen=True, eq=False, repr=False)
class Rating:
    """How good something is on an environment."""

    name: str  #: what was rated
    environment: str
    evaluation: Evaluation  #: exact where the model is known; else of sampled episodes
    notes: tuple[str, ...] = ()  #: what to know about it, the most important first
    #: of a table, where the model is known: reachable states with several best actions (``ties``,
    #: ``ties_met`` on its way), the range of returns of all ways to break ties (``ties_least``,
    #: ``ties_most``), and states with equal values (``equal_met`` on its way, ``equal_elsewhere``)
    facts: Mapping[str, Any] = field(default_factory=dict)
    explanation: Explanation | None = None  #: where it loses
    map: str = ""  #: a grid world with the actions that it takes

    @property
    def figures(self) -> dict[str, Any]:
        """Return, optimum, baseline, score, success rate and others by name; also attributes."""
        first = "mean_return", "optimum", "baseline", "score", "success_rate"
        return {**dict.fromkeys(first), **self.evaluation.summary(), **self.facts}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name not in self.figures:
            raise AttributeError(f"a rating has no {name}")
        return self.figures[name]

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
        return f"<pre>{html.escape(repr(self))}</pre>"


# --- tables ---------------------------------------------------------------------------------------


def rated_table(table: Table, world: World, name: str) -> Rating:
    """The rating of a table on a world whose rows it has."""
    notes, exact, first = [table.note] if table.note else [], world.exact, table.values.flat[0]
    is_blank = not table.is_policy and bool((table.values == first).all())
    if is_blank:
        notes.insert(0, f"never trained: every value is {first:g}")
    if exact is None:
        best = table.values.argmax(axis=1)
        chances = table.values if table.is_policy else np.eye(world.shape[1])[best]
        return rated_function(lambda obs: chances[world.row_of(obs)], world, name, notes)
    seen, model = world.observed(), exact.model
    values = np.full((model.n_states, model.n_actions), np.nan)
    values[[*seen]] = table.values[[world.row_of(obs) for obs in seen.values()]]
    unknown = np.isnan(values[:, 0])
    values[unknown] = 1 / model.n_actions
    policy = values if table.is_policy else values.argmax(axis=1)
    met = mdp.state_visitation(model, policy, exact.horizon) > 0
    if table.is_policy:
        if n := int((unknown & met).sum()):
            notes.insert(0, f"{n} of {met.sum()} states on its way have no action: taken as random")
        return _exact(world, policy, name, notes, unknown)
    equal = (values.min(axis=1) >= values.max(axis=1)) & model.reachable
    facts = _ties(values, met, exact)
    facts |= {"equal_met": int((equal & met).sum()), "equal_elsewhere": int((equal & ~met).sum())}
    if not is_blank:
        notes = [*_better_order(world, exact, policy), *_on_values(facts), *notes]
    return replace(_exact(world, policy, name, notes, equal), facts=facts)


def _exact(world: World, policy: Any, name: str, notes: Sequence[str], equal: Bools) -> Rating:
    """The rating of a policy; on the map, states with equal values have a question mark."""
    assert world.exact is not None
    explained, actions = None, policy if policy.ndim == 1 else policy.argmax(axis=1)
    with suppress(UserError):  # horizon times states are too many
        explained = explanation_of_policy(world.env, world.exact, policy)
    found, drawn = world.exact.worth(policy), world.map_of(actions, equal)
    return Rating(name, world.name, found, (*notes,), {}, explained, drawn)


def _ties(values: Floats, met: Bools, exact: ExactEvaluator) -> dict[str, Any]:
    """The ties of values (S, A), and the range of the returns of all ways to break them."""
    model, best = exact.model, values == values.max(axis=1, keepdims=True)
    tied = (best.sum(axis=1) > 1) & model.reachable
    found: dict[str, Any] = {"ties": int(tied.sum()), "ties_met": int((tied & met).sum())}
    # Where observations hide the state, planning would break ties of one observation in many ways.
    if exact.scale is None and model.prob.size * exact.horizon <= MOST_OUTCOMES:
        for name, sign in (("ties_least", -1), ("ties_most", 1)):
            turned = replace(model, reward=sign * model.reward, reward_variance=None)
            plan = mdp.finite_horizon_optimum(turned, exact.horizon, mask=best)
            found[name] = 0.0 + sign * plan.start_value
    return found


def _on_values(facts: Mapping[str, Any]) -> Iterator[str]:
    """What ties and states without an update mean."""
    least, most = facts.get("ties_least", -np.inf), facts.get("ties_most", np.inf)
    if facts["ties"] and most - least <= 1e-9 * max(1.0, abs(most)):
        yield "its ties do not change the return"
    elif facts["ties"]:
        told = f"; others return {least:.4g} to {most:.4g}" if most < np.inf else ""
        met = f"{facts['ties']} states, {facts['ties_met']} on its way"
        yield f"ties in {met}: takes the first{told}"
    if facts["equal_met"] + facts["equal_elsewhere"]:
        told = f"{facts['equal_met']} on its way, {facts['equal_elsewhere']} elsewhere"
        yield f"states never updated (all values equal): {told}"


def _better_order(world: World, exact: ExactEvaluator, policy: Ints) -> Iterator[str]:
    """Another order of the actions, if a table scores much better with it."""
    n, n_outcomes = exact.model.n_actions, exact.model.prob.size * exact.horizon
    is_quick = n <= MOST_ACTIONS and math.factorial(n) * n_outcomes <= MOST_OUTCOMES
    score = exact.yardstick.score(exact.worth(policy).mean_return)
    if score < POOR and is_quick and exact.yardstick.has_scale:
        orders = list(permutations(range(n)))
        tried = (mdp.policy_return(exact.model, np.array(o)[policy], exact.horizon) for o in orders)
        most, best = max(zip((one.expected_return for one in tried), orders, strict=True))
        found = exact.yardstick.score(most)
        if found >= max(GOOD, score + MUCH_BETTER):
            names = action_names(world.env) or range(n)
            ordered = ", ".join(str(names[action]) for action in best)
            floored = math.floor(100 * found + 1e-6) / 100
            yield f"with actions ordered {ordered} it would score {floored:g}"


# --- functions, objects and models ----------------------------------------------------------------


def rated_function(
    act: Callable[[Any], Any], world: World, name: str, notes: Sequence[str] = ()
) -> Rating:
    """The rating of a function from an observation to an action or to probabilities of actions."""
    actions: Any = world.env.action_space
    sampled = f"sampled, {N_EPISODES} episodes"
    if not isinstance(actions, gym.spaces.Discrete):
        return Rating(name, world.name, world.played(act), (sampled,))
    start, n = int(actions.start), int(actions.n)

    def chances(observation: Any) -> Any:
        answer = called(act, observation)
        with suppress(ValueError, TypeError):  # no numbers
            told = answer[0] if isinstance(answer, tuple) else answer
            found: Any = np.asarray(told, np.float64).ravel()
            if found.size == 1 and found[0] - start in range(n):
                found = np.eye(n)[int(found[0]) - start]
            if found.size == n and (found >= 0).all() and abs(found.sum() - 1) <= 1e-5:
                return found / found.sum()
        needed = f"it must return an action or {n} probabilities"
        raise UserError(f"{name} returns {shown(answer)} at {observation!s:.60}: {needed}")

    if world.exact is not None:
        observed = world.observed()
        first, second = ([chances(obs) for obs in observed.values()] for _ in range(2))
        if np.array_equal(first, second):
            policy = np.full((world.exact.model.n_states, n), 1 / n)
            policy[[*observed]] = first
            return _exact(world, policy, name, notes, np.zeros(len(policy), np.bool_))
        notes = [*notes, "it draws its actions, or remembers"]
    rng = np.random.default_rng([SEED, 1])  # no numbers that the environment draws
    found = world.played(lambda obs: start + int(rng.choice(n, p=chances(obs))))
    return Rating(name, world.name, found, (*notes, sampled))


def acting(what: Any) -> Callable[[Any], Any] | None:
    """The function of anything that acts: an object with a method for it, or a function."""
    if hasattr(what, "predict") and hasattr(what, "observation_space"):  # of the library
        return partial(what.predict, deterministic=True)
    names = "predict", "act", "get_action", "choose_action"
    return next(filter(callable, (*(getattr(what, name, None) for name in names), what)), None)


def called(what: Any, *given: Any) -> Any:
    """What a function or class makes of its arguments; UserError if it needs others."""
    try:
        return what(*given)
    except TypeError as error:
        if error.__traceback__ is None or error.__traceback__.tb_next is not None:
            raise  # of its own code
        needed = "a policy gets the observation" if given else "rate an object, not its class"
        raise UserError(f"{one_line(error)}; {needed}") from error


def is_model(path: Path) -> bool:
    """Whether a path is a model's zip or the folder of a run, and no folder of tables."""
    if path.is_dir():
        return (path / RECORD).is_file() or any(path.glob("*/args.yml"))
    return path.suffix == ".zip"


def rated_model(path: Path, wanted: Mapping[str, Any]) -> Rating:
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
    judge = Judge(found.spec, agent, Console(quiet=True))
    with closing(judge.env):
        evaluation = judge.evaluator.at_the_end(agent)
    why = None if judge.exact is None else explanation(found.spec, agent, judge.exact)
    told = () if evaluation.is_exact else (f"sampled, {len(evaluation.returns)} episodes",)
    return Rating(str(path), found.spec.env_id, evaluation, (found.spec.algo, *told), {}, why)


# --- files ----------------------------------------------------------------------------------------


def content_of(path: Path) -> Any:
    """What a file holds, as data; UserError if it cannot be read."""
    if path.suffix == ".py":
        raise UserError(f"{path}: name what is to be rated, as in {path}:policy")
    try:
        return read_table_file(path)
    except (UnsafeFileError, OSError) as error:
        fault = (getattr(error, "strerror", None) or "").lower() or str(error)
        raise UserError(f"{path}: {fault.removeprefix(f'{path} ')}") from error


def rated_tables(
    content: Any, world_of_id: Callable[[str | None], World], name: str
) -> dict[str, Rating]:
    """The ratings of the tables in the content of a file, by name.

    ``world_of_id`` is called with the id of an environment that the file names, or None.

    Raises:
        UserError: if it holds no table that fits.
    """
    # As the course of Hugging Face writes it.
    named = content.get("env_id") if isinstance(content, Mapping) else None
    world = world_of_id(named if isinstance(named, str) else None)
    notes = [f"its file names {named}"] if named and named not in world.name.split() else []
    rated, misfit = dict[str, Rating](), UserError(f"{name} is no table: {world.needs()}")
    for entry, one in tables_in(content).items():
        full = f"{name}[{entry}]" if entry else name
        try:
            found = rated_table(as_table(one, world), world, full)
            rated[full] = replace(found, notes=(*notes, *found.notes))
        except UserError as error:  # another entry may be the table
            misfit = UserError(f"{full} {error}")
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
            or class with `predict`, `act`, `get_action` or `choose_action`; a `Run`; or the path
            of a file with a table, of a model zip or of a run folder. Files are read as data.
        env: an environment's id, or an environment. It may be left out for a run folder, and for
            a file that names its environment.
        bins: arguments of `envs.wrappers.DiscretizeObservation`, for tables of bins.
        kwargs: arguments of the environment.

    Raises:
        UserError: if it cannot be rated on that environment, in one line that says why.
    """
    wanted = {"env_id": env, "env_kwargs": kwargs}
    if hasattr(what, "folder") and hasattr(what, "spec"):  # a run
        what, wanted["typed"] = what.folder, what.spec.gym_packages
    if isinstance(what, str | Path) and is_model(Path(what)) and not isinstance(env, gym.Env):
        return rated_model(Path(what), wanted)
    what = called(what) if isinstance(what, type) else what
    name = str(what) if isinstance(what, str | Path) else type(what).__name__
    what = content_of(Path(what)) if isinstance(what, str | Path) else what
    if (act := acting(what)) is not None:
        return rated_function(act, world_of(env, kwargs, bins), getattr(what, "__name__", name))
    found = rated_tables(what, lambda named: world_of(env or named, kwargs, bins), name)
    if len(found) > 1:
        raise UserError(f"holds several tables, {', '.join(found)}: rate one of them")
    return next(iter(found.values()))
