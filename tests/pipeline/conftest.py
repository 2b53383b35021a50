"""A small study with real runs, and its page."""

import dataclasses
from types import SimpleNamespace

import pytest

from pipeline.files import write_text
from pipeline.report import write_report
from pipeline.study.analysis import analyse
from pipeline.study.execution import failure_log
from pipeline.study.planning import plan
from pipeline.study.results import read_results
from pipeline.study.spec import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.study.work import do_run, draft_path

HOSTILE = "</script><script>document.title='taken'</script>"


def small_study() -> StudySpec:
    """Three agents, one of them with a name that is an attack, on two maps with two seeds."""
    agents = (
        AgentSpec("Q-learning & co", "qlearning"),
        AgentSpec("sarsa", "sarsa", {"gamma": 0.9}),
        AgentSpec(HOSTILE, "random"),
    )
    environments = tuple(
        EnvironmentSpec(name, name, {"n_timesteps": 2000})
        for name in ("FrozenLake-v1", "Warehouse-v0")
    )
    return StudySpec(
        name="small",
        title="Small & <b>bold</b>",
        description="What an <i>agent</i> does.",
        agents=agents,
        environments=environments,
        n_seeds=2,
    )


@pytest.fixture(scope="session")
def do_study():
    """Does the runs of a study that are missing, in this process, and reads its results."""

    def do(study, root):
        planned = plan(study, root)
        for run in planned:
            if not run.is_finished:
                do_run(run, draft_path(root, run), "compare.py s.yml")
        return read_results(study, planned, root)

    return do


@pytest.fixture(scope="session")
def report_study(tmp_path_factory):
    """The study, all of its runs done but one, which has failed; its page and how it was asked."""
    study, root = small_study(), tmp_path_factory.mktemp("study")
    planned = plan(study, root)
    failed = planned[-1]
    for run in planned[:-1]:
        do_run(run, draft_path(root, run), "compare.py small.yml")
    log = failure_log(root, failed)
    log.parent.mkdir()
    write_text(log, "Traceback:\nValueError: <the> disk & all is full\n")
    analysis = analyse(read_results(study, planned, root))
    page = root / "report.html"
    write_report(analysis, page, "python compare.py 'a & b.yml'")
    return SimpleNamespace(
        study=study, root=root, planned=planned, failed=failed, analysis=analysis, page=page
    )


@pytest.fixture
def one_environment(report_study):
    """The same with its first environment alone."""
    study = dataclasses.replace(
        report_study.study, environments=report_study.study.environments[:1]
    )
    planned = plan(study, report_study.root)
    return analyse(read_results(study, planned, report_study.root))
