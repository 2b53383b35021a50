"""``compare.py --logged``: judges trained agents by logged pulls of a bandit."""

from __future__ import annotations

import argparse

from rl_yardstick.commands.terminal import table_console
from rl_yardstick.pipeline.errors import UserError

COLUMNS = ("arm", "reward", "propensity")


def compare_on_log(args: argparse.Namespace) -> int:
    """Judge the policies of ``--policy`` on the log of ``--logged``; return the exit code."""
    if not (args.logged and args.policy):
        raise UserError("--logged LOG.csv and --policy RUN go together: one of them is missing")
    if args.study or args.env or args.algos:
        raise UserError("give a study, --env and --algos, or --logged and --policy, not both")
    if twice := next((path for path in args.policy if args.policy.count(path) > 1), None):
        raise UserError(f"--policy names {twice} twice")
    columns = dict(word.partition("=")[::2] for word in args.columns)
    if wrong := next((name for name in columns if name not in COLUMNS or not columns[name]), None):
        raise UserError(f"--columns {wrong}: give names such as arm=item_id, of {COLUMNS}")
    console = table_console()
    from rl_yardstick.experiments.off_policy import compare_policies, load_policy, read_logged
    from rl_yardstick.report.terminal import print_comparison

    with console.status("judging the policies"):
        data = read_logged(args.logged, columns)
        policies = [load_policy(path, args.gym_packages) for path in args.policy]
        compared = compare_policies(data, policies)
    print_comparison(console, compared)
    return 0
