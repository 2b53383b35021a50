"""Finished runs of other settings: named, kept, and moved aside when that is asked for."""

import re
from dataclasses import replace

import pytest

from experiments.plan import plan
from experiments.run_files import mixed_versions
from experiments.run_folders import check_settings_kept, draft_path, in_the_way, move_replaced_aside
from experiments.run_in_child import do_run
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.errors import UserError

LAKE = EnvironmentSpec("lake", "FrozenLake-v1", {"n_timesteps": 20})
ARMS = EnvironmentSpec("arms", "BernoulliBandit-v0", {"n_timesteps": 20})


def study_of(algo="qlearning", environment=LAKE, n_seeds=2, **settings):
    agent = AgentSpec("mine", algo, settings)
    return StudySpec("s", "S", (agent,), (environment,), n_seeds=n_seeds)


@pytest.fixture
def done(tmp_path, do_study):
    do_study(study_of(), tmp_path)
    return tmp_path


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.json")}


def test_other_settings_are_refused_by_name(done):
    planned = plan(study_of(gamma=0.5), done)
    before = contents(done)
    words = (
        f"{done}: 2 finished runs have other settings (gamma: 0.995 there, 0.5 now): --name NAME"
    )
    with pytest.raises(UserError, match=f"^{re.escape(words)} .*, --replace "):
        check_settings_kept(planned, done)
    assert contents(done) == before


def test_of_many_differences_three_are_named(done):
    study = replace(
        study_of(gamma=0.5, learning_rate=0.2, initial_q=2.0), eval_freq=7, eval_episodes=3
    )
    with pytest.raises(UserError, match=r"; and 2 more\)"):
        check_settings_kept(plan(study, done), done)


@pytest.mark.parametrize("n_seeds", [1, 2, 5])
def test_more_or_fewer_seeds_go_without_a_word(done, n_seeds):
    planned = plan(study_of(n_seeds=n_seeds), done)
    check_settings_kept(planned, done)
    assert move_replaced_aside(planned, done) == ([], None)
    assert [run.is_finished for run in planned] == [True, True, False, False, False][:n_seeds]


def test_what_is_moved_aside_is_whole_and_each_time_elsewhere(done, do_study):
    before = contents(done / "runs")
    for number, gamma in enumerate((0.5, 0.6), start=1):
        study = study_of(gamma=gamma)
        planned = plan(study, done)
        moved, place = move_replaced_aside(planned, done)
        assert (moved, place) == (planned, done / "replaced" / str(number))
        assert contents(place) == before
        check_settings_kept(planned, done)
        do_study(study, done)
        before = contents(done / "runs")


def test_a_batch_of_more_seeds_takes_the_place_of_one_of_fewer(tmp_path, do_study):
    do_study(study_of("ucb", ARMS), tmp_path)
    planned = plan(study_of("ucb", ARMS, n_seeds=3), tmp_path)
    check_settings_kept(planned, tmp_path)
    assert in_the_way(planned) == planned
    assert move_replaced_aside(planned, tmp_path) == (planned, tmp_path / "replaced" / "1")
    do_study(study_of("ucb", ARMS), tmp_path)
    planned = plan(study_of("ucb", replace(ARMS, settings={"n_timesteps": 30})), tmp_path)
    with pytest.raises(UserError, match=r"1 finished run has other settings \(n_timesteps"):
        check_settings_kept(planned, tmp_path)


def test_first_runs_with_checkpoints_take_the_place_of_those_without(done):
    planned = plan(replace(study_of(), render_every=2), done)
    check_settings_kept(planned, done)
    assert in_the_way(planned) == planned[:1]


def test_a_run_that_was_cut_off_is_kept_and_an_empty_folder_is_not(done):
    planned = plan(study_of(n_seeds=4), done)
    planned[0].run.update_info(state="interrupted")
    planned[2].path.mkdir()
    check_settings_kept(planned, done)
    assert move_replaced_aside(planned, done) == (planned[:1], done / "replaced" / "1")
    assert not planned[2].path.exists()


def test_another_driver_deletes_nothing_either(done):
    """Programs of a user's own take no lock, and come without being checked."""
    (run, _) = plan(study_of(gamma=0.5), done)
    before = contents(run.path)
    do_run(run, draft_path(done, run), "c")
    assert run.is_finished
    assert contents(done / "replaced" / "1" / "mine" / "lake_1") == before


def test_versions_that_differ_are_named():
    infos = [{"versions": {"torch": "2.1", "numpy": "2.0"}}] * 2
    assert mixed_versions(infos) == mixed_versions([]) == mixed_versions([{}]) == ""
    infos = [*infos, {"versions": {"torch": "2.2", "numpy": "2.0"}, "n_runs": 9}]
    expected = "runs were done with different versions: torch 2.1 (2 runs), 2.2 (9 runs)"
    assert mixed_versions(infos) == expected
