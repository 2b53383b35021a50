"""Where runs are done, and what a person watching them reads."""

import contextlib
import io
import re
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from commands import compare, terminal, tune
from commands.compare import RunContext, StudyProgress, build_parser, run_context
from commands.terminal import TextConsole
from commands.tune import TuningProgress
from experiments.child_processes import NO_LIMITS
from experiments.launching import RunFailure
from experiments.plan import plan
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline import signs_of_life
from pipeline.errors import UserError

# --- where runs are done: what flags say of it, and what is refused before anything is begun ------


def place(tmp_path, *words):
    args = build_parser().parse_args(["study", *words])
    return run_context(args, tmp_path / "study", "c", NO_LIMITS, TextConsole())


def test_places_by_their_flags(tmp_path):
    assert place(tmp_path, "-j", "3").words == "3 at once"
    assert place(tmp_path, "--cluster", "local:2").words == "on the cluster local:2"
    (tmp_path / "slurm.yml").write_text("jobqueue: {slurm: {cores: 4, memory: 8GB}}")
    there = place(tmp_path, "--cluster", str(tmp_path / "slurm.yml"), "-j", "8")
    assert there.words.endswith("slurm.yml")
    assert not (tmp_path / "study").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--cluster", "192.0.2.1:8786"], "without TLS"),
        (["--cluster", "tls://192.0.2.1:8786"], "ca-file"),
        (["--cluster", "missing.json"], "cannot be read"),
        (["--cluster", "local:0"], "local:N"),
        (["--cluster", "local:2", "-j", "2"], "a cluster has its workers"),
        (["--cluster", "queue.yml"], "--jobs N"),
        (["--insecure-cluster"], "give --cluster too"),
    ],
)
def test_what_is_refused_is_refused_in_one_line(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "queue.yml").write_text("jobqueue: {slurm: {cores: 4, memory: 8GB}}")
    with pytest.raises(UserError, match=message) as refused:
        place(tmp_path, *words)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "study").exists()


def test_without_the_library_it_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"rl-yardstick\[cluster\]"):
        place(tmp_path, "--cluster", "local:2")


def test_a_place_that_is_held_is_opened_once_and_left_at_the_end(tmp_path, monkeypatch):
    told = []

    @contextlib.contextmanager
    def launcher_of(*_):
        told.append("opened")
        yield "launcher"
        told.append("left")

    monkeypatch.setattr("experiments.launching.local_launcher", launcher_of)
    context = RunContext(tmp_path, "c", NO_LIMITS, TextConsole())
    with context.held():
        assert told == []
        for _ in range(2):
            with context.launchers() as launcher:
                assert launcher == "launcher"
        assert told == ["opened"]
    assert told == ["opened", "left"]


