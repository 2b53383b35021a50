"""``python compare.py --help``."""

from rl_yardstick.commands import run_command

if __name__ == "__main__":
    run_command("compare")
