"""What a run says of the machine: its kind, and nothing that tells it from another of the kind."""

import platform

import pytest

from pipeline import runs


@pytest.mark.parametrize(
    ("content", "processor"),
    [
        ("processor\t: 0\nmodel name\t: Fast CPU @ 3GHz\nmodel name\t: other\n", "Fast CPU @ 3GHz"),
        ("processor\t: 0\n", "arm"),
        (None, "arm"),
    ],
)  # fmt: skip
def test_the_processor_is_named_where_it_is_told(tmp_path, monkeypatch, content, processor):
    if content is not None:
        (tmp_path / "cpuinfo").write_text(content)
    monkeypatch.setattr(runs, "_PROCESSORS", tmp_path / "cpuinfo")
    monkeypatch.setattr(platform, "processor", lambda: "arm")
    runs.recorded_machine.cache_clear()
    machine = runs.recorded_machine()
    runs.recorded_machine.cache_clear()
    assert machine["processor"] == processor
    assert machine["system"].startswith(platform.system())
    assert int(machine["cores"]) >= 1
    assert platform.node() not in str(machine)
