"""The flags of ``tune.py``."""

from __future__ import annotations

import argparse

from commands.flag_values import (
    COUNT,
    RUN_TIMEOUT,
    add_engine_flag,
    filled,
    folder_name,
    whole_number,
)
from commands.parsing import MODULES_HELP, OneLineParser, as_called, program_name
from commands.places import add_limit_flags, add_place_flags
from tuning.pruning import PRUNERS
from tuning.tuning_spec import FIGURES, OBJECTIVES, SAMPLERS

TRIALS = whole_number(1, 100_000)
SEEDS = whole_number(1, 1000)
FIRST_SEED = whole_number(0, 2**31)

EPILOG = """\
examples:
  python tune.py --env Warehouse-v0 --algo ppo --trials 100
  python tune.py --env FrozenLake8x8-v1 --algo ppo --engine auto -j 4
  python tune.py --env CartPole-v1 --algo dqn --seeds-per-trial 10 --objective lower
  python tune.py --env Taxi-v4 --algo qlearning --sampler grid --storage journal:shared/taxi.log

The same command again continues the search; several at once share the work.
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags; those of runs mean what they mean to train and compare, the others to rl_zoo3."""
    parser = OneLineParser(
        prog=program_name(),
        description="Search for an agent's hyperparameters: judge each setting over several seeds, "
        "run the best again on other seeds, and save a setting that is better there.",
        epilog=as_called(EPILOG),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--algo", required=True, metavar="AGENT", help="agent (train --list has them)")
    add("--env", required=True, metavar="ID", help="environment")
    _add_search_flags(parser)
    _add_retest_flags(parser)
    _add_run_flags(parser)
    _add_output_flags(parser)
    # Who comes from rl_zoo3 types it; what it asks for is what this command is.
    add("-optimize", "--optimize-hyperparameters", action="store_true", help=argparse.SUPPRESS)
    return parser


def _add_search_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("search").add_argument
    add(
        *("--trials", "--n-trials", "--max-total-trials"),
        dest="n_trials",
        type=TRIALS,
        default=100,
        metavar="N",
        help="settings to try, over all drivers (100)",
    )
    add(
        "--seeds-per-trial",
        type=SEEDS,
        default=5,
        metavar="N",
        help="seeds of each trial (5)",
    )
    add(
        "--first-seed", type=FIRST_SEED, default=0, metavar="N", help="the first of these seeds (0)"
    )
    add(
        "--objective",
        choices=OBJECTIVES,
        default="mean",
        help="which figure of a trial's runs counts: mean (default), interquartile mean, or lower "
        "quartile",
    )
    add(
        "--metric",
        choices=FIGURES,
        help="which figure of a run counts (default: score, the final policy's return between the "
        "best random or constant policy, 0, and the optimum, 1; the return if no optimum is known; "
        "on bandits regret); steps and seconds count until the threshold",
    )
    add("--threshold", type=float, metavar="RETURN", help="the return that counts as solved")
    add("--sampler", choices=SAMPLERS, default="tpe", help="what suggests settings (tpe)")
    add(
        "--pruner",
        choices=tuple(PRUNERS),
        default="auto",
        help="rule that ends hopeless trials (auto)",
    )
    add(
        "--n-startup-trials",
        type=whole_number(0, 100_000),
        default=10,
        metavar="N",
        help="trials at random before the sampler learns from them (10)",
    )
    add(
        "--search-space",
        type=filled,
        metavar="YAML",
        help="the values to choose from (default: hyperparams/search_spaces/AGENT.yml)",
    )
    add("--seed", type=whole_number(0, 2**32 - 1), default=0, help="seed of the search (0)")
    add(
        "--timeout",
        type=RUN_TIMEOUT,
        metavar="TIME",
        help="begin no more runs after this time, e.g. 50m; then comes the re-test",
    )


def _add_retest_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("re-test").add_argument
    add(
        "--retest",
        type=whole_number(0, 100),
        default=3,
        metavar="K",
        help="run the best K settings and the shipped ones again on other seeds (3; 0 for none)",
    )
    add("--retest-seeds", type=SEEDS, default=20, metavar="N", help="how many other seeds (20)")
    add(
        "--first-retest-seed",
        type=FIRST_SEED,
        default=1000,
        metavar="N",
        help="the first of these seeds (1000)",
    )


def _add_run_flags(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("runs")
    add = group.add_argument
    add("-n", "--n-timesteps", type=COUNT, metavar="N", help="environment steps of each run")
    add("--n-episodes", type=COUNT, metavar="N", help="episodes instead of steps")
    add(
        *("-params", "--hyperparams"),
        nargs="+",
        default=[],
        metavar="KEY:VALUE",
        help="hyperparameters of every trial, which are not searched, e.g. gamma:0.99",
    )
    add_engine_flag(group)
    add("-conf", "--conf-file", type=filled, metavar="YAML", help="start from another file's entry")
    add("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="environment arguments")
    add("--gym-packages", nargs="+", type=filled, default=[], metavar="MODULE", help=MODULES_HELP)
    add("--eval-freq", type=COUNT, metavar="N", help="steps between two evaluations")
    add("--eval-episodes", type=COUNT, metavar="N", help="episodes of a sampled evaluation (20)")
    add_place_flags(group)
    add_limit_flags(group)


def _add_output_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("output").add_argument
    add(
        "--storage",
        type=filled,
        metavar="WHERE",
        help="where trials are: journal:FILE, sqlite:///FILE, postgresql://..., grpc://HOST:PORT "
        "(default: a SQLite file in the search's folder)",
    )
    add(
        *("--name", "--study-name"),
        dest="name",
        type=folder_name,
        help="name of the search and its folder (default: ENV_AGENT)",
    )
    add(
        *("-f", "--log-folder", "--optimization-log-path"),
        dest="log_folder",
        type=filled,
        default="logs/tuning",
        help="folder of all searches (logs/tuning)",
    )
    add(
        *("--no-report", "--no-optim-plots"),
        dest="no_report",
        action="store_true",
        help="only tables: no figures and no page",
    )
