"""``shaping``: whether rewards in training change the optimal policies, and at what cost."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import OneLineParser, flag, several, shared
from rl_yardstick.commands.terminal import TextConsole, say
from rl_yardstick.pipeline.errors import UserError, as_user_error

if TYPE_CHECKING:
    import gymnasium as gym

    from rl_yardstick.mdp.shaping import Effect
    from rl_yardstick.mdp.transition_model import TransitionModel
    from rl_yardstick.pipeline.spec import TrainSpec

# The largest number of states printed in which other actions are best.
MOST_STATES = 3
# Returns that differ by less, relative to the optimum, are equal.
ROUNDING = 1e-9

EPILOG = """\
examples:
  python -m rl_yardstick shaping --env Warehouse-v0 --algo ppo
  python -m rl_yardstick shaping --env Warehouse-v0 --train-env-kwargs goal_reward:5
"""


def build_parser() -> OneLineParser:
    """The flags."""
    words = "Show whether training on other rewards changes the optimal policies, and the exact "
    words += "cost. Default: the changes that an agent's settings make in training."
    around = "a wrapper of the environment in training, not those in the settings; repeat it to "
    around += "add a wrapper around this one"
    metavar = ("NAME", "KEY:VALUE")
    flags = (
        flag("--env", "environment id (see train.py --list)", required=True),
        flag("--algo", "agent whose settings and discount count (default: ppo)", default="ppo"),
        *shared("--env-kwargs"),
        several("--train-env-kwargs", "environment arguments in training, not the settings'"),
        several("--wrapper", around, metavar, action="append"),
        *shared("--hyperparams", "--conf-file", "--gym-packages", "--json"),
    )
    parser = OneLineParser(words, EPILOG, {"": flags})
    parser.set_defaults(n_timesteps=1)
    return parser


def main() -> int:
    """Print the effect of the training rewards."""
    args = build_parser().parse_args()
    from rl_yardstick.pipeline.environments import make_single_env, training_changes

    console = TextConsole()
    spec = _spec(args)
    discount = _discount(spec)
    changes = ", ".join(training_changes(spec)) or "nothing"
    say(console, f"{spec.env_id}; changed in training: {changes}")
    with closing(make_single_env(spec)) as env:
        with console.status("planning"):
            compared = _compared(spec, env, discount)
        for line in compared.lines():
            say(console, line)
        if args.json is not None:
            cli.write_result(args, {"changes": changes, **compared.as_data()})
    return 0


# --- input ----------------------------------------------------------------------------------------


def _spec(args: argparse.Namespace) -> TrainSpec:
    from rl_yardstick.pipeline import settings
    from rl_yardstick.pipeline.environments import check_env_id

    cli.import_typed(args)
    settings.check_agent(args.algo)
    check_env_id(args.env)
    typed, read = cli.typed_settings(args, "-params"), settings.parse_assignments
    entry, _ = settings.changed_entry(args.algo, args.env, args.conf_file, typed)
    if args.train_env_kwargs or args.wrapper:
        entry["train_env_kwargs"] = read(args.train_env_kwargs, "--train-env-kwargs")
        entry["train_env_wrapper"] = [
            {name: read(kwargs, "--wrapper")} for name, *kwargs in args.wrapper
        ]
    spec = settings.read_spec(args.algo, args.env, entry, gym_packages=args.gym_packages)
    for key in ("normalize", "vec_env_wrapper"):
        if getattr(spec, key):
            raise UserError(f"{key}: the rewards that it makes have no model to compare")
    return spec


def _discount(spec: TrainSpec) -> float:
    """The discount of the settings, else the default of the agent's class."""
    from rl_yardstick.agents import load_algorithm
    from rl_yardstick.pipeline.components import constructor_parameters

    found = spec.algorithm.get("gamma")
    if found is None:
        parameter = constructor_parameters(load_algorithm(spec.algo)).get("gamma")
        found = None if parameter is None else parameter.default
    if not isinstance(found, int | float) or not 0 <= found <= 1:
        raise UserError(f"gamma: a discount from 0 to 1 is needed, not {found}")
    return float(found)


