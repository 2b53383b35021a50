"""Where runs are done: what flags say of it, and what is refused before anything is begun."""

import contextlib

import pytest

from commands.compare import RunContext, build_parser, run_context
from commands.terminal import TextConsole
from experiments.child_processes import NO_LIMITS
from pipeline.errors import UserError


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
