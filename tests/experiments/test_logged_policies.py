"""Which agents can be judged on a log, what they stand beside, and what is said of them."""

import json

import numpy as np
import pytest

from agents import load_algorithm
from envs.bandits import ReplayBandit
from experiments.off_policy.logged_policies import (
    LoggedPolicy,
    compare_policies,
    read_logged,
    read_policy,
)
from pipeline.errors import UserError

HEAD = "segment,arm,reward,propensity\n"
NUMBERS = HEAD + "".join(f"{i % 2},{i % 3 % 2},{i % 5},0.5\n" for i in range(60))
WORDS = NUMBERS.replace("\n0,", "\ncasual,").replace("\n1,", "\ncore,")
OTHER_WORDS = NUMBERS.replace("\n0,", "\nnew,").replace("\n1,", "\nold,")


@pytest.fixture
def log(tmp_path):
    def written(text, name="log.csv"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return written


def random_agent(path, trained_on=None):
    algorithm = load_algorithm("random")
    agent = algorithm(next(iter(algorithm.policy_aliases)), ReplayBandit(path), seed=0)
    return LoggedPolicy("runs/random", agent, trained_on)


def test_the_policies_asked_about_stand_before_their_alternatives(log):
    path = log(NUMBERS)
    comparison = compare_policies(read_logged(path), [random_agent(path)] * 2)
    assert [(row.name, row.is_given) for row in comparison.rows] == [
        ("runs/random", True),
        ("runs/random", True),
        ("always arm 0", False),
        ("always arm 1", False),
        ("as logged", False),
    ]
    given, _, first, second, logged = (row.terms for row in comparison.rows)
    # Both arms were logged with probability 1/2, and so the random policy as often as the log.
    assert given.ips.tolist() == logged.ips.tolist() == [i % 5 for i in range(60)]
    assert (first.ips + second.ips) / 2 == pytest.approx(logged.ips)
    assert (given.effective, logged.effective) == (60, 60)
    assert comparison.notes == ()


def test_an_arm_that_the_log_says_nothing_of_is_left_out_with_a_note(log):
    path = log("arm,reward,propensity\n0,1,0.5\n2,0,0.5\n0,1,0.5\n2,1,0.5\n")
    comparison = compare_policies(read_logged(path), [])
    assert [row.name for row in comparison.rows] == ["always arm 0", "always arm 2", "as logged"]
    (note,) = comparison.notes
    assert note.startswith(f"arm 1 on {path}: arm 1 was never logged")


def test_words_are_told_with_their_numbers(log):
    comparison = compare_policies(read_logged(log(WORDS)), [])
    assert comparison.notes == ("segment was read as 0 casual, 1 core",)


def test_figures_on_the_log_that_an_agent_was_trained_on_flatter_it(log):
    path = log(NUMBERS)
    same = log(NUMBERS, "same.csv")
    trained = compare_policies(read_logged(path), [random_agent(path, trained_on=path)])
    assert trained.notes == (
        "runs/random was trained on this log: its figures flatter it; judge by another",
    )
    # Another file, even of the same pulls, is another log; and one that is gone is not known.
    for other in (same, path.with_name("gone.csv"), None):
        assert compare_policies(read_logged(path), [random_agent(path, other)]).notes == ()


@pytest.mark.parametrize(
    ("trained_on", "judged_on", "told"),
    [
        (NUMBERS, WORDS, "are numbers; those of {} are casual, core"),
        (WORDS, NUMBERS, "are casual, core; those of {} are numbers"),
        (OTHER_WORDS, WORDS, "are new, old; those of {} are casual, core"),
    ],
)
def test_an_agent_that_numbered_contexts_otherwise_is_refused(log, trained_on, judged_on, told):
    theirs, ours = log(trained_on, "theirs.csv"), log(judged_on, "ours.csv")
    with pytest.raises(UserError) as error:
        compare_policies(read_logged(ours), [random_agent(ours, theirs)])
    assert str(error.value) == (
        f"runs/random was trained on {theirs}, whose contexts {told.format(ours)}"
    )


def test_a_log_without_propensities_is_refused(log):
    path = log("arm,reward\n0,1\n1,0\n")
    with pytest.raises(UserError, match="has no column 'propensity': off-policy evaluation needs"):
        read_logged(path)


# --- reading agents -------------------------------------------------------------------------------


def run_folder(path, **spec):
    """A run folder as far as its record goes."""
    path.mkdir()
    info = {"env_name": "Lake", "state": "finished", "spec": spec}
    (path / "run.json").write_text(json.dumps(info))
    return path


def test_folders_that_hold_no_agent(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"empty is no run folder: it holds no whole run\.json"):
        read_policy(tmp_path / "empty")
    with pytest.raises(UserError, match=r"run holds no Lake\.zip: its training may not have ended"):
        read_policy(run_folder(tmp_path / "run", algo="linucb"))


def saved_agent(path, log_path, algo="linucb", **spec):
    run_folder(path, algo=algo, **spec)
    load_algorithm(algo)(env=ReplayBandit(log_path), seed=0).save(path / "Lake.zip")
    return path


def test_an_agent_is_read_with_the_log_it_was_trained_on(log, tmp_path):
    path = log(NUMBERS)
    settings = {"env_kwargs": {"log": str(path)}}
    folder = saved_agent(tmp_path / "run", path, hyperparams=settings)
    for given in (folder, folder / "Lake.zip"):
        policy = read_policy(given)
        assert (policy.name, policy.log) == (str(given), path)
        assert isinstance(policy.agent, load_algorithm("linucb"))
    (folder / "run.json").unlink()
    assert read_policy(folder / "Lake.zip").log is None


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("normalize", True),
        ("frame_stack", 4),
        ("env_wrapper", "a.B"),
        ("vec_env_wrapper", "a.B"),
    ],
)
def test_agents_that_observe_more_than_a_log_holds(log, tmp_path, key, value):
    folder = saved_agent(tmp_path / "run", log(NUMBERS), hyperparams={key: value})
    with pytest.raises(UserError, match=f"was trained with {key}: it observes more than a log"):
        read_policy(folder)


class SomeSoldOut(ReplayBandit):
    def action_masks(self):
        return np.array([True, False])


def test_an_agent_that_has_to_be_told_what_is_allowed(log):
    rows = "".join(f"{i % 2},{i % 5},{i % 2},1,0.5\n" for i in range(20))
    path = log("age,visits,arm,reward,propensity\n" + rows)
    agent = load_algorithm("linucb")(env=SomeSoldOut(path), mask_actions=True)
    message = "^runs/linucb cannot be judged on a log: LinUCB: which actions are valid"
    with pytest.raises(UserError, match=message):
        compare_policies(read_logged(path), [LoggedPolicy("runs/linucb", agent, None)])
