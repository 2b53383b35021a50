"""Say whether an algorithm is right: ``python audit.py --algo qlearning``."""

try:
    from commands.audit import main
    from commands.cli import run_command
except KeyboardInterrupt:  # before there is anything to be stopped
    raise SystemExit(130) from None

if __name__ == "__main__":
    run_command(main)
