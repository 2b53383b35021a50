"""The flags of ``train.py``."""

from __future__ import annotations

import argparse

from commands.flag_values import (
    BUDGET,
    COUNT,
    INTERVAL,
    LOG_INTERVAL,
    SEED,
    THREADS,
    VERBOSITY,
    add_engine_flag,
    filled,
    save_interval,
    whole_number,
)
from commands.parsing import MODULES_HELP, OneLineParser, as_called, program_name

WATCHED = whole_number(1, besides={0: "those of the first 5,000 steps"})

# The flags of an interrupted run, by the names of their values.
RESUMING = ("resume", "resume_or_start", "save_state_every", "keep_state")

EPILOG = """\
examples:
  python train.py --env Warehouse-v0 --algo ppo --engine auto
  python train.py --env FrozenLake-v1 --algo qlearning --n-episodes 5000 --seed 0
  python train.py --env CartPole-v1 --algo dqn -params learning_rate:lin_0.003 buffer_size:50000
  python train.py --env Warehouse-v0 --algo sarsa --env-kwargs shelf_reward:-1 slip:0.1
  python train.py --resume logs/ppo/Warehouse-v0_3
  python train.py --list
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags, with the names and meanings that rl_zoo3 gives them."""
    parser = OneLineParser(
        prog=program_name(),
        description="Train an agent and leave a run folder with its models, curves and settings.",
        epilog=as_called(EPILOG),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--algo", default="ppo", help="agent (default: ppo; see --list)")
    add("--env", default="CartPole-v1", help="environment id (default: CartPole-v1; see --list)")
    add("--list", action="store_true", help="list agents and environments, and which fit which")
    _add_training_flags(parser)
    _add_output_flags(parser)
    _add_resuming_flags(parser)
    return parser


def _add_resuming_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("continuing an interrupted run").add_argument
    add(
        "--resume",
        nargs="?",
        const="",
        metavar="RUN",
        help="continue this run, or the newest unfinished one of --algo and --env, to the same "
        "result as without the interruption; budget, seed and settings are those of the run",
    )
    add(
        "--resume-or-start",
        action="store_true",
        help="continue the newest run with exactly these settings, begin one if there is none, and "
        "do nothing if it is finished: for scripts that a queue starts again",
    )
    add(
        "--save-state-every",
        type=save_interval,
        default="auto",
        metavar="N",
        help="how often to save the state from which --resume continues: 30s, 5m, 5000 (steps), "
        "never, or auto, which takes about 2%% of the time (default)",
    )
    add("--keep-state", action="store_true", help="keep the state of a finished run")


def _add_training_flags(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("budget and settings")
    add = group.add_argument
    add("-n", "--n-timesteps", type=BUDGET, default=-1, metavar="N", help="environment steps")
    add("--n-episodes", type=BUDGET, default=-1, metavar="N", help="episodes instead of steps")
    add("--seed", type=SEED, default=-1, help="seed of everything (default: a random one)")
    add(
        "-params",
        "--hyperparams",
        nargs="+",
        default=[],
        metavar="KEY:VALUE",
        help="hyperparameters to change, e.g. learning_rate:0.01",
    )
    add_engine_flag(group)
    add(
        "-conf",
        "--conf-file",
        type=filled,
        metavar="YAML",
        help="hyperparameters from another file",
    )
    add("--env-kwargs", nargs="+", default=[], metavar="KEY:VALUE", help="environment arguments")
    add(
        "--eval-env-kwargs",
        nargs="+",
        default=[],
        metavar="KEY:VALUE",
        help="environment arguments for evaluation only",
    )
    add(
        "--gym-packages",
        nargs="+",
        type=filled,
        default=[],
        metavar="MODULE",
        help=MODULES_HELP,
    )
    add(
        "-i",
        "--trained-agent",
        default="",
        metavar="ZIP",
        help="train this agent (zip or run folder) for -n further steps, in a new run folder; its "
        "statistics, replay buffer, step counter and schedules continue; hyperparameters are those "
        "given here or in the file",
    )
    add("--vec-env", choices=["dummy", "subproc"], default="dummy", help="kind of VecEnv")
    add("--device", default="auto", help="torch device (default: auto)")
    add("--num-threads", type=THREADS, default=1, help="torch threads (1); -1 leaves it to torch")


def _add_output_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("evaluation and output").add_argument
    add("--eval-freq", type=INTERVAL, metavar="N", help="steps between evaluations; -1 for none")
    add(
        "--eval-episodes",
        type=COUNT,
        metavar="N",
        help="episodes of each evaluation, the final one too (default: as few as are precise "
        "enough, up to 20, at the end up to 100)",
    )
    add(
        "--n-eval-envs",
        type=COUNT,
        default=10,
        metavar="N",
        help="environments to evaluate on (10)",
    )
    add("--save-freq", type=INTERVAL, default=-1, metavar="N", help="steps between checkpoints")
    add("--save-replay-buffer", action="store_true", help="save it too, if the agent has one")
    add("-f", "--log-folder", type=filled, default="logs", help="folder of all runs (logs)")
    add("-uuid", "--uuid", action="store_true", help="add a unique id to the run folder's name")
    add("-tb", "--tensorboard-log", default="", metavar="DIR", help="write TensorBoard logs there")
    add(
        "--log-interval",
        type=LOG_INTERVAL,
        default=-1,
        metavar="N",
        help="episodes (PPO, A2C: rollouts) between log records; -2 for none",
    )
    add(
        "--verbose",
        type=VERBOSITY,
        default=1,
        help="0 silent, 1 progress and summary (default), 2 the library's tables as well",
    )
    add("-P", "--progress", action="store_true", help="a progress bar even without a terminal")
    add(
        "--watch-learning",
        type=filled,
        metavar="FILE",
        help="write a page (.html) that plays the training: each update of a table, or what a "
        "network does in each state, at every evaluation",
    )
    add(
        "--watch-episodes",
        type=WATCHED,
        default=0,
        metavar="N",
        help="the first episodes of a table (default: the steps in which its policy gets better)",
    )
