"""The facts on an environment for its page, computed from its model and its docstring."""

from __future__ import annotations

import inspect
import re
from dataclasses import dataclass
from functools import lru_cache
from math import inf
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator

from rl_yardstick.envs.known_models import (
    observations_of_states,
    success_outcomes,
    time_limit,
    transition_model,
)
from rl_yardstick.mdp import (
    Hardness,
    TransitionModel,
    baseline_policies,
    finite_horizon_optimum,
    hardness_of,
    policy_return,
)
from rl_yardstick.mdp.beliefs import Bracket
from rl_yardstick.mdp.evaluation import PolicyReturn
from rl_yardstick.pipeline.evaluation.exact import HiddenScale, hidden_scale
from rl_yardstick.pipeline.settings import parse_assignments

PAGES = Path(__file__).resolve().parents[1] / "environments"
HARDNESS_HEADS = (
    *("states", "diameter", "smallest gap", "look-ahead", "effective horizon"),
    *("random actions to a reward", "to the goal"),
)
LIMIT = 1000  # the commands' time limit for an environment without one
MOST_REWARDS = 8


def docstring_block(env_id: str) -> str:
    """The docstring of an environment."""
    entry_point = gym.spec(env_id).entry_point
    assert isinstance(entry_point, str)
    return "\n\n".join(docstring_sections(load_env_creator(entry_point))) + "\n"


def facts_block(env_id: str, *arguments: str) -> str:
    """The picture and the facts without a docstring, for environments documented elsewhere."""
    return f"{picture(env_id)}\n\n{facts_table(env_id, *arguments)}\n"


def made(env_id: str, *arguments: str) -> gym.Env[Any, Any]:
    """The environment with arguments such as ``size:20``, values being words or numbers."""
    return gym.make(env_id, **parse_assignments(arguments, env_id))


def optima_block(*written: str) -> str:
    """A row for each environment: link, first sentence, optimum, and the return of random actions.

    Args:
        written: page and id, as in ``warehouse=Warehouse-v0``.
    """
    lines = ["| id | what it is | optimum | random actions |", "|---|---|---|---|"]
    for item in written:
        page, _, env_id = item.partition("=")
        found = solution(env_id)
        figures = (optimum_cell(found), number(found.random.expected_return)) if found else ("", "")
        intro = (PAGES / f"{page}.md").read_text(encoding="utf-8").split("\n\n")[1]
        summary = intro.partition(". ")[0].rstrip(".").replace("\n", " ")
        lines.append(
            f"| [`{env_id}`](environments/{page}.md) | {summary} | {' | '.join(figures)} |"
        )
    return "\n".join(lines) + "\n"


def optimum_cell(found: Solution) -> str:
    """The optimum; under partial observability, also the optima of agents that see observations."""
    said = number(found.optimum)
    if found.by_observation is None:
        return said
    return f"{said} by the state, {', '.join(observed(found.by_observation))}"


def observed(scale: HiddenScale) -> tuple[str, str]:
    """The optima of agents with memory and without."""

    def words(ends: Bracket) -> str:
        return " to ".join(dict.fromkeys(number(each) for each in ends))

    return f"{words(scale.memory)} with memory", f"{words(scale.now)} without"


def variants_block(*words: str) -> str:
    """A row for each variant of an environment, with its optimum.

    Args:
        words: ids, each followed by arguments such as ``moves:king``.
    """
    lines = ["| id | arguments | optimum |", "|---|---|---|"]
    starts = [k for k, word in enumerate(words) if word in gym.registry]
    for first, last in zip(starts, [*starts[1:], len(words)], strict=True):
        env_id, *arguments = words[first:last]
        found = solution(env_id, *arguments)
        assert found is not None, f"{env_id} has no model"
        lines.append(f"| `{env_id}` | `{' '.join(arguments)}` | {number(found.optimum)} |")
    return "\n".join(lines) + "\n"


def hardness_block(*ids: str) -> str:
    """A row for each environment: measures of its difficulty, by its model and time limit."""
    lines = [f"| id | {' | '.join(HARDNESS_HEADS)} |", f"|---|{'---:|' * len(HARDNESS_HEADS)}"]
    for env_id in ids:
        cells = hardness_cells(env_id)
        lines.append(f"| `{env_id}` | {' | '.join(cells.values())} |")
    return "\n".join(lines) + "\n"


def hardness_cells(env_id: str) -> dict[str, str]:
    """The numbers of `mdp.Hardness`, by the table's heads: "-" for None, "never" for infinite."""

    def cell(value: float | None) -> str:
        return "-" if value is None else "never" if value == inf else number(value)

    found = hardness(env_id)
    assert found is not None, f"{env_id} has no model"
    unreached = found.states - found.reachable_states
    bound = found.effective_horizon
    cells = [
        f"{found.reachable_states:,}" + (f" of {found.states:,}" if unreached else ""),
        cell(found.diameter),
        cell(found.smallest_gap),
        cell(found.lookahead),
        "-" if bound is None else f"{bound:.1f}".removesuffix(".0"),
        cell(found.random_steps_to_reward),
        cell(found.random_steps_to_goal),
    ]
    return dict(zip(HARDNESS_HEADS, cells, strict=True))


