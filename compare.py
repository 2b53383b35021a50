"""Compare agents over seeds: ``python compare.py --env FrozenLake-v1 --algos qlearning dqn``."""

try:
    from rl_yardstick.commands.cli import run_command
    from rl_yardstick.commands.compare import main
except KeyboardInterrupt:  # during the imports
    raise SystemExit(130) from None

if __name__ == "__main__":
    run_command(main)
