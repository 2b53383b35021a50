"""Search for an agent's hyperparameters: ``python tune.py --env Warehouse-v0 --algo ppo``."""

try:
    from rl_yardstick.commands.cli import run_command
    from rl_yardstick.commands.tune import main
except KeyboardInterrupt:  # during the imports
    raise SystemExit(130) from None

if __name__ == "__main__":
    run_command(main)
