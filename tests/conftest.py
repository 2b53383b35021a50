"""What holds for every test: no window, one thread, unhurried property tests; and a small study."""

import copy
import dataclasses
import gc
import os
import signal
import sys
import tempfile
from concurrent.futures import Future
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import hypothesis
import pytest

SIGNALS = (signal.SIGINT, signal.SIGTERM)

# Set before anything imports pygame, Matplotlib or PyTorch; child processes inherit them.
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["MPLBACKEND"] = "Agg"
for library in ("OMP", "MKL", "OPENBLAS", "NUMBA"):
    os.environ[f"{library}_NUM_THREADS"] = "1"

# The key to saved states and the models found are the user's own, which tests leave alone.
CONFIGURATION = tempfile.TemporaryDirectory(prefix="yardstick-tests-")
os.environ["XDG_CONFIG_HOME"] = os.environ["XDG_CACHE_HOME"] = CONFIGURATION.name

import rl_yardstick.envs  # noqa: E402, F401  # registers the environments for all tests

# No deadline: the first example of a compiled function pays for its compilation. In CI the examples
# are the same every time, so that a failure there can be repeated.
hypothesis.settings.register_profile("yardstick", deadline=None, derandomize="CI" in os.environ)
hypothesis.settings.load_profile("yardstick")


# What is imported and collected stays to the end. To look for garbage among it, again and again,
# took two fifths of the processor time of collecting, and some of each test after it.
gc.disable()


def pytest_collection_modifyitems(items):
    """Mark the tests of daily work."""
    names = set((Path(__file__).parent / "quick.txt").read_text().split())
    for item in items:
        if item.nodeid.partition("[")[0] in names:
            item.add_marker("quick")


def pytest_collection_finish():
    """From here on the collector goes through what tests make, and through nothing older."""
    gc.freeze()
    gc.enable()


@pytest.fixture(autouse=True, scope="session")
def shipped_settings_are_parsed_once():
    """Each run asks for them, and to parse a file takes longer than to check what it says."""
    from rl_yardstick.pipeline import settings

    read, parsed = settings.read_yaml, cache(settings.read_yaml)

    def read_once(path):
        return copy.deepcopy(parsed(path)) if path.parent == settings.HYPERPARAMS else read(path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(settings, "read_yaml", read_once)
        yield


@pytest.fixture(autouse=True)
def signals_are_left_as_they_were():
    """A handler that a test leaves behind would decide what Ctrl-C is to the tests after it."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    after = {number: signal.getsignal(number) for number in SIGNALS}
    for number in SIGNALS:
        if after[number] != before[number]:
            signal.signal(number, before[number])
    assert after == before


@pytest.fixture(autouse=True)
def classes_are_forgotten():
    """A class that a test registers would be on the pages that other tests make."""
    from rl_yardstick.agents.registry import ALGORITHMS, BY_VALUE

    before = {*ALGORITHMS}
    yield
    for name in ALGORITHMS.keys() - before:
        del ALGORITHMS[name]
        BY_VALUE.pop(name, None)


def small_study():
    """Three agents, one of them with a name that is an attack, on two maps with two seeds."""
    from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec
    from tests.report.made_up import HOSTILE

    agents = (
        AgentSpec("Q-learning & co", "qlearning"),
        AgentSpec("sarsa", "sarsa", {"gamma": 0.9}),
        AgentSpec(HOSTILE, "random"),
    )
    environments = tuple(
        EnvironmentSpec(name, name, {"n_timesteps": 2000})
        for name in ("FrozenLake-v1", "Warehouse-v0")
    )
    title, words = "Small & <b>bold</b>", "What an <i>agent</i> does."
    return StudySpec("small", title, agents, environments, n_seeds=2, description=words)


@pytest.fixture
def own_folder(monkeypatch, tmp_path):
    """A user's folder, in which commands are typed; what is imported from there goes afterwards."""
    import gymnasium as gym

    from rl_yardstick.agents import ALGORITHMS

    (tmp_path / "own").mkdir()
    folder = (tmp_path / "own").resolve()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(Path(__file__).parents[1])]))
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    tables = [(table, dict(table)) for table in (ALGORITHMS, gym.registry, sys.modules)]
    yield folder
    for table, before in tables:
        for name in table.keys() - before.keys():
            is_own = str(tmp_path) in str(getattr(table[name], "__file__", "") or "")
            if table is not sys.modules or is_own:
                del table[name]


