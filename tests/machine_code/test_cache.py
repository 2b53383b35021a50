"""Machine code is what the sources say, whatever was compiled before."""

import os
import pickle
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from rl_yardstick import agents
from rl_yardstick.machine_code import cache as code_cache
from rl_yardstick.machine_code import sources

PACKAGES = Path(agents.__file__).resolve().parents[1]

# What is compiled in this process, and what is said of it besides.
NOTE = """
import gc, logging, sys
gc.disable()  # what is made in so short a process stays
names = []
class Note(logging.Handler):
    def emit(self, record):
        names.append(record.getMessage())
log = logging.getLogger("rl_yardstick.machine_code")
log.addHandler(Note()); log.setLevel(logging.INFO); log.propagate = False
"""

# A function, and another of another file that it is compiled into.
RULE = """
from rl_yardstick.machine_code.compiling import inlined

@inlined
def rule(x):
    return 3.0 * x
"""
LOOP = """
from rl_yardstick.agents.common.small_rule import rule
from rl_yardstick.machine_code.compiling import kernel

@kernel
def run_small(x):
    return rule(x) + 1.0
"""
SMALL = f"""{NOTE}
from rl_yardstick.agents.small_loop import run_small
print(int(run_small(4.0)), "compiled", int("compiling run_small" in names))
"""


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A copy of what trains, and nothing compiled in it."""
    root = tmp_path_factory.mktemp("checkout")
    packages = root / "rl_yardstick"
    for package in ("safe_files", "machine_code", "mdp", "agents", "envs"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(PACKAGES / package, packages / package, ignore=ignored)
    shutil.copy(PACKAGES / "__init__.py", packages)
    (packages / "agents" / "common" / "small_rule.py").write_text(RULE)
    (packages / "agents" / "small_loop.py").write_text(LOOP)
    return root


def run(root, code=SMALL, **environment):
    variables = {**os.environ, "PYTHONPATH": str(root), **environment}
    variables.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        cwd=root,
        env=variables,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done


def outcome(root, code=SMALL, **environment):
    """What it comes to, by which engine, and whether the loop was compiled."""
    value, engine, compiled = run(root, code, **environment).stdout.split()
    return int(value), engine, compiled == "1"


class Payload:
    """Makes a folder where it is unpickled."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return os.mkdir, (self.mark,)


