"""Agents of libraries and of strangers, told what is valid or with a memory: run, saved, judged."""

import io
import json
import sys
import zipfile
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from rich.console import Console
from stable_baselines3 import A2C, DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import set_random_seed

import agents
import enjoy
from agents import ALGORITHMS, load_algorithm
from agents.common.model_files import JsonAlgorithm
from envs.wrappers import ActionMasks, has_masks
from pipeline import training
from pipeline.agent_settings import check_fit
from pipeline.environments import make_evaluation_env, make_single_env, make_training_env
from pipeline.errors import UserError
from pipeline.evaluation.exact import exact_evaluator
from pipeline.evaluation.policies import has_memory, player, policy_matrix
from pipeline.evaluation.sampled import evaluate
from pipeline.models.choose import ModelRequest, choose_model
from pipeline.models.load import (
    load_model,
    load_replay_buffer,
    load_to_play,
    own_classes,
)
from pipeline.playing import play_episodes, playing_env
from pipeline.settings.components import build_algorithm_kwargs, default_policy
from pipeline.settings.hyperparams import split
from pipeline.user_modules import import_typed
from tests.pipeline.short_runs import LAKE, SWING, WAREHOUSE, agent_of
from tests.pipeline.short_runs import spec_of as spec_for

# --- zips of our subclasses of library agents: loaded as data, they are what the library loads ---
TINY = {"net_arch": [4]}
OFF = {"learning_starts": 10, "buffer_size": 100, "batch_size": 8, "policy_kwargs": TINY}
EXPONENTIAL = {"learning_rate": "exp_0.1_0.001"}
ROLLOUT = {"n_steps": 16, "policy_kwargs": TINY}
CASES = {
    "dqn": {**OFF, **EXPONENTIAL},
    "double_dqn": {**OFF, **EXPONENTIAL},
    "deep_qlearning": OFF,
    "ppo": {**ROLLOUT, **EXPONENTIAL, "batch_size": 8, "clip_range": "exp_0.4_0.1"},
    "a2c": {**ROLLOUT, "learning_rate": "lin_0.1"},
    "ppo_lstm": {**ROLLOUT, "batch_size": 8, "policy_kwargs": {**TINY, "lstm_hidden_size": 4}},
    "ars": {"n_delta": 1},
    "td3": OFF,
}


def made(name, **more):
    algorithm = load_algorithm(name)
    is_continuous = ALGORITHMS[name].actions == ("Box",)
    env_id, wrapper = (SWING, None) if is_continuous else (WAREHOUSE, ActionMasks)
    env = make_vec_env(env_id, 1, seed=0, wrapper_class=wrapper)
    policy = {"ppo_lstm": "MlpLstmPolicy", "ars": "LinearPolicy"}.get(name, "MlpPolicy")
    kwargs = build_algorithm_kwargs(algorithm, {"policy": policy, **CASES[name], **more}, name)
    if name == "td3":
        kwargs["action_noise"] = NormalActionNoise(np.zeros(1), np.full(1, 0.1))
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


def test_all_of_them_are_tried():
    """Those of the library itself are tried in tests/safe_files."""
    assert set(CASES) - {"ppo_lstm", "td3"} == {
        name
        for name, entry in ALGORITHMS.items()
        if entry.entry_point.startswith("agents")
        and not issubclass(load_algorithm(name), JsonAlgorithm)
    }


@pytest.mark.parametrize(
    ("name", "more"),
    [
        *((name, {}) for name in CASES),
        ("double_dqn", {"mask_actions": True}),
    ],
)
def test_a_zip_is_loaded_as_by_the_library(name, more, tmp_path):
    model = made(name, **more).learn(60)
    model.save(tmp_path / "model.zip")
    obs = np.stack([model.observation_space.sample() for _ in range(20)])
    has_buffer = getattr(model, "replay_buffer", None) is not None
    if has_buffer:
        model.save_replay_buffer(tmp_path / "buffer.pkl")
    theirs = type(model).load(tmp_path / "model.zip", made(name, **more).env, device="cpu")
    ours = load_model(name, tmp_path / "model.zip", made(name, **more).env, device="cpu")
    if has_buffer:
        theirs.load_replay_buffer(tmp_path / "buffer.pkl")
        load_replay_buffer(ours, tmp_path / "buffer.pkl")
    ends = [goes_on(loaded, obs) for loaded in (theirs, ours)]
    assert ends[0] == ends[1]
    played = load_to_play(name, tmp_path / "model.zip", made(name, **more).env, "cpu")
    assert played.predict(obs, deterministic=True)[0].tolist() == ends[0][0]


