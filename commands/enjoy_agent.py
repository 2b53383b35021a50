"""``enjoy.py``: its flags, and what it does."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from commands.flag_values import (
    COUNT,
    COUNT_OR_NONE,
    SEED,
    THREADS,
    VERBOSITY,
    filled,
    whole_number,
)
from commands.parsing import MODULES_HELP, OneLineParser, as_called, called_as, program_name
from commands.streams import go_on_unread
from pipeline.failures import exits_as_mistakes
from pipeline.library_loading import loading_libraries
from pipeline.stopping import stops_noticed

if TYPE_CHECKING:
    from pipeline.models.choose import ChosenModel, ModelRequest

FRAMES = whole_number(1, 60)
STEPS = whole_number(1, besides={-1: "as many as the episodes take"})
RUN_NUMBER = whole_number(0, besides={-1: "the run without a number"})

EPILOG = """\
examples:
  python enjoy.py --env Warehouse-v0 --algo ppo
  python enjoy.py --env FrozenLake-v1 --algo qlearning --load-best --n-episodes 1000 --render none
  python enjoy.py --env Warehouse-v0 --algo sarsa --record route.gif --n-episodes 1
  python enjoy.py logs/dqn/CartPole-v1_3/rl_model_20000_steps.zip
  python enjoy.py --algo ppo --env MountainCar-v0 -f rl-trained-agents
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags; where rl_zoo3 has one, with its name and meaning."""
    parser = OneLineParser(
        prog=program_name(),
        description="Play a trained agent and print the returns of its episodes.",
        epilog=as_called(EPILOG),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "model",
        nargs="?",
        help="path of a model zip, a run folder or a pack (default: a run is looked for)",
    )
    add("--algo", type=filled, help="agent (default: ppo, or what the zip's run folder says)")
    add(
        "--env",
        type=filled,
        help="environment id (default: CartPole-v1, or what the run folder says)",
    )
    add("-f", "--folder", type=filled, default="logs", help="folder of all runs (default: logs)")
    add(
        "--exp-id",
        type=RUN_NUMBER,
        default=0,
        metavar="N",
        help="number of the run (default: 0, the newest; -1 for FOLDER/ALGO/ENV.zip itself)",
    )
    add("--load-best", action="store_true", help="the model with the best evaluation in training")
    add(
        "--load-checkpoint",
        type=COUNT_OR_NONE,
        metavar="STEPS",
        help="the checkpoint after that many steps",
    )
    add("--load-last-checkpoint", action="store_true", help="the last checkpoint")
    add(
        "--vec-normalize",
        metavar="FILE",
        help="statistics of VecNormalize (default: those saved with the model)",
    )
    add("--device", default="auto", help="torch device (default: auto)")
    add("--num-threads", type=THREADS, default=1, help="torch threads (1); -1 leaves it to torch")
    _add_playing_flags(parser)
    return parser


def _add_playing_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("playing").add_argument
    add(
        "-n",
        "--n-timesteps",
        type=STEPS,
        default=-1,
        metavar="N",
        help="stop after this many steps",
    )
    add(
        "--n-episodes",
        type=COUNT,
        metavar="N",
        help="episodes to play (default: 10, or as many as end within the steps of -n)",
    )
    add(
        "--n-envs",
        type=COUNT,
        default=1,
        metavar="N",
        help="environments to play on at once, each an equal share of the episodes (default: 1)",
    )
    policy = parser.add_mutually_exclusive_group()
    policy.add_argument(
        "--deterministic", action="store_true", help="the policy's best actions (default)"
    )
    policy.add_argument("--stochastic", action="store_true", help="sample actions, or explore")
    add("--seed", type=SEED, default=0, help="seed of the episodes (default: 0; -1: a random one)")
    add(
        "--render",
        choices=["human", "ansi", "none"],
        help="how to watch (default: human if there is a display, else none)",
    )
    add("--no-render", action="store_const", const="none", dest="render", help="--render none")
    add(
        "--fps",
        type=FRAMES,
        metavar="N",
        help="pictures a second of --render ansi on a terminal (default: 4)",
    )
    add("--record", type=filled, metavar="FILE", help="write a film, .gif or .mp4")
    add("--reward-log", metavar="DIR", help="also write the returns there, as Monitor's CSV files")
    add("--verbose", type=VERBOSITY, default=1, help="0 for no output (default: 1)")
    add("--norm-reward", action="store_true", help="returns of rewards as training normalised them")
    add("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="environment arguments")
    add(
        "--gym-packages",
        nargs="+",
        type=filled,
        default=[],
        metavar="MODULE",
        help=MODULES_HELP,
    )
    _add_flags_of_rl_zoo3(parser)


def _add_flags_of_rl_zoo3(parser: argparse.ArgumentParser) -> None:
    """Flags of its command that have nothing to do here; `check_playing` says so."""
    parser.add_argument("-P", "--progress", action="store_true", help=argparse.SUPPRESS)
    # It always does what this flag asks for, and so does this command.
    parser.add_argument("--custom-objects", action="store_true", help=argparse.SUPPRESS)


def main() -> int:
    """Parse the arguments and play; the exit code."""
    args = build_parser().parse_args()
    with stops_noticed(), exits_as_mistakes():
        return _play(args)


def _play(args: argparse.Namespace) -> int:
    from commands.enjoy_request import check_playing, model_request
    from pipeline.filming import check_film_path
    from pipeline.packing.pack_files import unpacked

    check_playing(args)
    film = None if args.record is None else Path(args.record)
    if film is not None:
        check_film_path(film)
    wanted = model_request(args)
    with ExitStack() as stack:
        if wanted.path is not None:
            path, zipped_in = stack.enter_context(unpacked(wanted.path))
            wanted = replace(wanted, path=path, zipped_in=zipped_in)
        return _play_found(args, wanted, film)


def _play_found(args: argparse.Namespace, wanted: ModelRequest, film: Path | None) -> int:
    found = _found_model(wanted)
    from commands.terminal import TextConsole
    from pipeline.signs_of_life import doing

    console = TextConsole(highlight=False, quiet=args.verbose < 1)
    place = args.model if wanted.zipped_in is not None else found.path
    about = f"{found.spec.algo} on {found.spec.env_id}: {place}"
    console.print(about, soft_wrap=True)
    with doing(console, "loading the libraries"), loading_libraries():
        from commands.playing_output import PlayingRequest, play
        from pipeline.models.choose import with_statistics

        chosen = with_statistics(found, wanted.statistics)
    if film is not None or args.reward_log:
        go_on_unread()
    n_steps = args.n_timesteps if args.n_timesteps >= 0 else None
    request = PlayingRequest(
        n_episodes=10 if args.n_episodes is None and n_steps is None else args.n_episodes,
        n_steps=n_steps,
        n_envs=args.n_envs,
        deterministic=not args.stochastic,
        render=args.render,
        film=film,
        monitor_folder=Path(args.reward_log) if args.reward_log else None,
        norm_reward=args.norm_reward,
        num_threads=args.num_threads,
        **({} if args.fps is None else {"fps": args.fps}),
    )
    play(console, chosen, request)
    return 0


def _found_model(wanted: ModelRequest) -> ChosenModel:
    from pipeline.errors import UserError
    from pipeline.models.choose import find_model
    from pipeline.runs import NoRunError

    try:
        return find_model(wanted)
    except NoRunError as error:
        flags = f"--algo {error.algo} --env {error.env_id} -f {error.log_folder}"
        raise UserError(f"{error}: train one with: {called_as('train')} {flags}") from error
