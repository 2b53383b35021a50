"""``optimum``: the exact optimum of an environment, and its first best actions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import OneLineParser, flag, several, shared
from rl_yardstick.commands.terminal import say, scale_lines, table_console
from rl_yardstick.pipeline.errors import UserError

if TYPE_CHECKING:
    from rl_yardstick.mdp.transition_model import Bools, Ints
    from rl_yardstick.rating.worlds import World

EPILOG = """\
examples:
  python -m rl_yardstick optimum --env FrozenLake-v1 --env-kwargs map_name:8x8
  python -m rl_yardstick optimum --env Taxi-v4 --env-kwargs fickle_passenger:True --model 1000000
"""
MOST_STARTS, APART = 3, " " * 3  # starts that are named; between words and figures


def build_parser() -> OneLineParser:
    """The flags."""
    words = "Compute the highest expected return of any policy, exactly."
    told = flag("--env", "environment id, or module:Class", required=True, metavar="ID")
    own = (
        several("--ignore", "attributes that change nothing", "NAME"),
        several("--starts", "seeds of the only starts, equally likely", "SEED", type=cli.SEED),
    )
    common = shared("--env-kwargs", "--gym-packages", "--model", "--json")
    return OneLineParser(words, EPILOG, {"": [told, *common, *own]})


def main() -> int:
    """Print the optimum."""
    args = build_parser().parse_args()
    cli.import_typed(args)
    from rl_yardstick.envs import found_models

    found_models.limit(args.exact_model, args.ignore, args.starts)
    from rl_yardstick.pipeline.settings import parse_assignments

    found, lines = optimum_of(args.env, parse_assignments(args.env_kwargs, "--env-kwargs"))
    say(table_console(), "\n".join(lines))
    cli.write_result(args, {"env": args.env, **found})
    return 0


def optimum_of(env_id: str, kwargs: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The optimum of an environment: figures by name, and lines to print.

    Raises UserError where its model is not known.
    """
    import numpy as np

    from rl_yardstick import mdp
    from rl_yardstick.envs import known_models as known
    from rl_yardstick.pipeline.environments import with_files_read
    from rl_yardstick.pipeline.evaluation.exact import known_model
    from rl_yardstick.pipeline.evaluation.yardstick import Yardstick
    from rl_yardstick.rating.worlds import world_of

    world = world_of(env_id, with_files_read(env_id, {"env_kwargs": {**kwargs}})["env_kwargs"])
    model, horizon = known_model(world.env, env_id), known.time_limit(world.env)
    if horizon is None:
        raise UserError(f"{env_id} has no limit on steps, which the optimum needs")
    search = known.found_model(world.env)
    masks = known.action_masks_of_states(world.env) if search is None else search.mask
    values, actions = mdp.optimal_choices(model, horizon)
    if masks is not None:
        actions &= masks | ~model.reachable[:, None]
    best, baseline = float(model.initial @ values), float(mdp.baseline_return(model, horizon))
    n_states = int(model.reachable.sum())
    scale = Yardstick(best, baseline) if world.exact is None else world.exact.yardstick
    how = "of the environment" if search is None else f"found in its code in {search.seconds:.1f} s"
    lines = [
        f"{world.name}, at most {horizon:,} steps",
        f"optimum{APART}{best:,.7g}",
        *scale_lines(scale),
        f"model{APART}{how}: {n_states:,} states, {model.n_actions} actions",
        *(f"note{APART}{note}" for note in (() if search is None else search.notes)),
        *_first_actions(world, np.flatnonzero(model.initial), actions),
        world.map_of(actions.argmax(axis=1), ~model.reachable),
    ]
    figures = {"optimum": best, "baseline": baseline, "horizon": horizon, "states": n_states}
    seconds = None if search is None else search.seconds
    found = {**figures, "seconds": seconds, "values": values, "actions": actions}
    return found, [*filter(None, lines)]


def _first_actions(world: World, starts: Ints, actions: Bools) -> Iterator[str]:
    """The best actions in the first few starts."""
    from rl_yardstick.envs.layout import action_names, state_name

    names = action_names(world.env) or [f"action {action}" for action in range(actions.shape[1])]
    layout = None if world.exact is None else world.exact.layout
    for start in starts[:MOST_STARTS].tolist():
        best = [name for name, is_best in zip(names, actions[start], strict=True) if is_best]
        where = state_name(world.env, layout, start)
        yield f"start{APART}{where}: {' or '.join(best)}"
    if len(starts) > MOST_STARTS:
        yield f"start{APART}and {len(starts) - MOST_STARTS:,} others"
