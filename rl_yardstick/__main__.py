"""``python -m rl_yardstick COMMAND`` is the installed command ``yardstick COMMAND``."""

from rl_yardstick.commands import main

if __name__ == "__main__":
    main()
