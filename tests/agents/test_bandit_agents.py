"""Bandit agents as Stable-Baselines3 algorithms: training, feedback, files, prediction."""

import inspect
import json
import zipfile

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    BaseCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor

import envs  # noqa: F401  # registers the bandits
from agents import ALGORITHMS, fitting_algorithms, load_algorithm

OURS = [name for name, entry in ALGORITHMS.items() if entry.family == "bandits"]
TABLES = [name for name in OURS if "Box" not in ALGORITHMS[name].observations]
LINEAR = [name for name in OURS if name not in TABLES]


def make(name, env_id="SegmentBandit-v0", n_envs=1, **kwargs):
    env = make_vec_env(env_id, n_envs, seed=0)
    return load_algorithm(name)(env=env, **{"seed": 0, **kwargs})


def state(model):
    """All that training changes, in a form that can be compared."""
    tables = {name: value.tolist() for name, value in model.policy.state_dict().items()}
    return {
        "tables": tables,
        "rng": model.rng.bit_generator.state,
        "num_timesteps": model.num_timesteps,
        "n_updates": model._n_updates,
        "pending": model._pending,
    }


class Script(gym.Env):
    """Tells the given infos one after the other; the reward is 1 for arm 1."""

    observation_space = spaces.Discrete(1)
    action_space = spaces.Discrete(2)

    def __init__(self, infos):
        self.infos = infos
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return 0, {}

    def step(self, action):
        self.steps += 1
        return 0, float(action), False, self.steps == len(self.infos), self.infos[self.steps - 1]


def learnt_after_each_pull(infos, name="ucb", pulls=None):
    """Number of rewards that the agent has learnt from after each pull."""
    env = Script(infos)
    check_env(env, skip_render_check=True)
    model = load_algorithm(name)(env=Monitor(env), seed=0)
    numbers = []
    for _ in range(pulls or len(infos)):
        model.learn(1, reset_num_timesteps=False)
        numbers.append(int(model.policy.counts.sum()))
    return numbers, model


@pytest.mark.parametrize("name", OURS)
def test_same_seed_same_training(name):
    assert state(make(name).learn(300)) == state(make(name).learn(300))
    assert state(make(name, seed=1).learn(300))["tables"] != state(make(name).learn(300))["tables"]


@pytest.mark.parametrize("name", OURS)
def test_learning_in_two_calls_is_learning_in_one(name):
    one, two = (make(name, batch(7)) if name == "ucb" else make(name) for _ in range(2))
    one.learn(300)
    # The schedules of these agents do not move, so that it does not matter where a call ends.
    two.learn(100).learn(200, reset_num_timesteps=False)
    assert state(one) == state(two)


def batch(size):
    return lambda: gym.make("SegmentBandit-v0", batch_size=size)


@pytest.mark.parametrize("name", OURS)
def test_a_saved_agent_goes_on_as_it_would_have(name, tmp_path):
    model = make(name, batch(7)).learn(250)
    # The first 245 rewards have been learnt from, the last 5 are still waiting.
    assert model._n_updates == 245
    model.save(tmp_path / "agent.zip")
    with zipfile.ZipFile(tmp_path / "agent.zip") as archive:
        assert json.loads(archive.read("data"))["algorithm"] == type(model).__name__
    loaded = load_algorithm(name).load(tmp_path / "agent.zip")
    assert {**state(loaded), "pending": None} == {**state(model), "pending": None}
    for agent in (model, loaded):
        agent.set_env(make_vec_env("SegmentBandit-v0", seed=5))
        agent.learn(200, reset_num_timesteps=False)
    assert {**state(loaded), "pending": None} == {**state(model), "pending": None}
    assert loaded.tie_breaking == model.tie_breaking