# --- what a person watching a study reads: in a terminal, and where the output goes elsewhere -----


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands until it is told to go on."""
    fake = SimpleNamespace(now=1000.0)
    for place in (compare, tune, terminal, signs_of_life):
        monkeypatch.setattr(place, "time", SimpleNamespace(monotonic=lambda: fake.now))
    # Nothing beats by itself.
    still = SimpleNamespace(start=skip, stop=skip)
    monkeypatch.setattr(terminal, "Heartbeat", lambda *_: still)
    return fake


def skip():
    pass


def planned_runs(n_seeds=4):
    agents = (AgentSpec("[b]one[/b]", "qlearning"), AgentSpec("two", "sarsa"))
    lake = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 10})
    return plan(StudySpec("s", "S", agents, (lake,), n_seeds=n_seeds), Path("nowhere"))


def console_of(**options):
    file = io.StringIO()
    return file, TextConsole(file=file, width=100, **options)


def failure_of(run):
    return RunFailure(run, "too [hot]", Path("log.txt"))


def test_where_there_is_no_terminal_a_line_now_and_then(clock):
    runs = planned_runs()
    file, console = console_of(force_terminal=False)
    with StudyProgress(console, runs, runs[:2]) as progress:
        assert file.getvalue() == ""
        clock.now += 5
        progress.note(runs[2], None)
        # Ten seconds are not over before they are past.
        clock.now += 5
        progress.note(runs[3], None)
        assert file.getvalue() == ""
        clock.now += 0.5
        progress.note(runs[4], None)
        assert file.getvalue() == "3 of 6 runs in 10 s, about 13 s left by the clock\n"
        # From that line on they are counted anew.
        clock.now += 9.9
        progress.note(runs[5], None)
        assert file.getvalue().count("\n") == 1
        clock.now += 70
        progress.note(runs[6], None)
        # The last run is told of at once.
        progress.note(runs[7], None)
    assert file.getvalue().splitlines() == [
        "3 of 6 runs in 10 s, about 13 s left by the clock",
        "5 of 6 runs in 1 min 30 s, about 7 s left by the clock",
        "6 of 6 runs in 1 min 30 s",
    ]


def test_a_line_is_printed_also_while_no_run_ends(clock):
    runs = planned_runs(1)
    file, console = console_of(force_terminal=False)
    with StudyProgress(console, runs, []) as progress:
        for _ in range(25):
            clock.now += 1
            progress.look()
        progress.note(runs[0], None)
        progress.note(runs[1], None)
        clock.now += 100
        progress.look()
    assert file.getvalue().splitlines() == [
        "0 of 2 runs in 11 s",
        "0 of 2 runs in 22 s",
        "2 of 2 runs in 25 s",
    ]


def test_failures_are_told_at_once_and_to_the_letter(clock):
    runs = planned_runs()
    file, console = console_of(force_terminal=False)
    with StudyProgress(console, runs, []) as progress:
        progress.note(runs[2], failure_of(runs[2]))
    assert file.getvalue() == "failed: [b]one[/b] on lake, seed 1: too [hot]\n"


def test_of_a_cluster_the_line_says_how_many_workers_there_are(clock):
    runs = planned_runs()
    file, console = console_of(force_terminal=False)
    with StudyProgress(console, runs, []) as progress:
        cluster = SimpleNamespace(words="3 workers", n_workers=3)
        with progress.watching(lambda: nullcontext(cluster))() as launcher:
            assert launcher is cluster
            progress.note(runs[2], failure_of(runs[2]))
            clock.now += 11
            progress.look()
        clock.now += 11
        progress.look()
    assert file.getvalue().splitlines()[1:] == [
        "1 of 8 runs in 11 s, about 11 s left by the clock, 3 workers, 1 failed",
        "1 of 8 runs in 22 s, about 1 min 6 s left by the clock, 1 failed",
    ]


def test_so_does_the_line_of_a_search(clock):
    _, console = console_of(force_terminal=False)
    with TuningProgress(console, 10, dict, is_cost=False) as progress:
        assert progress.figures() == "0 of 10 trials, 0 runs in 0 s"
        launchers = progress.watching(
            lambda: nullcontext(SimpleNamespace(words="3 workers", n_workers=3))
        )
        with launchers():
            progress.run_ended()
            progress.trial_ended(4, 0.5, "")
            clock.now += 2
            assert progress.figures() == (
                "1 of 10 trials, 1 run in 2 s, 3 workers; best 0.5 (trial 4); "
                "about 18 s left by the clock"
            )


def test_a_study_that_is_interrupted_says_how_to_go_on(clock):
    runs = planned_runs()
    file, console = console_of(force_terminal=False)

    def interrupted():
        with StudyProgress(console, runs, []) as progress:
            clock.now += 7200 + 180 + 9
            progress.note(runs[0], None)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert file.getvalue().splitlines() == [
        "1 of 8 runs in 2 h 3 min, about 14 h 22 min left by the clock",
        "1 of 8 runs in 2 h 3 min, about 14 h 22 min left by the clock; the same command continues",
    ]


def test_a_study_that_breaks_otherwise_promises_nothing(clock):
    runs = planned_runs()
    file, console = console_of(force_terminal=False)

    def broken():
        with StudyProgress(console, runs, []):
            raise ValueError

    with pytest.raises(ValueError):  # noqa: PT011  # it has no message
        broken()
    assert file.getvalue() == ""


def test_in_a_terminal_one_table_moves(clock):
    runs = planned_runs()
    file, console = console_of(force_terminal=True, force_interactive=True, color_system=None)
    with StudyProgress(console, runs, runs[:2]) as progress:
        first = plain(file.getvalue())
        assert re.search(r"agent +environment +runs +failed", first)
        # The table is there before the first run has ended, and names are taken to the letter.
        assert re.search(r"\[b\]one\[/b\] +lake +1/4", first)
        assert "0 of 6 runs in 0 s" in first
        clock.now += 7
        progress.look()
        assert "0 of 6 runs in 7 s" in plain(file.getvalue())
        clock.now -= 7
        clock.now += 60
        progress.note(runs[2], None)
        progress.note(runs[3], failure_of(runs[3]))
    shown = plain(file.getvalue())
    assert "failed: two on lake, seed 1: too [hot]" in shown
    last = shown[shown.rindex("agent ") :]
    assert re.search(r"\[b\]one\[/b\] +lake +2/4 .*[^1]\n", last)
    assert re.search(r"two +lake +1/4 .* 1 *\n", last)
    assert "2 of 6 runs in 1 min 0 s, about 2 min 0 s left by the clock" in last


def plain(text):
    """Without the codes that move the cursor."""
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text)
