"""Explain an agent's gap to the optimum: ``python explain.py --env Warehouse-v0 --algo ppo``."""

try:
    from commands.cli import run_command
    from commands.explain import main
except KeyboardInterrupt:  # during the imports
    raise SystemExit(130) from None

if __name__ == "__main__":
    run_command(main)