def test_a_changed_rule_is_what_runs_and_files_that_do_not_serve_are_replaced(checkout, tmp_path):
    # The rule stands in another file than the loop. Back again, what was compiled is still there.
    rule = checkout / "rl_yardstick" / "agents" / "common" / "small_rule.py"
    first, second = RULE.replace("3.0", "7.0"), RULE.replace("3.0", "5.0")
    for text, value, is_compiled in ((first, 29, True), (second, 21, True), (first, 29, False)):
        rule.write_text(text)
        assert outcome(checkout) == (value, "compiled", is_compiled)
    cached = checkout / "rl_yardstick" / "agents" / "__pycache__" / "machine_code"
    files = sorted(cached.rglob("*.nb[ic]"))
    for place, path in enumerate(files):
        path.write_bytes(path.read_bytes()[: place % 2 * path.stat().st_size // 2])
    for is_compiled in (True, False):
        assert outcome(checkout) == (29, "compiled", is_compiled)
    for path in files:  # that anyone may have written
        path.write_bytes(pickle.dumps(Payload(tmp_path / "mark")))
        path.chmod(0o666)
    said = f"{SMALL}print(sum('cannot be used' in name for name in names))"
    assert run(checkout, said).stdout.split() == ["29", "compiled", "1", "1"]
    assert not (tmp_path / "mark").exists()
    rule.write_text(RULE)


OWN_RULE = """
import gc
gc.disable()
from rl_yardstick.machine_code.compiling import inlined
from rl_yardstick.agents.tabular.one_step import QLearning
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
def q(cls):
    # Not a whole training, whose other functions would be compiled too.
    model = cls(env="FrozenLake-v1", learning_rate=1.0, gamma=1.0)
    model._begin_episodes()
    zero, no = np.array([0]), np.array([False])
    model._learn_from(Transitions(zero, zero, np.zeros(1), no, no, zero))
    return float(model.policy.q_table[0, 0])
print(q(Own))
"""


def test_a_rule_of_the_users_own_follows_its_source(checkout):
    module = checkout / "own_rules.py"
    for worth in (7.0, 9.0):
        module.write_text(OWN_RULE.format(worth=worth))
        assert run(checkout, USE).stdout.split() == [str(worth)]
    module.unlink()


def test_old_machine_code_goes_away(tmp_path):
    for age in range(code_cache.KEPT_BESIDE + 3):
        (tmp_path / f"old{age}").mkdir()
        os.utime(tmp_path / f"old{age}", (1000 - age, 1000 - age))
    used = tmp_path / "used"
    used.mkdir()
    os.utime(used, (0, 0))
    code_cache.remove_old(used)
    kept = {f"old{age}" for age in range(code_cache.KEPT_BESIDE + 1)}
    assert {path.name for path in tmp_path.iterdir()} == {"used", *kept}


# --- machine code that another user may have written ---------------------------------------------

NOBODY = 65534


def changed(path, mode=0o700, owner=0):
    """A new folder of this mode and owner."""
    path.mkdir()
    os.chown(path, owner, owner)
    path.chmod(mode)
    return path


# What makes the folder, and why it is refused; None where it serves.
FOLDERS = {
    "not there yet": (lambda at: at / "yardstick", None),
    "the user's own": (lambda at: changed(at / "cache"), None),
    "of another": (lambda at: changed(at / "cache", owner=NOBODY), "belongs to another"),
    "writable by all": (lambda at: changed(at / "cache", 0o777), "mode 777"),
    "far below a folder of all": (
        lambda at: changed(changed(at / "tmp", 0o777) / "in", 0o700) / "cache", "mode 777"),
}  # fmt: skip


@pytest.mark.parametrize("case", FOLDERS)
def test_machine_code_lies_where_only_the_user_writes(case, tmp_path):
    make, reason = FOLDERS[case]
    path = make(tmp_path)
    if reason is None:
        folder = code_cache.own_folder(path)
        assert folder == path.resolve()
        assert folder.stat().st_mode & 0o077 == 0
    else:
        with pytest.raises(code_cache.NotOwnError, match=reason):
            code_cache.own_folder(path)


@pytest.mark.parametrize("has_home", [True, False])
def test_where_the_checkout_cannot_be_written_a_home_serves_or_memory(
    has_home, tmp_path, monkeypatch, caplog
):
    # A file where a folder is wanted stops root as well, whom permissions do not stop.
    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "__pycache__").write_text("")
    home = tmp_path / "home"
    if not has_home:
        home.write_text("")
    monkeypatch.setattr(code_cache, "ROOT", tmp_path)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(home))
    code_cache.warn_once.cache_clear()
    found = code_cache.folder.__wrapped__("agents")
    if has_home:
        assert found.parent == home / "yardstick" / "machine_code" / "agents"
        assert found.is_dir()
    else:
        assert found is None
        assert "it is compiled anew in each process" in caplog.text


def test_sources_that_change_under_a_running_process_are_not_kept(checkout):
    """It has the old sources or the new: the digest cannot tell, so nothing is kept."""
    code = """
    from pathlib import Path
    from rl_yardstick import agents
    from rl_yardstick.machine_code import cache
    folder = cache.folder("agents")
    source = Path("rl_yardstick/mdp/graph.py")
    source.write_text(source.read_text() + "\\n")
    from rl_yardstick.agents.small_loop import run_small
    print(run_small(4.0), len(list(folder.rglob("*.nb[ic]"))))
    """
    source = checkout / "rl_yardstick" / "mdp" / "graph.py"
    before = source.read_text()
    source.write_text(f"# Another digest.\n{before}")
    try:
        assert run(checkout, code).stdout.split() == ["13.0", "0"]
    finally:
        source.write_text(before)


def test_names_and_contents_count_and_other_files_do_not(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "ROOT", tmp_path)

    def digest():
        paths = sources.source_paths(["second", "first"])
        return sources.digest_of(sources.content_lines(paths))

    for name in ("first", "second", "third"):
        (tmp_path / name / "deep").mkdir(parents=True)
    rule = tmp_path / "first" / "deep" / "rule.py"
    digests = []
    for text in ("x = 1", "x = 2", "x = 1"):
        rule.write_text(text)
        (tmp_path / "third" / "rule.py").write_text(f"{text}{len(digests)}")
        (tmp_path / "first" / "notes.txt").write_text(f"{text}{len(digests)}")
        digests.append(digest())
    moved = rule.rename(tmp_path / "first" / "rule.py")
    assert digests[0] == digests[2]
    assert len({*digests, digest()}) == 3
    # As Windows would write it too.
    assert sources.content_lines([moved])[0].startswith("first/rule.py ")
