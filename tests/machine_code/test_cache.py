"""Machine code is what the sources say, whatever was compiled before."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from numba.core import event

from rl_yardstick.machine_code import WorkTime
from rl_yardstick.machine_code import compiling as code_cache
from rl_yardstick.machine_code.compiling import called, compile_timer, compiled, inlined, kernel

# A function, and another of another file that it is compiled into.
RULE = """
from rl_yardstick.machine_code.compiling import inlined

@inlined
def rule(x):
    return 3.0 * x
"""
LOOP = """
from rl_yardstick.mdp.small_rule import rule
from rl_yardstick.machine_code.compiling import kernel

@kernel
def run_small(x):
    return rule(x) + 1.0
"""
# Prints the result, and how often the loop was compiled.
SMALL = """
import logging
names = []
logging.getLogger("rl_yardstick.machine_code.compiling").setLevel(logging.INFO)
logging.Handler.handle = lambda handler, record: names.append(record.getMessage())
logging.getLogger().addHandler(logging.Handler())
from rl_yardstick.mdp.small_loop import run_small
print(int(run_small(4.0)), names.count("compiling run_small"))
"""


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A copy of the packages that train, with nothing compiled."""
    root = tmp_path_factory.mktemp("checkout")
    for package in ("safe_files", "machine_code", "mdp", "agents", "envs"):
        copy, ignored = root / "rl_yardstick" / package, shutil.ignore_patterns("__pycache__")
        shutil.copytree(code_cache.ROOT / package, copy, ignore=ignored)
    shutil.copy(code_cache.ROOT / "__init__.py", root / "rl_yardstick")
    (root / "rl_yardstick" / "mdp" / "small_loop.py").write_text(LOOP)
    return root


def run(root, code):
    """The words that code prints which imports the copy."""
    variables = {**os.environ, "PYTHONPATH": str(root)}
    variables.pop("NUMBA_CACHE_DIR", None)
    command, told = [sys.executable, "-c", code], {"capture_output": True, "text": True}
    done = subprocess.run(command, cwd=root, env=variables, check=False, **told)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_a_changed_rule_in_another_file_is_what_runs(checkout):
    rule = checkout / "rl_yardstick" / "mdp" / "small_rule.py"
    times = "3.0", "5.0", "3.0"  # back again, the cached code is still there
    for factor, expected in zip(times, (["13", "1"], ["21", "1"], ["13", "0"]), strict=True):
        rule.write_text(RULE.replace("3.0", factor))
        assert run(checkout, SMALL) == expected
    # A process that began with other sources caches nothing.
    rule.write_text(RULE.replace("3.0", "2.0"))
    began = "from rl_yardstick import mdp\nfrom rl_yardstick.machine_code.compiling import folder\n"
    edited = f"folder()\nopen({str(rule)!r}, 'a').write('# more')\n{SMALL}"
    counted = "print(len(list(folder().rglob('*.nb[ic]'))))"
    assert run(checkout, began + edited + counted) == ["9", "1", "0"]


OWN_RULE = """
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.agents.tabular.q_learning_and_sarsa import QLearning
WORTH = {worth}

@inlined
def own_value(agent, env, progress, table):
    return WORTH

class Own(QLearning):
    next_value = own_value
"""
USE = """
import numpy as np
from own_rules import Own
from rl_yardstick.agents.common.algorithm import Transitions
# Not a whole training, whose other functions would be compiled too.
model = Own(env="FrozenLake-v1", learning_rate=1.0, gamma=1.0)
model._begin_episodes()
zero, no = np.array([0]), np.array([False])
model._learn_from(Transitions(zero, zero, np.zeros(1), no, no, zero))
print(float(model.policy.q_table[0, 0]))
"""


def test_a_rule_of_the_users_own_follows_its_source(checkout):
    module = checkout / "own_rules.py"
    for worth in (7.0, 9.0):
        module.write_text(OWN_RULE.format(worth=worth))
        assert run(checkout, USE) == [str(worth)]


def test_old_machine_code_goes_away(tmp_path):
    for age in range(code_cache.KEPT_BESIDE + 3):
        (tmp_path / str(age)).mkdir()
        os.utime(tmp_path / str(age), (1000 - age, 1000 - age))
    oldest, *kept = str(age), *map(str, range(code_cache.KEPT_BESIDE))
    code_cache.remove_old(tmp_path / oldest)  # the one in use
    assert {path.name for path in tmp_path.iterdir()} == {oldest, *kept}


@pytest.mark.parametrize("has_home", [True, False])
def test_where_the_package_cannot_be_written_the_home_serves_or_nothing(
    has_home, tmp_path, monkeypatch, caplog
):
    # A file in the place of a folder stops root as well.
    (tmp_path / "__pycache__").write_text("")
    home = tmp_path / "home"
    if not has_home:
        home.write_text("")
    monkeypatch.setattr(code_cache, "ROOT", tmp_path)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    found = code_cache.folder.__wrapped__()
    place = home / "yardstick" / "machine_code"
    assert (list(place.iterdir()) == [found]) if has_home else (found is None)
    assert ("each process compiles anew" in caplog.text) != has_home


@called
def scale(numbers, factor):
    for i in range(len(numbers)):
        numbers[i] *= factor


@inlined
def total(numbers, times):
    result = 0.0
    for i in range(len(numbers)):
        result += numbers[i]
    return times * result


@kernel
def scaled_total(numbers, times):
    scale(numbers, 2)
    scale(numbers, times)
    return total(numbers, 1) + total(numbers, times)


def test_parts_are_compiled_once_and_only_python_is_refused():
    numbers = np.array([1.0, 2.5])
    with pytest.raises(TypeError, match="only compiled functions can call scale"):
        scale(numbers, 2)
    with event.install_recorder("numba:compile") as noted:
        assert scaled_total(numbers, 3) == 4 * 6 * 3.5
    begun = [one.data["dispatcher"].py_func.__name__ for _, one in noted.buffer if one.is_start]
    # Numbers that are written out are none of their own type.
    assert sorted(begun) == ["scale", "scaled_total", "total"]
    assert numbers.tolist() == [6.0, 15.0]
    with pytest.raises(TypeError, match="only compiled functions can call scale"):
        scale(numbers, 2)
    assert total(numbers, 2) == 42


def test_compiling_is_timed_as_a_whole():
    @compiled
    def inner(x):
        return x * np.pi + 1

    @compiled
    def outer(x):
        return inner(x) - np.pi

    begun = WorkTime.now()
    with compile_timer() as time_compiling:
        assert time_compiling() == WorkTime()
        outer(2.0)
        first = time_compiling()
        outer(3.0)
        assert time_compiling() == first
    taken = WorkTime.now() - begun
    assert 0 < first.seconds <= taken.seconds
    assert 0 < first.cpu_seconds <= taken.cpu_seconds
