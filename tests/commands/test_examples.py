"""Each example of each ``--help``, but for its length, in a folder with what it names."""

import importlib
import pickle
import re
import shlex
import shutil

import numpy as np

from rl_yardstick.commands import COMMANDS

# What makes an example short, in place of its own words or behind them.
LENGTHS = {"--n-episodes 5000": "--n-episodes 20", "--algo ppo --engine auto": "--algo ppo -n 64"}
LENGTHS |= {"enjoy.py": "enjoy.py --render none -n 20", "logs/my": "logs/studies/my"}
LONG = ("compare", "tune", "audit")  # of these only the flags are read
FIRST = """
train.py --algo ppo --env Warehouse-v0 -n 64 --seed 0
train.py --algo sarsa --env Warehouse-v0 -n 64
train.py --algo ppo --env CartPole-v1 -n 64 -f rl-trained-agents
train.py --algo dqn --env CartPole-v1 -n 20000 --save-freq 20000 -params learning_starts:20000
compare.py --algos dqn --env Taxi-v4 -n 20 --seeds 1 --name my_study --no-report
"""


def test_every_example_works(typed, own_folder, in_this_process):
    names = [command.replace("-", "_") for command in COMMANDS]
    modules = [importlib.import_module(f"rl_yardstick.commands.{name}") for name in names]
    texts = [getattr(module, "EPILOG", "") for module in modules]
    examples = [line for text in texts for line in re.findall(r"^  (python .*)$", text, re.M)]
    assert len(examples) >= 20
    (own_folder / "homework").mkdir()
    for name, n in {"q_table.npy": 16, "homework/a.npy": 500}.items():
        np.save(own_folder / name, np.zeros((n, 6 if n == 500 else 4)))
    (own_folder / "q.pkl").write_bytes(pickle.dumps({state: [0, 0, 1, 0] for state in range(64)}))
    (own_folder / "script.py").write_text("def policy(hand):\n    return int(hand[0] < 17)\n")
    for example in [*FIRST.strip().splitlines(), "", *examples]:
        if not example:  # these are the third runs, one of them without an end
            logs = own_folder / "logs"
            for run in ("ppo/Warehouse-v0_", "dqn/CartPole-v1_"):
                shutil.copytree(logs / f"{run}1", logs / f"{run}3")
            record = logs / "ppo" / "Warehouse-v0_3" / "run.json"
            record.write_text(record.read_text().replace('"finished"', '"interrupted"'))
            continue
        line = example.removeprefix("python ").removeprefix("-m rl_")
        for words, short in LENGTHS.items():
            line = line.replace(words, short)
        words = shlex.split(line, comments=True)
        command, *flags = words[words[0] == "yardstick" :]
        if command.removesuffix(".py") in LONG and "my_study" not in line:
            module = importlib.import_module(f"rl_yardstick.commands.{command.removesuffix('.py')}")
            module.build_parser().parse_args(flags)
            continue
        typed.done(*words)
