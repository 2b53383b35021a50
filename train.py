"""Train an agent on an environment: ``python train.py --env Warehouse-v0 --algo ppo``."""

from commands.parsing import run_command
from commands.train_agent import main

if __name__ == "__main__":
    run_command(main)