# --- results --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Compared:
    """The optimal policies of two rewards, compared."""

    env: gym.Env[Any, Any]  # in which policies are judged
    model: TransitionModel
    horizon: int
    effects: dict[float, Effect]  # by discount; the last one undiscounted, under the time limit

    def lines(self) -> Iterator[str]:
        """The comparison in words."""
        optimum = self.effects[1.0].optimum
        for discount, found in self.effects.items():
            told = "the same policies are optimal"
            if not found.is_same:
                of = f"{int(found.differs.sum()):,} of {int(self.model.reachable.sum()):,} states"
                told = f"NOT {told}: the best actions differ in {of}"
            limit = f"no discount, {self.horizon:,} steps"
            yield f"{f'discount {discount:g}' if discount < 1 else limit}: {told}"
            met = [place for place in self.places(found) if place["met"] > 0]
            for place in met[:MOST_STATES]:
                told = f"{place['met']:.1%} of episodes part here, worth {place['gain']:.4g}"
                if place["optimal"] != place["shaped"]:
                    sets = (" or ".join(place[name]) for name in ("optimal", "shaped"))
                    told = "best is {}, with the changes {}; {}".format(*sets, told)
                yield f"  {place['state']}: {told}"
            if not found.is_same and not met:
                yield "  nothing is lost in states that optimal policies with the changes reach"
            yield f"  {_cost(found, optimum)}"
        for discount, found in self.effects.items():
            if discount < 1:
                yield _potential(found)

    def places(self, found: Effect) -> list[dict[str, Any]]:
        """The states with other best actions, the largest loss of return first."""
        import numpy as np

        from rl_yardstick.envs.layout import action_names, grid_layout, state_name
        from rl_yardstick.mdp.gaps import first_differences

        states = np.flatnonzero(found.differs)
        if not len(states):
            return []
        policies = found.policy, found.worst_policy
        split = first_differences(self.model, *policies, self.horizon)
        layout, names = grid_layout(self.env), action_names(self.env)
        layout = layout if layout and layout.n_states == self.model.n_states else None
        named = [names[a] if a < len(names) else f"action {a}" for a in range(self.model.n_actions)]
        return [
            {
                "state": state_name(self.env, layout, int(state)),
                "optimal": [named[action] for action in np.flatnonzero(found.optimal[state])],
                "shaped": [named[action] for action in np.flatnonzero(found.shaped[state])],
                "met": float(split.met[state]),
                "gain": float(split.gains[state]),
            }
            for state in states[np.lexsort((-split.met[states], -split.gains[states]))]
        ]

    def as_data(self) -> dict[str, Any]:
        """The comparison as JSON data."""
        plain = ("optimum", "returns", "judged", "judged_before", "factor", "potential")
        objectives = [
            {
                **{name: getattr(found, name) for name in plain},
                "discount": discount,
                "time_limit": None if discount < 1 else self.horizon,
                "same": found.is_same,
                "cost": [found.optimum - each for each in found.returns],
                "states": self.places(found),
            }
            for discount, found in self.effects.items()
        ]
        return {"optimum": self.effects[1.0].optimum, "objectives": objectives}


def _compared(spec: TrainSpec, env: gym.Env[Any, Any], discount: float) -> Compared:
    """Compute optimal policies of both models; `UserError` if they cannot be compared."""
    from rl_yardstick.envs.known_models import time_limit
    from rl_yardstick.mdp.shaping import discounted_effect, effect_under_limit
    from rl_yardstick.pipeline.environments import make_single_env
    from rl_yardstick.pipeline.evaluation.exact import known_model

    with closing(make_single_env(spec, training=True)) as training:
        shaped = known_model(training, spec.env_id)
    original, horizon = known_model(env, spec.env_id), time_limit(env)
    assert horizon is not None  # evaluations always have one
    effects = {}
    with as_user_error(spec.env_id, ValueError):
        if discount < 1:
            effects[discount] = discounted_effect(original, shaped, discount, horizon)
        effects[1.0] = effect_under_limit(original, shaped, horizon)
    return Compared(env, original, horizon, effects)


def _cost(found: Effect, optimum: float) -> str:
    """The undiscounted returns of optimal policies, with and without the changes."""
    near = ROUNDING * max(1.0, abs(optimum))

    def span(best: float, worst: float, form: str = ".6g") -> str:
        ends = sorted((best, worst))
        return " to ".join(f"{end:{form}}" for end in ends[: 1 + (ends[1] - ends[0] > near)])

    lost = [one - other for one, other in zip(found.judged_before, found.judged, strict=True)]
    cost = "nothing" if max(map(abs, lost)) <= near else span(lost[0], lost[1], ".4g")
    told = f"with the changes optimal policies return {span(*found.judged)}"
    if optimum - found.judged_before[1] > near:
        told += f", without {span(*found.judged_before)}"
    return f"{told}; the optimum is {optimum:.6g}: the changes cost {cost}"


def _potential(found: Effect) -> str:
    """Whether the change of rewards is a potential difference (Ng, Harada and Russell, 1999)."""
    if found.factor is None or found.potential is None:
        return "the changed rewards are not the original ones plus the difference of a potential"
    factor = "" if found.factor == 1 else f"{found.factor:.6g} x "
    if not found.potential.any():
        return f"the changed rewards are {factor or 'equal to '}the original ones"
    low, high = found.potential.min(), found.potential.max()
    told = f"the changed rewards are {factor}the original ones plus the difference of a potential"
    return f"{told}, which goes from {low:.4g} to {high:.4g}"