def changed(path, **changes):
    """The zip with other attributes."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["data"] = json.dumps({**json.loads(members["data"]), **changes}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def test_a_function_as_schedule_is_refused_with_the_way_out(tmp_path):
    path = tmp_path / "model.zip"
    model = made("ppo")
    model.learning_rate = lambda progress: 1e-3 * progress
    model.save(path)
    with pytest.raises(UserError) as refused:
        load_model("ppo", path)
    said = str(refused.value)
    assert "learning_rate holds a function with its code" in said
    assert said.endswith("-params learning_rate:3e-4")
    assert load_model("ppo", path, learning_rate=3e-4).lr_schedule(0.5) == 3e-4
    # To play, nobody asks for it.
    assert load_to_play("ppo", path, model.env, "cpu").lr_schedule(0.5) == 0.0


HUGE = {"type": "Discrete", "n": 10**9, "start": 0, "rng": None}
DAMAGE = {
    "whole numbers": (lambda table: table.to(th.int8), "not of the kind"),
    "complex": (lambda table: table.to(th.complex128), "not of the kind"),
    "not a number": (lambda table: table * th.nan, "not finite"),
    "infinite": (lambda table: table + th.inf, "not finite"),
    "too small": (lambda table: table[:, :-1], "size mismatch"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_tables_are_finite_numbers_of_the_right_kind_and_shape(case, tmp_path):
    damage, complaint = DAMAGE[case]
    model = load_algorithm("qlearning")(env="FrozenLake-v1", seed=0)
    with th.no_grad():
        model.policy.q_tables = damage(model.policy.q_tables)
    model.save(tmp_path / "model.zip")
    with pytest.raises(UserError, match=complaint):
        load_model("qlearning", tmp_path / "model.zip")


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        *(
            ({key: 1}, f"sets '{key}', which is no attribute of such an agent")
            for key in ("predict", "no_such_thing", "__class__")
        ),
        ({"observation_space": 3}, "does not say its observation_space"),
        ({"observation_space": HUGE}, "more than 10,000,000"),
        *(
            ({"n_envs": n}, r"is of an agent on .* environments, not on 1 to 100000")
            for n in (0, 10**12, "2")
        ),
    ],
)
def test_attributes_are_those_of_an_agent_and_of_bearable_size(changes, complaint, tmp_path):
    path = tmp_path / "model.zip"
    load_algorithm("qlearning")(env="FrozenLake-v1", seed=0).save(path)
    changed(path, **changes)
    with pytest.raises(UserError, match=complaint):
        load_model("qlearning", path)


MINE = """
import agents
from stable_baselines3 import PPO
from stable_baselines3.common.torch_layers import FlattenExtractor

agents.register("mine_ppo", f"{__name__}:Mine", actions="Discrete")


class Net(FlattenExtractor):
    pass


class Job:
    pass


class Mine(PPO):
    bonus = 0.5

    def __init__(self, *args, bonus=0.5, **kwargs):
        self.bonus = bonus
        super().__init__(*args, **kwargs)
"""


def test_classes_of_the_users_are_admitted_where_the_module_was_typed(own_folder):
    (own_folder / "mine.py").write_text(MINE)
    modules = import_typed(["mine"])
    net = sys.modules["mine"].Net
    settings = {"policy": "MlpPolicy", "env": "CartPole-v1", "device": "cpu"}
    settings["policy_kwargs"] = {**TINY, "features_extractor_class": net}
    for name, more in (("ppo", {}), ("mine_ppo", {"bonus": 0.25})):
        model = load_algorithm(name)(**settings, **more)
        model.save(own_folder / "model.zip")
        loaded = load_model(name, own_folder / "model.zip", modules=modules)
        assert type(loaded) is type(model)
        assert type(loaded.policy.features_extractor) is net
        assert weights(loaded) == weights(model)
        assert vars(loaded).get("bonus") == more.get("bonus")
    load_algorithm("ppo")(**settings).save(own_folder / "model.zip")
    with pytest.raises(UserError, match=r"refers to mine\.Net, .* --gym-packages MODULE"):
        load_model("ppo", own_folder / "model.zip")
    # What is no part of a network may not be named, wherever it comes from.
    assert set(own_classes(load_algorithm("ppo"), modules)) >= {"mine.Net"}
    assert "mine.Job" not in own_classes(load_algorithm("mine_ppo"), modules)


# --- algorithms that know nothing of this project ------------------------------------------------


class Plain:
    """As a stranger writes it, without annotations."""

    policy_aliases = {"FirstPolicy": object}  # noqa: RUF012

    def __init__(self, policy, env, weight=0.5, kind="mean", count=3):
        pass


class Rising(DQN):
    def __init__(self, *args, first=0.5, **kwargs):
        super().__init__(*args, **kwargs)


class OneByOne(A2C):
    """Takes one observation at a time."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.array([int(np.asarray(observation).item()) % 4]), None


