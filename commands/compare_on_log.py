"""``compare.py --logged``: policies judged on logged pulls."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from commands.terminal import table_console
from pipeline.errors import UserError
from pipeline.signs_of_life import Activity, doing
from pipeline.user_modules import UserModule, import_typed

if TYPE_CHECKING:
    from experiments.off_policy.logged_policies import Comparison


def compare_on_log(args: argparse.Namespace) -> int:
    """Judge the policies of ``--policy`` on the log of ``--logged``; the exit code.

    Raises:
        UserError: if one of them cannot be read, or they do not go together.
    """
    if not (args.logged and args.policy):
        raise UserError("--logged LOG.csv and --policy RUN go together: one of them is missing")
    if args.study or args.env or args.algos:
        raise UserError("give a study, --env and --algos, or --logged and --policy, not both")
    modules = import_typed(args.gym_packages)
    console = table_console(highlight=False)
    n = len(args.policy)
    about = f"{n} {'policy' if n == 1 else 'policies'} on {args.logged}"
    console.print(about, soft_wrap=True)
    with doing(console, "reading the log") as activity:
        compared = _compare(args, modules, activity)
    from report.off_policy_table import print_comparison

    print_comparison(console, compared)
    return 0


def _compare(
    args: argparse.Namespace, modules: Sequence[UserModule], activity: Activity
) -> Comparison:
    from experiments.off_policy.policy_files import find_policy, read_logged

    data = read_logged(args.logged)
    found = [find_policy(Path(path)) for path in args.policy]
    names = [policy.name for policy in found]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UserError(f"--policy names {twice} twice")
    activity.now("loading the libraries")
    from experiments.off_policy.logged_policies import compare_policies, load_policy

    activity.now("loading the policies")
    policies = [load_policy(policy, modules) for policy in found]
    activity.now("judging the policies")
    return compare_policies(data, policies)
