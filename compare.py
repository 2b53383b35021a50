"""Compare agents over seeds: ``python compare.py --env FrozenLake-v1 --algos qlearning dqn``."""

from commands.compare_agents import main
from commands.parsing import run_command

if __name__ == "__main__":
    run_command(main)