class Forgetful(A2C):
    """Remembers how often it was asked."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.zeros(len(observation), int), (state or (0,))


class Dice(A2C):
    """Cannot be told to be deterministic."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.random.default_rng().integers(4, size=len(observation)), None


@pytest.fixture
def registered():
    before = dict(agents.ALGORITHMS)
    for cls in (OneByOne, Forgetful, Dice):
        agents.register(cls.__name__.lower(), f"{__name__}:{cls.__name__}")
    yield
    agents.ALGORITHMS.clear()
    agents.ALGORITHMS.update(before)


@pytest.mark.parametrize(
    ("algorithm", "kwargs", "complaint"),
    [
        (Plain, {"wieght": 1}, "unknown hyperparameter 'wieght': did you mean 'weight'?"),
        (Plain, {"policy": "Frst"}, "unknown policy 'Frst'"),
        (Rising, {"policy": "MlpPolicy", "gamma": "high"}, "gamma must be a number, not 'high'"),
        (Rising, {"policy": "MlpPolicy", "seed": 1}, "seed is set by --seed, not here"),
    ],
)
def test_a_wrong_argument_is_told_and_what_has_no_annotation_is_read_as_its_default(
    algorithm, kwargs, complaint
):
    for given, read in (("1e-4", 1e-4), (2, 2.0), ("auto", "auto"), (None, None)):
        arguments = {"policy": "FirstPolicy", "weight": given}
        assert build_algorithm_kwargs(Plain, arguments, "plain")["weight"] == read
    policies = [default_policy(cls, is_dict=is_dict) for cls in (DQN, Plain) for is_dict in (0, 1)]
    assert policies == ["MlpPolicy", "MultiInputPolicy", "FirstPolicy", "FirstPolicy"]
    with pytest.raises(UserError) as caught:
        build_algorithm_kwargs(algorithm, {"policy": "FirstPolicy", **kwargs}, "mine")
    assert complaint in str(caught.value)


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(
    ("algo", "reason"),
    [
        ("onebyone", "predict takes no batch of observations (ValueError)"),
        ("forgetful", "predict remembers what it saw before"),
        ("dice", "predict draws its actions at random"),
    ],
)
def test_what_cannot_be_asked_for_all_states_is_sampled(algo, reason, tmp_path):
    console = Console(record=True, width=200, file=io.StringIO())
    fields = {"n_timesteps": 60, "log_folder": tmp_path, "eval_freq": 20, "eval_episodes": 4}
    spec = spec_for(algo, LAKE, {"policy_kwargs": TINY}, verbose=1, **fields)
    outcome = training.train(spec, console, {}, "")
    assert f"evaluations are sampled, not exact: {reason}" in console.export_text()
    assert not outcome.final.is_exact
    assert len(outcome.final.returns) == 100
    with np.load(outcome.run.evaluations_path) as evaluations:
        assert evaluations["results"].shape == (3, 4)


# --- agents that are told what is valid ----------------------------------------------------------
SMALL = {"n_steps": 32, "batch_size": 32, "n_epochs": 1}
NETWORK = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 10, "buffer_size": 500}
AGENTS = {"dqn": NETWORK, "double_dqn": NETWORK, "ppo_mask": SMALL, "ppo": SMALL}
AGENTS |= {"ppo_lstm": {**SMALL, "policy_kwargs": {"lstm_hidden_size": 8}}}


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


class Told(gym.Env):
    """Says by its info alone that only the second of two actions may be done."""

    observation_space = spaces.Box(0, 1, (1,))
    action_space = spaces.Discrete(2)

    @property
    def told(self):
        return {"action_mask": np.array([0, 1], dtype=np.int8)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), self.told

    def step(self, action):
        assert action == 1, "masked"
        return np.zeros(1, np.float32), 1.0, False, False, self.told


