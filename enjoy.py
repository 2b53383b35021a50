"""Watch a trained agent: ``python enjoy.py --env Warehouse-v0 --algo ppo``."""

try:
    from commands.enjoy_agent import main
    from commands.parsing import run_command
except KeyboardInterrupt:  # before there is anything to be stopped
    raise SystemExit(130) from None

if __name__ == "__main__":
    run_command(main)
