"""``enjoy.py``: its flags, and what it does."""

from __future__ import annotations

import argparse
from pathlib import Path

from commands.parsing import OneLineParser

EPILOG = """\
examples:
  python enjoy.py --env Warehouse-v0 --algo ppo
  python enjoy.py --env FrozenLake-v1 --algo qlearning --load-best --n-episodes 1000 --render none
  python enjoy.py --env Warehouse-v0 --algo sarsa --record route.gif --n-episodes 1
  python enjoy.py logs/dqn/CartPole-v1_3/rl_model_20000_steps.zip
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags; where rl_zoo3 has one, with its name and meaning."""
    parser = OneLineParser(
        prog="enjoy.py",
        description="Play a trained agent and print the returns of its episodes.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("model", nargs="?", help="path of a model zip, instead of looking for a run")
    add("--algo", help="agent (default: ppo, or what the zip's run folder says)")
    add("--env", help="environment id (default: CartPole-v1, or what the run folder says)")
    add("-f", "--folder", default="logs", help="folder above all runs (default: logs)")
    add("--exp-id", type=int, default=0, metavar="N", help="number of the run (default: newest)")
    add("--load-best", action="store_true", help="the model that evaluated best in training")
    add("--load-checkpoint", type=int, metavar="STEPS", help="the checkpoint after that many steps")
    add("--load-last-checkpoint", action="store_true", help="the last checkpoint")
    add("--trust", action="store_true", help="load a library zip from outside the log folder")
    add("--device", default="auto", help="torch device (default: auto)")
    add("--num-threads", type=int, default=1, help="torch threads (default: 1)")
    _add_playing_flags(parser)
    return parser


def _add_playing_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("playing").add_argument
    add("-n", "--n-timesteps", type=int, default=-1, metavar="N", help="stop after so many steps")
    add("--n-episodes", type=int, default=10, metavar="N", help="episodes to play (default: 10)")
    policy = parser.add_mutually_exclusive_group()
    policy.add_argument(
        "--deterministic", action="store_true", help="the policy's best actions (default)"
    )
    policy.add_argument("--stochastic", action="store_true", help="sample actions, or explore")
    add("--seed", type=int, default=0, help="seed of the episodes (default: 0)")
    add(
        "--render",
        choices=["human", "ansi", "none"],
        help="how to watch (default: human where there is a display, else none)",
    )
    add("--no-render", action="store_const", const="none", dest="render", help="--render none")
    add("--record", metavar="FILE", help="write a film, .gif or .mp4")
    add("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="environment arguments")
    add("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules with environments")


def main() -> int:
    """Parse the arguments and play; the exit code."""
    args = build_parser().parse_args()
    from commands.enjoy_request import model_request
    from pipeline.filming import check_film_path
    from pipeline.model_choice import choose_model

    film = None if args.record is None else Path(args.record)
    if film is not None:
        check_film_path(film)
    chosen = choose_model(model_request(args))
    from rich.console import Console

    from pipeline.signs_of_life import doing

    console = Console(highlight=False)
    about = f"{chosen.spec.algo} on {chosen.spec.env_id}: {chosen.path}"
    console.print(about, markup=False, soft_wrap=True)
    with doing(console, "loading the libraries"):
        from commands.playing_output import PlayingRequest, play

    request = PlayingRequest(
        n_episodes=args.n_episodes,
        n_steps=args.n_timesteps if args.n_timesteps >= 0 else None,
        deterministic=not args.stochastic,
        render=args.render,
        film=film,
        num_threads=args.num_threads,
    )
    play(console, chosen, request)
    return 0