@pytest.fixture(scope="module", autouse=True)
def worlds():
    gym.register("Corridor-v0", Corridor, max_episode_steps=40)
    gym.register("Told-v0", Told, max_episode_steps=8)
    yield
    del gym.registry["Corridor-v0"], gym.registry["Told-v0"]


def spec_of(algo, env_id=WAREHOUSE, folder=None, fields=(), **entry):
    short = {"env_kwargs": {"max_episode_steps": 30}} if env_id == WAREHOUSE else {}
    entry = {"n_timesteps": 64, **AGENTS.get(algo, {}), **short, **entry}
    common = {"eval_episodes": 3, "log_folder": folder, "verbose": 1, **dict(fields)}
    return spec_for(algo, env_id, entry, **common)


def masked(name, spec, steps=200):
    env = make_training_env(spec, None)
    return agent_of(name, env, mask_actions=True, **AGENTS.get(name, {})).learn(steps)


def corridors(n_envs):
    return make_vec_env(lambda: gym.make("Corridor-v0"), n_envs, seed=0)


def train_to(spec):
    """The outcome of a training, and what was printed."""
    out = io.StringIO()
    outcome = training.train(spec, Console(file=out, width=200), {}, "train.py")
    return outcome, out.getvalue()


def test_nothing_invalid_is_done_in_training_evaluation_and_play(tmp_path):
    """The environment raises where a mask is not heeded, which a new policy's draws would not."""
    outcome, _ = train_to(spec_of("ppo_mask", "Corridor-v0", tmp_path, {"eval_freq": 32}))
    assert outcome.state == "finished"
    assert (outcome.final.is_exact, len(outcome.final.returns)) == (False, 100)
    maskable = agent_of("ppo_mask", Corridor(), device="cpu", **SMALL)
    for n_envs, deterministic in ((1, True), (3, True), (1, False), (3, False)):
        evaluation = evaluate(maskable, corridors(n_envs), 6, 0, deterministic)
        # A move costs 1, and five are needed.
        assert (evaluation.returns == -evaluation.lengths).all()
        assert (evaluation.lengths >= 5).all()
    played = list(play_episodes(maskable, corridors(1), 3, deterministic=False))
    assert [length for _, length in played] == [-total for total, _ in played]
    with pytest.raises(UserError, match="MaskablePPO has to be told which actions are valid, and"):
        next(play_episodes(maskable, make_vec_env(LAKE, 1), 1))
    deaf = agent_of("random", Corridor())
    assert player(deaf, corridors(1)) is deaf
    for env_id in ("Told-v0", "Taxi-v4", WAREHOUSE):
        assert has_masks(gym.make(env_id))
        for name in ("dqn", "ppo_mask"):
            spec = spec_of(name, env_id, mask_actions=True)
            check_fit(spec)
            assert "<ActionMasks" in str(make_single_env(spec))
    assert "ActionMasks" not in str(make_single_env(spec_of("dqn", mask_actions=False)))


def test_an_environment_without_masks_is_refused():
    with pytest.raises(UserError) as caught:
        check_fit(spec_of("ppo_mask", "CartPole-v1"))
    (line,) = str(caught.value).splitlines()
    assert line.startswith(
        "ppo_mask does not fit CartPole-v1: it needs to be told which actions are valid, by a "
        "method action_masks() or by info['action_mask']; fitting agents: semi_gradient_sarsa, "
        "semi_gradient_q, actor_critic, reinforce, dqn, "
    )
    assert "ppo_mask" not in line.partition("fitting agents")[2]
    for env_id in ("CartPole-v1", "FrozenLake-v1"):
        with pytest.raises(UserError, match=f"^mask_actions: {env_id} has no action masks: neith"):
            make_single_env(spec_of("dqn", env_id, mask_actions=True), training=True)


