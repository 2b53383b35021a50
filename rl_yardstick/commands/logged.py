"""``compare.py --logged``: judges trained agents by logged pulls of a bandit."""

from __future__ import annotations

import argparse
from pathlib import Path

from rl_yardstick.commands.terminal import say, table_console
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.signs_of_life import doing


def compare_on_log(args: argparse.Namespace) -> int:
    """Judge the policies of ``--policy`` on the log of ``--logged``; return the exit code."""
    from rl_yardstick.pipeline.user_modules import import_typed

    if not (args.logged and args.policy):
        raise UserError("--logged LOG.csv and --policy RUN go together: one of them is missing")
    if args.study or args.env or args.algos:
        raise UserError("give a study, --env and --algos, or --logged and --policy, not both")
    modules = import_typed(args.gym_packages)
    console = table_console(highlight=False)
    n = len(args.policy)
    say(console, f"{n} {'policy' if n == 1 else 'policies'} on {args.logged}")
    with doing(console, "reading the log") as activity:
        from rl_yardstick.experiments.off_policy.policy_files import find_policy, read_logged

        data = read_logged(args.logged)
        found = [find_policy(Path(path)) for path in args.policy]
        names = [policy.name for policy in found]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise UserError(f"--policy names {twice} twice")
        activity.now("loading the libraries")
        from rl_yardstick.experiments.off_policy.logged_policies import (
            compare_policies,
            load_policy,
        )

        activity.now("loading the policies")
        policies = [load_policy(policy, modules) for policy in found]
        activity.now("judging the policies")
        compared = compare_policies(data, policies)
    from rl_yardstick.report.terminal import print_comparison

    print_comparison(console, compared)
    return 0
