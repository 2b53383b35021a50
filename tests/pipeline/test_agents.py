"""Agents of libraries and of strangers, told what is valid or with a memory: run, saved, judged."""

import io
import json
import zipfile
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from rich.console import Console
from stable_baselines3 import A2C
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import set_random_seed

from rl_yardstick import agents
from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.envs.wrappers import ActionMasks
from rl_yardstick.pipeline import training
from rl_yardstick.pipeline.environments import (
    make_evaluation_env,
    make_single_env,
    make_training_env,
)
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.exact import exact_evaluator
from rl_yardstick.pipeline.evaluation.policies import policy_matrix
from rl_yardstick.pipeline.evaluation.sampled import evaluate
from rl_yardstick.pipeline.models.load import (
    load_model,
    load_replay_buffer,
    load_to_play,
)
from rl_yardstick.pipeline.playing import play_episodes
from rl_yardstick.pipeline.settings.components import build_algorithm_kwargs
from rl_yardstick.pipeline.settings.hyperparams import split
from tests.pipeline.short_runs import LAKE, WAREHOUSE, agent_of
from tests.pipeline.short_runs import spec_of as spec_for

# --- zips of our subclasses of library agents: loaded as data, they are what the library loads ---
TINY = {"net_arch": [4]}
OFF = {"learning_starts": 10, "buffer_size": 100, "batch_size": 8, "policy_kwargs": TINY}
CASES = {
    "double_dqn": {**OFF, "mask_actions": True, "learning_rate": "exp_0.1_0.001"},
    "ppo": {"n_steps": 16, "batch_size": 8, "policy_kwargs": TINY, "clip_range": "exp_0.4_0.1"},
}


def made(name):
    algorithm = load_algorithm(name)
    env = make_vec_env(WAREHOUSE, 1, seed=0, wrapper_class=ActionMasks)
    kwargs = build_algorithm_kwargs(algorithm, {"policy": "MlpPolicy", **CASES[name]}, name)
    return algorithm(env=env, seed=0, device="cpu", **kwargs)


def weights(model):
    return {key: value.tolist() for key, value in model.policy.state_dict().items()}


def goes_on(model, obs):
    """Its answers, and its weights after further training with the same random numbers."""
    answers = model.predict(obs, deterministic=True)[0].tolist()
    set_random_seed(5)
    model.env.seed(5)
    model.learn(40, reset_num_timesteps=False)
    return answers, weights(model), float(model.lr_schedule(0.5) if model.lr_schedule else 0)


@pytest.mark.parametrize("name", CASES)
def test_a_zip_is_loaded_as_by_the_library(name, tmp_path):
    """Of the library's own agents, see tests/safe_files."""
    model = made(name).learn(60)
    model.save(tmp_path / "model.zip")
    obs = np.stack([model.observation_space.sample() for _ in range(20)])
    theirs = type(model).load(tmp_path / "model.zip", made(name).env, device="cpu")
    ours = load_model(name, tmp_path / "model.zip", made(name).env, device="cpu")
    if name == "double_dqn":
        model.save_replay_buffer(tmp_path / "buffer.pkl")
        theirs.load_replay_buffer(tmp_path / "buffer.pkl")
        load_replay_buffer(ours, tmp_path / "buffer.pkl")
    ends = [goes_on(loaded, obs) for loaded in (theirs, ours)]
    assert ends[0] == ends[1]
    played = load_to_play(name, tmp_path / "model.zip", made(name).env, "cpu")
    assert played.predict(obs, deterministic=True)[0].tolist() == ends[0][0]


def changed(path, **changes):
    """The zip with other attributes."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["data"] = json.dumps({**json.loads(members["data"]), **changes}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


HUGE = {"type": "Discrete", "n": 10**9, "start": 0, "rng": None}


# Other attributes in its zip.
ATTRIBUTES = [
    ({"predict": 1}, "sets 'predict', which is no attribute of such an agent"),
    ({"observation_space": HUGE}, "more than 10,000,000"),
    ({"n_envs": "2"}, "is of an agent on .* environments, not on 1 to 100000"),
]


def test_what_is_damaged_is_refused(tmp_path):
    path, model = tmp_path / "model.zip", load_algorithm("qlearning")(env="FrozenLake-v1", seed=0)
    for changes, complaint in ATTRIBUTES:
        model.save(path)
        changed(path, **changes)
        with pytest.raises(UserError, match=complaint):
            load_model("qlearning", path)
    model.policy.q_tables += th.nan
    model.save(path)
    with pytest.raises(UserError, match="not finite"):
        load_model("qlearning", path)


# --- algorithms that know nothing of this project ------------------------------------------------


class Dice(A2C):
    """Answers at random, whatever it is asked for."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.random.default_rng().integers(4, size=len(observation)), None


def test_what_cannot_be_asked_for_all_states_is_sampled(tmp_path, request):
    agents.register("dice", f"{__name__}:Dice")
    request.addfinalizer(lambda: ALGORITHMS.pop("dice"))
    fields = {"n_timesteps": 20, "log_folder": tmp_path, "final_episodes": 4, "verbose": 1}
    outcome, printed = train_to(spec_for("dice", LAKE, {"policy_kwargs": TINY}, **fields))
    assert "evaluations are sampled, not exact: predict draws its actions at random" in printed
    assert (outcome.final.is_exact, len(outcome.final.returns)) == (False, 4)