@pytest.mark.parametrize("name", OURS)
def test_arguments_travel_with_the_agent(name, tmp_path):
    own = {
        "epsilon_greedy": {"initial_q": 3.0, "learning_rate": 0.2},
        "boltzmann": {"temperature": 0.7},
        "ucb": {"variant": "sutton_barto", "c": 0.5, "ignore_context": True},
        "kl_ucb": {"c": 2.0},
        "gradient_bandit": {"baseline": False, "learning_rate": 0.3},
        "exp3": {"mixing": 0.4},
        "thompson": {"likelihood": "gaussian", "prior_std": 3.0},
        "linucb": {"ridge": 2.0},
        "lin_thompson": {"alpha": 0.1},
        "lin_epsilon_greedy": {"exploration_decay": "linear"},
    }.get(name, {})
    model = make(name, **own)
    model.save(tmp_path / "agent.zip")
    loaded = load_algorithm(name).load(tmp_path / "agent.zip")
    assert {key: getattr(loaded, key) for key in own} == own
    assert loaded.settings().tobytes() == model.settings().tobytes()
    assert loaded.lr_schedule(0.5) == model.lr_schedule(0.5)
    assert loaded.exploration_rate == model.exploration_rate


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("env_id", ["SegmentBandit-v0", "LinearBandit-v0"])
def test_predict(name, env_id):
    if name in TABLES and env_id == "LinearBandit-v0":
        env_id = "BernoulliBandit-v0"
    model = make(name, env_id).learn(300)
    many = np.stack([model.observation_space.sample() for _ in range(30)])
    before = state(model)
    sure = model.predict(many, deterministic=True)[0]
    assert sure.shape == (30,)
    assert sure.tolist() == [int(model.predict(one, deterministic=True)[0]) for one in many]
    assert model.predict(many[0], deterministic=True)[0].shape == ()
    unsure = [model.predict(many)[0] for _ in range(20)]
    assert all(each.shape == (30,) for each in unsure)
    assert model.predict(many[0])[0].shape == ()
    # Looking changes nothing, and draws from a generator of its own.
    assert state(model) == before


@pytest.mark.parametrize("name", ["epsilon_greedy", "thompson", "lin_thompson", "exp3"])
def test_exploring_predictions_differ(name):
    model = make(name).learn(50)
    arms = model.predict(np.zeros(200, dtype=np.int64))[0]
    assert len(set(arms.tolist())) > 1


def test_several_environments_share_one_table():
    model = make("ucb", n_envs=3).learn(300)
    assert model.num_timesteps == model._n_updates == 300
    assert model.policy.counts.sum() == 300


def test_feedback_is_learnt_from_when_it_is_due():
    infos = [{"feedback_due": due} for due in (False, False, True, False, True, True, False)]
    numbers, model = learnt_after_each_pull(infos)
    # At the end of the episode, what is there comes in.
    assert numbers == [0, 0, 3, 3, 5, 6, 7]
    assert model._n_updates == 7


def test_feedback_is_immediate_where_nothing_is_said_of_it():
    assert learnt_after_each_pull([{}] * 4)[0] == [1, 2, 3, 4]


def test_feedback_of_each_environment_waits_for_its_own():
    infos = [[{"feedback_due": i == 2} for i in range(4)], [{"feedback_due": True}] * 4]
    env = make_vec_env(lambda: Monitor(Script(infos.pop())), 2)
    model = load_algorithm("ucb")(env=env, seed=0)
    model.learn(2)
    assert model._n_updates == 1
    model.learn(4, reset_num_timesteps=False)
    assert model._n_updates == 6


def test_pulls_that_a_log_does_not_match_are_not_learnt_from():
    infos = [{"matched": matched} for matched in (True, False, False, True)]
    numbers, model = learnt_after_each_pull(infos)
    assert numbers == [1, 1, 1, 2]
    assert model.num_timesteps == 4


def test_exp3_remembers_how_likely_a_late_reward_was():
    """Both pulls of a batch were made with the same probabilities, 1/2."""
    infos = [{"feedback_due": False}, {"feedback_due": True}]
    _, model = learnt_after_each_pull(infos, "exp3")
    wins = model.policy.sums[0, 1].item()
    assert wins > 0
    assert model.policy.scores[0, 1].item() == pytest.approx(wins * 0.1 / 2 / 0.5, rel=1e-12)


