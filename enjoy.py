"""Watch a trained agent: ``python enjoy.py --env Warehouse-v0 --algo ppo``."""

from commands.enjoy_agent import main
from commands.parsing import run_command

if __name__ == "__main__":
    run_command(main)