# --- agents that are told what is valid ----------------------------------------------------------
SMALL = {"n_steps": 32, "batch_size": 32, "n_epochs": 1}
FEW = {"eval_freq": 32, "eval_episodes": 1, "final_episodes": 5}
NETWORK = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 10, "buffer_size": 500}
AGENTS = {
    "dqn": {**NETWORK, "engine": "library"},
    "ppo_mask": SMALL,
}


class Corridor(gym.Env):
    """Six cells in a row, the goal at the right end; what leaves the row is invalid and raises."""

    observation_space = spaces.Discrete(6)
    action_space = spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return self.cell, {}

    def action_masks(self):
        return np.array([self.cell > 0, True, False])

    def step(self, action):
        if not self.action_masks()[action]:
            raise AssertionError(f"action {action} is not valid in cell {self.cell}")
        self.cell += 1 if action == 1 else -1
        return self.cell, -1.0, self.cell == 5, False, {}


@pytest.fixture(scope="module", autouse=True)
def worlds():
    gym.register("Corridor-v0", Corridor, max_episode_steps=40)
    yield
    del gym.registry["Corridor-v0"]


def spec_of(algo, env_id=WAREHOUSE, folder=None, fields=(), **entry):
    short = {"env_kwargs": {"max_episode_steps": 30}} if env_id == WAREHOUSE else {}
    entry = {"n_timesteps": 64, **AGENTS.get(algo, {}), **short, **entry}
    common = {"eval_episodes": 3, "log_folder": folder, "verbose": 1, **dict(fields)}
    return spec_for(algo, env_id, entry, **common)


def masked(name, spec, steps=200):
    env, settings = make_training_env(spec, None), AGENTS.get(name, {"engine": "interpreted"})
    return agent_of(name, env, mask_actions=True, **settings).learn(steps)


def corridors(n_envs):
    return make_vec_env(lambda: gym.make("Corridor-v0"), n_envs, seed=0)


def train_to(spec):
    """The outcome of a training, and what was printed."""
    out = io.StringIO()
    outcome = training.train(spec, Console(file=out, width=200), {}, "train.py")
    return outcome, out.getvalue()


def test_nothing_invalid_is_done_in_training_evaluation_and_play(tmp_path):
    """The environment raises where a mask is not heeded, which a new policy's draws would not."""
    outcome, _ = train_to(spec_of("ppo_mask", "Corridor-v0", tmp_path, FEW))
    assert outcome.state == "finished"
    assert (outcome.final.is_exact, len(outcome.final.returns)) == (False, 5)
    maskable = agent_of("ppo_mask", Corridor(), device="cpu", **SMALL)
    for n_envs, deterministic in ((1, True), (3, False)):
        evaluation = evaluate(maskable, corridors(n_envs), 6, 0, deterministic)
        # A move costs 1, and five are needed.
        assert (evaluation.returns == -evaluation.lengths).all()
        assert (evaluation.lengths >= 5).all()
    played = list(play_episodes(maskable, corridors(1), 3, deterministic=False))
    assert [length for _, length in played] == [-total for total, _ in played]
    with pytest.raises(UserError, match="MaskablePPO needs action masks, and the env"):
        next(play_episodes(maskable, make_vec_env(LAKE, 1), 1))
    assert "<ActionMasks" in str(make_single_env(spec_of("dqn", mask_actions=True)))
    assert "ActionMasks" not in str(make_single_env(spec_of("dqn", mask_actions=False)))


@pytest.mark.parametrize("name", ["qlearning", "dqn"])
def test_no_evaluation_does_what_is_masked(name):
    spec = spec_of(name, mask_actions=True)
    agent, evaluator = masked(name, spec), exact_evaluator(spec)
    # A shelf costs 100, the edge of the map 1: what is masked alone can cost more than 30.
    env = make_evaluation_env(spec, 2)
    for deterministic in (True, False):
        policy = policy_matrix(agent, evaluator.observations, deterministic, evaluator.masks)
        assert not policy[~evaluator.masks].any()
        np.testing.assert_allclose(policy.sum(axis=1), 1)
        assert evaluate(agent, env, 6, 0, deterministic).returns.min() >= -30
    played = list(play_episodes(agent, make_evaluation_env(spec, 1), 3))
    assert all(total >= -30 for total, _ in played)
    if name == "dqn":
        sampled = evaluate(agent, make_evaluation_env(spec, 1), 1, 0)
        assert evaluator(agent).mean_return == sampled.mean_return
        untold, _ = agent.predict(evaluator.observations, deterministic=True)
        assert not evaluator.masks[evaluator.observations, untold].all(), "it would do otherwise"
        with pytest.raises(TypeError, match="which actions are valid in each state is not known"):
            policy_matrix(agent, evaluator.observations, True)


def test_an_agent_goes_on_with_its_masks(tmp_path):
    """Also where the settings of the second training do not say so."""
    fields = {**FEW, "n_eval_envs": 1}
    spec = spec_of("dqn", "Corridor-v0", tmp_path, fields, mask_actions=True, n_timesteps=40)
    first, _ = train_to(spec)
    entry = {key: value for key, value in spec.saved_hyperparams.items() if key != "mask_actions"}
    silent = replace(spec, hyperparams=split(entry), saved_hyperparams=entry)
    second, _ = train_to(replace(silent, trained_agent=first.run.model_path))
    assert second.run.recorded_spec()["hyperparams"]["mask_actions"] is True