@pytest.fixture
def states_at_each_moment(monkeypatch):
    """A training saves its state at each moment at which that is safe."""
    from rl_yardstick.pipeline.callbacks import StateCallback

    monkeypatch.setattr(StateCallback, "share_of_time", 1e9)
    monkeypatch.setattr(StateCallback, "shortest_pause", 0.0)


class Typed:
    """Runs command lines in this process: exit code, output, errors, its children's included."""

    def __init__(self, capfd):
        self.capfd = capfd

    def __call__(self, *words):
        from rl_yardstick.commands import main, run_command

        handlers = {number: signal.getsignal(number) for number in SIGNALS}
        name = Path(words[0]).name
        command = main if name == "yardstick" else partial(run_command, name.removesuffix(".py"))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "path", [*sys.path])
            patch.setattr(sys, "argv", [name, *map(str, words[1:])])
            with pytest.raises(SystemExit) as stop:
                command()
        for number, handler in handlers.items():  # the process would end with its command
            signal.signal(number, handler)
        captured = self.capfd.readouterr()
        return stop.value.code, captured.out, captured.err

    def done(self, *words):
        """The output of a command that succeeds without a word on errors."""
        code, out, err = self(*words)
        assert (code, err) == (0, ""), f"{words}\n{out}{err}"
        return out

    def refused(self, *words):
        """The one line that a mistake ends with."""
        code, out, err = self(*words)
        assert (code, err.count("\n")) == (2, 1), f"{words}\n{out}{err}"
        return err


@pytest.fixture
def typed(capfd):
    return Typed(capfd)


@pytest.fixture
def quick_runs(monkeypatch):
    """Runs without pictures and with few evaluated steps, which take most of a short run."""
    monkeypatch.setattr("rl_yardstick.pipeline.training.draw", lambda *_: None)
    monkeypatch.setattr("rl_yardstick.pipeline.evaluation.sampled.STEPS_IN_ANY_CASE", 200)


def do_here(function, *args):
    return function(*args)


class Here:
    """Stands where a pool of processes does, which would import all libraries once more."""

    def __init__(self, n_workers):
        self.stop = self.join = lambda: None

    def submit(self, function, timeout, *args):
        future = Future()
        try:
            future.set_result(function(*args))
        except Exception as error:  # noqa: BLE001  # as a pool does
            future.set_exception(error)
        return future


@pytest.fixture
def in_this_process(monkeypatch):
    """Studies whose runs are done by this process."""
    for place in ("experiments.pool", "report.page.learning"):
        monkeypatch.setattr(f"rl_yardstick.{place}.process_pool", Here)
    monkeypatch.setattr("rl_yardstick.report.page.world_sections.do_aside", do_here)


@pytest.fixture(scope="session")
def do_study():
    """Does the runs of a study that are missing, in this process, and reads its results."""
    from rl_yardstick.experiments.plan import plan
    from rl_yardstick.experiments.pool import do_run
    from rl_yardstick.experiments.results import read_results

    def do(study, root):
        planned = plan(study, root)
        for run in planned:
            if not run.is_finished:
                do_run(run, "compare.py s.yml")
        return read_results(study, planned, root)

    return do


@pytest.fixture(scope="session")
def report_study(tmp_path_factory):
    """The study, all of its runs done but one, which has failed; its page and how it was asked."""
    from rl_yardstick.experiments.analysis import analyse
    from rl_yardstick.experiments.plan import plan
    from rl_yardstick.experiments.pool import do_run
    from rl_yardstick.experiments.results import read_results
    from rl_yardstick.report import films
    from rl_yardstick.report.page import world_sections, write_report
    from rl_yardstick.report.page.frame import Report
    from rl_yardstick.report.series import study_series

    study, root = small_study(), tmp_path_factory.mktemp("study")
    planned = plan(study, root)
    failed = planned[-1]
    for run in planned[:-1]:
        do_run(run, "compare.py small.yml")
    details = {failed.path: "Traceback:\nValueError: <the> disk & all is full\n"}
    analysis = analyse(dataclasses.replace(read_results(study, planned, root), failures=details))
    page = root / "report.html"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(films, "MAX_STEPS", 20)  # longer films take ten seconds to draw
        # In this process, where that holds, also if there is one that runs are forked from.
        patch.setattr(world_sections, "do_aside", do_here)
        write_report(Report(study_series(analysis), "python compare.py 'a & b.yml'"), page)
    return SimpleNamespace(
        study=study, root=root, planned=planned, failed=failed, analysis=analysis, page=page
    )
