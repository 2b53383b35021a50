"""What the disk has of a run of a study, and when."""

import os
from pathlib import Path

from experiments import run_in_child
from experiments.run_in_child import do_planned_run
from experiments.study_plan import plan
from experiments.study_spec import AgentSpec, EnvironmentSpec, StudySpec
from pipeline import files
from pipeline.runs import FINISHED


def test_a_draft_is_on_the_disk_before_it_has_its_name(monkeypatch, tmp_path):
    """After a power cut no folder of a run may be there whose files are not."""
    house = EnvironmentSpec("house", "Warehouse-v0", {"n_timesteps": 200})
    agent = AgentSpec("table", "qlearning", tuned=False)
    [run] = plan(StudySpec("s", "S", (agent,), (house,), n_seeds=1), tmp_path)
    events = []
    fsync, put = os.fsync, run_in_child.put_in_place

    def synced(number):
        events.append(Path(f"/proc/self/fd/{number}").readlink().name)
        fsync(number)

    def named(*args):
        events.append("named")
        put(*args)

    monkeypatch.setattr(files.os, "fsync", synced)
    monkeypatch.setattr(run_in_child, "put_in_place", named)
    do_planned_run(run, tmp_path, "")
    assert run.run.read_info()["state"] == FINISHED
    place = events.index("named")
    assert {path.name for path in run.path.rglob("*")} <= set(events[:place])
    assert run.path.parent.name in events[place:]