@lru_cache
def hardness(env_id: str) -> Hardness | None:
    """The difficulty of an environment under its time limit; None if no model is known."""
    env = made(env_id)
    model, limit = transition_model(env), time_limit(env) or LIMIT
    return None if model is None else hardness_of(model, limit, success_outcomes(env))


def picture(env_id: str) -> str:
    """A link to the picture that `draw_images.py` makes."""
    return f"![{env_id} at the start](../images/environments/{env_id}.png)"


def facts_table(env_id: str, *arguments: str) -> str:
    """Spaces, time limit, and figures from the model, as a table."""
    env = made(env_id, *arguments)
    limit = time_limit(env)
    rows = {
        "observations": f"`{env.observation_space}`",
        "actions": f"`{env.action_space}`",
        "time limit": f"{limit:,} steps" if limit else f"{LIMIT:,} steps, set by commands",
    }
    model, found = transition_model(env), solution(env_id, *arguments)
    if model is None or found is None:
        rows["model"] = "unknown: returns are sampled"
    else:
        rows |= {
            "reachable states": f"{model.reachable.sum():,}",
            "transitions": "random" if is_random(model) else "deterministic",
            "rewards": rewards(model),
            "**optimum**": f"**{number(found.optimum)}**",
            **by_observation(found.by_observation),
            "best constant action": number(found.best_constant),
            "random actions": random_actions(found.random),
        }
    return "| | |\n|---|---|\n" + "\n".join(f"| {key} | {said} |" for key, said in rows.items())


def by_observation(scale: HiddenScale | None) -> dict[str, str]:
    """A row with the optima of agents that see observations, if these hide the state."""
    if scale is None:
        return {}
    said = " and ".join(observed(scale))
    return {"optimum by observations (score 1)": f"**{said}**"}


@dataclass(frozen=True)
class Solution:
    """Figures from a model: the optimum, and the returns of constant and random policies."""

    optimum: float
    best_constant: float
    random: PolicyReturn
    by_observation: HiddenScale | None


@lru_cache
def solution(env_id: str, *arguments: str) -> Solution | None:
    """The figures of an environment under its time limit; None if no model is known."""
    env = made(env_id, *arguments)
    model, limit = transition_model(env), time_limit(env) or LIMIT
    if model is None:
        return None
    uniform, *constant = baseline_policies(model)
    optimum = finite_horizon_optimum(model, limit).start_value
    best_constant = max(policy_return(model, one, limit).expected_return for one in constant)
    random = policy_return(model, uniform, limit, success=success_outcomes(env))
    baseline, seen = max(best_constant, random.expected_return), observations_of_states(env)
    scale = None if seen is None else hidden_scale(model, seen, limit, optimum, baseline)
    return Solution(optimum, best_constant, random, scale)


def random_actions(found: PolicyReturn) -> str:
    """The results of random actions."""
    said = f"{number(found.expected_return)} in {number(found.expected_length)} steps"
    if found.success_rate is None:
        return said
    return f"{said}; {100 * found.success_rate:.3g} % of the episodes succeed"


def is_random(model: TransitionModel) -> bool:
    """Whether an action in a reachable state can have more than one outcome."""
    possible = (model.prob > 0).sum(axis=2)[model.reachable]
    return bool((possible > 1).any())


def rewards(model: TransitionModel) -> str:
    """The possible rewards, or their range."""
    possible = model.reachable[:, None, None] & (model.prob > 0)
    found = np.unique(np.round(model.reward[possible], 12))
    drawn = " in the mean: they are drawn" if model.reward_variance is not None else ""
    if len(found) > MOST_REWARDS:
        return f"from {number(found[0])} to {number(found[-1])}{drawn}"
    return ", ".join(number(value) for value in found) + drawn


def number(value: float) -> str:
    """A number with four significant digits or two decimals; integers with all digits."""
    value = float(value)
    if abs(value - round(value)) < 1e-9:
        return f"{round(value):,}"
    return f"{value:,.2f}" if abs(value) >= 10 else f"{value:.4g}"


def docstring_sections(cls: Any) -> list[str]:
    """The sections of a class's docstring, with ``::`` before maps replaced for Markdown."""
    text = re.sub(r"::\n", ":\n", inspect.getdoc(cls) or "")
    lead, *sections = re.split(r"(?m)^(?=## )", text.partition("\n")[2].strip())
    return [part for part in map(str.strip, (lead, *sections)) if part]