def test_a_reward_that_does_not_fit():
    env = Monitor(gym.wrappers.TransformReward(Script([{}] * 9), lambda reward: reward + 0.5))
    for name, message in (
        ("thompson", "Thompson as it is set learns from rewards that are 0 or 1, not"),
        ("kl_ucb", "KLUCB as it is set learns from rewards that are between 0 and 1, not 1.5"),
        ("exp3", "Exp3 as it is set learns from rewards that are between 0 and 1, not 1.5"),
    ):
        with pytest.raises(ValueError, match=message):
            load_algorithm(name)(env=env, seed=0).learn(50)
    with pytest.raises(ValueError, match="this environment's have normal noise"):
        make("thompson", "GaussianBandit-v0").learn(1)
    assert make("thompson", "GaussianBandit-v0", likelihood="gaussian").learn(20)._n_updates == 20


def test_callbacks_and_log(tmp_path):
    class Counter(BaseCallback):
        def _on_step(self):
            return self.n_calls < 37

    assert make("ucb").learn(1000, callback=Counter()).num_timesteps == 37
    model = make("epsilon_greedy", batch(1), exploration_initial_eps=0.25)
    model.learn(5000, callback=StopTrainingOnMaxEpisodes(2), log_interval=1)
    assert model.num_timesteps == 2000
    assert model._episode_num == 2
    assert model.exploration_rate == 0.25
    evaluation = EvalCallback(
        make_vec_env("SegmentBandit-v0", seed=1), eval_freq=1000, n_eval_episodes=1, verbose=0
    )
    make("thompson").learn(1000, callback=evaluation)
    assert 100 < evaluation.last_mean_reward < 200


@pytest.mark.parametrize("name", OURS)
def test_the_signature_names_every_argument(name):
    """Hyperparameter files are checked against it."""
    parameters = inspect.signature(load_algorithm(name)).parameters
    assert not [p for p in parameters.values() if p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    common = {"policy", "env", "tie_breaking", "seed", "verbose", "device", "tensorboard_log"}
    assert common <= set(parameters)
    if name in ("ucb", "kl_ucb", "exp3", "thompson", *LINEAR):
        assert "learning_rate" not in parameters
    assert ("ignore_context" in parameters) == (name in TABLES)
    with pytest.raises(TypeError, match="nonsense"):
        make(name, nonsense=1)


def test_which_bandit_agents_fit():
    bandits = [name for name, entry in ALGORITHMS.items() if entry.for_bandits]
    assert set(OURS) < set(bandits)
    fits = {}
    for env_id in ("SegmentBandit-v0", "LinearBandit-v0", "FrozenLake-v1", "CartPole-v1"):
        env = gym.make(env_id)
        fits[env_id] = [name for name in bandits if not ALGORITHMS[name].env_misfit(env)]
        env.close()
    assert fits["SegmentBandit-v0"] == bandits
    assert fits["LinearBandit-v0"] == [*LINEAR, "mabwiser_linucb"]
    assert fits["FrozenLake-v1"] == fits["CartPole-v1"] == []
    segments = spaces.Discrete(2), spaces.Discrete(3)
    assert not set(fitting_algorithms(*segments)) & set(bandits)
    assert set(fitting_algorithms(*segments, bandit=True)) > set(bandits)


def test_why_a_bandit_agent_does_not_fit():
    lake, linear = gym.make("FrozenLake-v1"), gym.make("LinearBandit-v0")
    reason = "it is for bandits, where a pull changes nothing but its own reward"
    assert ALGORITHMS["ucb"].env_misfit(lake) == reason
    assert ALGORITHMS["ucb"].env_misfit(linear).startswith("it observes Discrete spaces, not Box")
    assert ALGORITHMS["ppo"].env_misfit(lake) == ""
    lake.close()
    linear.close()
