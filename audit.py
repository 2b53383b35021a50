"""Check an algorithm for faults: ``python audit.py --algo qlearning``."""

try:
    from commands.audit import main
    from commands.cli import run_command
except KeyboardInterrupt:  # during the imports
    raise SystemExit(130) from None

if __name__ == "__main__":
    run_command(main)
