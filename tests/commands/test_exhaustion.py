"""A machine without memory, threads or processes to give ends a command in one line."""

import pytest

from commands.cli import run_command


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError(), "this machine gives no more memory"),
        (MemoryError("Unable to allocate 4 GiB"), "no more memory: Unable to allocate 4 GiB"),
        (
            RuntimeError("[enforce fail at alloc_cpu.cpp:1]\nDefaultCPUAllocator: can't allocate "),
            None,
        ),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory:\nyou tried 9 bytes"),
            "no more memory: DefaultCPUAllocator: can't allocate memory: you tried 9 bytes",
        ),
        (ImportError("libtorch.so: failed to map segment from shared object"), "no more memory: "),
        (RuntimeError("can't start new thread"), "no more threads or processes: "),
        (RuntimeError("a bug"), None),
        (ImportError("No module named 'x'"), None),
    ],
)
def test_what_runs_out_is_named_and_a_bug_is_not_hidden(error, line, capsys):
    def main():
        raise error

    if line is None:
        with pytest.raises(type(error)):
            run_command(main)
        return
    with pytest.raises(SystemExit) as stop:
        run_command(main)
    said = capsys.readouterr().err
    assert stop.value.code == 2
    assert line in said
    assert said.count("\n") == 1