def test_a_masked_policy_is_the_plain_one_on_what_is_valid():
    """Leaving actions out of a softmax divides the others by what they add up to."""
    evaluator = exact_evaluator(spec_of("ppo_mask", "FrozenLake-v1"))
    env = gym.make("FrozenLake-v1")
    agent = load_algorithm("ppo_mask")("MlpPolicy", env, seed=0, device="cpu", **SMALL)
    masks = np.random.default_rng(0).random((16, 4)) < 0.5
    masks[:, 2] |= ~masks.any(axis=1)
    obs = evaluator.observations
    with th.no_grad():
        tensor, _ = agent.policy.obs_to_tensor(obs)
        plain = agent.policy.get_distribution(tensor).distribution.probs.numpy()
    expected = plain * masks / (plain * masks).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(policy_matrix(agent, obs, False, masks), expected, atol=1e-6)
    best = policy_matrix(agent, obs, True, masks)
    assert (best.argmax(axis=1) == expected.argmax(axis=1)).all()
    with pytest.raises(TypeError, match="MaskablePPO: which actions are valid in each state is"):
        policy_matrix(agent, obs, deterministic=True)
    assert evaluator.obstacle(agent) != ""


@pytest.mark.parametrize("name", ["qlearning", "dqn", "double_dqn"])
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


def test_an_agent_goes_on_with_its_masks_and_is_played_with_them(tmp_path):
    """Also where the settings of the second training do not say so."""
    fields = {"eval_episodes": 1, "n_eval_envs": 1}
    spec = spec_of("dqn", "Told-v0", tmp_path, fields, mask_actions=True, n_timesteps=40)
    first, _ = train_to(spec)
    entry = {key: value for key, value in spec.saved_hyperparams.items() if key != "mask_actions"}
    silent = replace(spec, hyperparams=split(entry), saved_hyperparams=entry)
    second, _ = train_to(replace(silent, trained_agent=first.run.model_path))
    assert second.final.mean_return == 8
    assert second.run.recorded_spec()["hyperparams"]["mask_actions"] is True
    # A zip that says nothing else of its settings.
    alone = tmp_path / "alone.zip"
    alone.write_bytes(second.run.model_path.read_bytes())
    request = ModelRequest(alone, algo="dqn", env_id="Told-v0", log_folder=tmp_path, device="cpu")
    env = playing_env(choose_model(request), None)
    env.reset()
    assert env.env_method("action_masks")[0].tolist() == [False, True]


# --- agents with a memory ------------------------------------------------------------------------


class Counting(gym.Env):
    """Rewards the action that is the number of steps done so far; shows nothing."""

    observation_space = spaces.Discrete(1)
    action_space = spaces.Discrete(20)

    def __init__(self, length):
        self.length = length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return 0, {}

    def step(self, action):
        reward = float(action == self.steps)
        self.steps += 1
        return 0, reward, self.steps == self.length, False, {}


class Counter:
    """Acts by how often it was asked since its episode began, which only its state says."""

    num_timesteps = 0

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        state = np.zeros(len(observation), int) if state is None else state
        actions = np.where(episode_start, 0, state)
        return actions, actions + 1


@pytest.mark.parametrize("ends", [[4], [4, 7, 5]])
def test_evaluation_and_play_hand_the_state_on(ends):
    lengths = iter(ends)
    env = make_vec_env(lambda: Counting(next(lengths)), len(ends))
    evaluation = evaluate(Counter(), env, 9, 0)
    assert (evaluation.returns == evaluation.lengths).all()
    assert sorted(set(evaluation.lengths)) == sorted(ends)
    if len(ends) == 1:
        assert list(play_episodes(Counter(), env, 3)) == [(4, 4)] * 3


def test_an_agent_with_a_memory_is_judged_by_episodes_and_says_so(tmp_path, monkeypatch, capsys):
    outcome, printed = train_to(spec_of("ppo_lstm", LAKE, tmp_path))
    assert (outcome.final.is_exact, len(outcome.final.returns)) == (False, 100)
    assert printed.count("evaluations are sampled, not exact: it acts by what it remembers") == 1
    words = ["enjoy.py", "--algo", "ppo_lstm", "--env", LAKE, "-f", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*words, "--no-render", "--n-episodes", "2"])
    assert enjoy.main() == 0
    printed = capsys.readouterr().out
    assert "sampled, not exact: ppo_lstm" in printed
    assert "(exact)" not in printed
    # Asked for every state at once, it would take them for one after another.
    agent = agent_of("ppo_lstm", LAKE, device="cpu", **AGENTS["ppo_lstm"])
    assert has_memory(agent)
    with pytest.raises(TypeError, match="RecurrentPPO: it acts by what it remembers"):
        policy_matrix(agent, np.arange(16))
    outcome, printed = train_to(spec_of("ppo", LAKE, tmp_path))
    assert outcome.final.is_exact
    assert "evaluations are" not in printed
