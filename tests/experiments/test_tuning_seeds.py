"""Which seeds of a study its settings were tuned on, and how that is said."""

from dataclasses import replace

import pytest

from experiments.plan import TuningSeeds, tuning_seeds
from experiments.study import AS_IT_COMES, AgentSpec, EnvironmentSpec, StudySpec
from report.seed_sentence import seed_sentence, spans

LAKE, PENDULUM = (EnvironmentSpec(name, name) for name in ("FrozenLake-v1", "Pendulum-v1"))
NONE = frozenset()


def study(*agents, places=(LAKE,), first=0, count=10):
    return StudySpec("s", "S", agents, places, n_seeds=count, first_seed=first)


def said(*agents, **fields):
    asked = study(*agents, **fields)
    return seed_sentence(asked.seeds, tuning_seeds(asked))


DQN, PPO, RANDOM = (AgentSpec(name, name) for name in ("dqn", "ppo", "random"))


def test_the_shipped_settings_and_the_seeds_that_they_were_tuned_on():
    agents = DQN, PPO, RANDOM
    assert said(*agents) == "Seeds 0 to 9: the shipped settings of dqn and ppo were tuned on these."
    assert said(*agents, first=1000) == "Seeds 1000 to 1009: nothing was tuned on these."
    assert said(*agents, first=8) == (
        "Seeds 8 to 17: the shipped settings of dqn and ppo were tuned on 8 to 9 of these."
    )
    assert said(PPO, first=3, count=1) == "Seed 3: the shipped settings of ppo were tuned on it."
    assert said(PPO, first=33, count=1) == "Seed 33: nothing was tuned on it."


def test_each_environment_has_its_own():
    found = tuning_seeds(study(PPO, places=(PENDULUM,), first=99, count=3))
    assert found == TuningSeeds({"ppo": frozenset({100})}, {}, ())
    both = tuning_seeds(study(PPO, places=(LAKE, PENDULUM), count=101))
    assert both.shipped == {"ppo": frozenset([*range(10), 100])}


def test_defaults_of_a_constructor_were_tuned_on_nothing_and_budgets_are_no_tuning():
    plain = replace(DQN, tuned=False, settings={"policy": "MlpPolicy", "n_timesteps": 100})
    assert said(plain) == "Seeds 0 to 9: nothing was tuned on these."
    assert "the shipped settings of dqn" in said(replace(DQN, settings={"n_timesteps": 100}))


def test_settings_of_the_studys_own_are_not_known_of():
    changed = AgentSpec("mine", "dqn", {"gamma": 0.9})
    assert said(changed, first=1000) == (
        "Seeds 1000 to 1009: nothing is known to have been tuned on these; what the study's own "
        "settings of mine were tuned on is not known."
    )
    assert said(changed) == (
        "Seeds 0 to 9: the shipped settings of dqn were tuned on these; what the study's own "
        "settings of mine were tuned on is not known."
    )
    place = replace(LAKE, settings={"gamma": 0.9})
    assert tuning_seeds(study(DQN, RANDOM, places=(place,))).unknown == ("dqn", "random")
    sweep = [AgentSpec(f"g={g}", "dqn", {"gamma": g}, group="g") for g in (0.1, 0.2)]
    assert tuning_seeds(study(*sweep)).unknown == ("g",)


def test_files_of_ones_own_say_it_or_it_is_not_known(tmp_path):
    path = tmp_path / "mine.yml"
    agent = replace(DQN, conf_file=path)
    path.write_text("FrozenLake-v1: {gamma: 0.5}\n")
    assert said(agent) == (
        "Seeds 0 to 9: what the study's own settings of dqn were tuned on is not known."
    )
    path.write_text(
        "tuned_on: {FrozenLake-v1: {first: 5, count: 2}}\nFrozenLake-v1: {gamma: 0.5}\n"
    )
    assert said(agent) == "Seeds 0 to 9: the settings in mine.yml were tuned on 5 to 6 of these."
    assert tuning_seeds(study(agent)) == TuningSeeds({}, {"mine.yml": frozenset({5, 6})}, ())
    path.unlink()
    assert tuning_seeds(study(agent)) == TuningSeeds({}, {}, ("dqn",))


def test_an_agent_of_ones_own_is_not_known_of():
    assert tuning_seeds(study(AgentSpec("own", "own", tuned=False))) == TuningSeeds(
        {}, {}, ("own",)
    )


def test_many_names_are_cut_short():
    tuning = TuningSeeds({}, {}, tuple("abcdefgh"))
    assert "of a, b, c, d, e, f and 2 more were" in seed_sentence(range(10), tuning)
    assert seed_sentence(range(3), TuningSeeds({"a": NONE}, {}, ())).endswith(
        "nothing was tuned on these."
    )


@pytest.mark.parametrize(
    ("numbers", "text"),
    [([3], "3"), ([0, 1, 2], "0 to 2"), ([9, 0, 1, 4, 7, 8], "0 to 1, 4, 7 to 9")],
)
def test_spans(numbers, text):
    assert spans(numbers) == text


def test_nobody_tuned_on_other_arguments_of_the_environment():
    slippery = EnvironmentSpec("slip", "Warehouse-v0", {"env_kwargs": {"slip": 0.1}})
    elsewhere = "the settings of dqn were tuned with other arguments of the environment"
    assert said(DQN, places=(slippery,)) == f"Seeds 0 to 9: {elsewhere}."
    assert said(DQN, places=(slippery,), first=1000) == f"Seeds 1000 to 1009: {elsewhere}."
    assert said(RANDOM, places=(slippery,)) == "Seeds 0 to 9: nothing was tuned on these."
    both = said(DQN, places=(slippery, LAKE))
    assert both == f"Seeds 0 to 9: the shipped settings of dqn were tuned on these; {elsewhere}."
    own = replace(DQN, settings={"env_kwargs": {"is_slippery": False}})
    assert said(own) == f"Seeds 0 to 9: {elsewhere}."
    for env_id, kwargs in (("Warehouse-v0", {"slip": 0.0}), ("RandomWarehouse-v0", {"size": 10})):
        usual = EnvironmentSpec("usual", env_id, {"env_kwargs": kwargs})
        assert "the shipped settings of dqn were tuned on these" in said(DQN, places=(usual,))
    as_it_comes = EnvironmentSpec("as it comes", "Warehouse-v0", AS_IT_COMES)
    assert said(DQN, places=(as_it_comes,)) == f"Seeds 0 to 9: {elsewhere}."
    table = AgentSpec("sarsa", "sarsa")  # which has no such changes in its settings
    assert "of sarsa were tuned on these" in said(table, places=(as_it_comes,))


def test_the_same_environment_by_another_name_was_tuned_on():
    slippery = EnvironmentSpec("ice", "CliffWalking-v1", {"env_kwargs": {"is_slippery": True}})
    table = AgentSpec("sarsa", "sarsa")
    assert said(table, places=(slippery,)) == (
        "Seeds 0 to 9: the shipped settings of sarsa were tuned on these."
    )
