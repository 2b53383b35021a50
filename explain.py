"""Explain an agent: ``python explain.py --env Warehouse-v0 --algo ppo``."""

try:
    from commands.cli import run_command
    from commands.explain import main
except KeyboardInterrupt:  # before there is anything to be stopped
    raise SystemExit(130) from None

if __name__ == "__main__":
    run_command(main)
