"""DQN and double DQN among the actions that the environment allows."""

import json
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the environments
from agents.library import DQN, DoubleDQN, MaskedReplayBuffer
from envs.known_models import action_masks_of_states
from envs.wrappers import ActionMasks

BOTH = pytest.mark.parametrize("algorithm", [DQN, DoubleDQN])
SMALL = {
    "policy": "MlpPolicy",
    "seed": 0,
    "mask_actions": True,
    "learning_starts": 50,
    "buffer_size": 1000,
    "policy_kwargs": {"net_arch": [8]},
}


def warehouse(n_envs=1, **kwargs):
    env_kwargs = {"max_episode_steps": 25, **kwargs}
    return make_vec_env("Warehouse-v0", n_envs, 0, env_kwargs=env_kwargs, wrapper_class=ActionMasks)


@BOTH
def test_nothing_masked_is_done_and_next_masks_are_kept(algorithm):
    env = warehouse(n_envs=2)
    agent = algorithm(env=env, exploration_final_eps=0.5, **SMALL).learn(900)
    masks = action_masks_of_states(env.envs[0])
    buffer = agent.replay_buffer
    seen = slice(0, buffer.pos)
    obs, after = buffer.observations[seen, :, 0], buffer.next_observations[seen, :, 0]
    actions, kept = buffer.actions[seen, :, 0], buffer.actions[seen, :, 1:]
    assert masks[obs, actions].all()
    going_on = buffer.dones[seen] * (1 - buffer.timeouts[seen]) == 0
    # Cut-off episodes too, whose environments have been reset by then.
    assert buffer.timeouts[seen].sum() > 20
    np.testing.assert_array_equal(kept[going_on], masks[after][going_on])


@BOTH
def test_predict(algorithm):
    agent = algorithm(env=warehouse(), **SMALL)
    masks = np.random.default_rng(0).random((100, 4)) < 0.4
    masks[:, 2] |= ~masks.any(axis=1)
    obs = np.arange(100)
    with th.no_grad():
        values = agent.q_net(agent.policy.obs_to_tensor(obs)[0]).numpy()
    best = np.where(masks, values, -np.inf).argmax(axis=1)
    chosen, _ = agent.predict(obs, deterministic=True, action_masks=masks)
    np.testing.assert_array_equal(chosen, best)
    assert int(agent.predict(5, deterministic=True, action_masks=masks[5])[0]) == best[5]
    agent.exploration_rate = 1.0
    for _ in range(10):
        chosen, _ = agent.predict(obs, action_masks=masks)
        assert masks[obs, chosen].all()


class TwoStates(gym.Env):
    """Action 1 leads to state 1, in which only actions 0 and 1 are allowed."""

    observation_space = spaces.Discrete(2)
    action_space = spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 0
        return 0, {}

    def action_masks(self):
        return np.array([True, True, self.s == 0])

    def step(self, action):
        self.s = int(action == 1)
        return self.s, 1.0, False, False, {}


@pytest.mark.parametrize(
    ("algorithm", "expected"),
    [
        # The target network's best allowed value in state 1.
        (DQN, 6.0),
        # Its value of the action that the online network prefers of the allowed.
        (DoubleDQN, -2.0),
    ],
)
def test_target_by_hand(algorithm, expected):
    agent = algorithm(env=ActionMasks(TwoStates()), **{**SMALL, "learning_starts": 0})
    agent.learn(40)
    online, target = th.tensor([[0.0] * 3, [1.0, 3.0, 9.0]]), th.tensor([[0.0] * 3, [6.0, -2, 70]])
    agent.q_net = lambda obs: online[obs[:, 0].long()]
    batch = agent.replay_buffer.sample(64)
    values = agent._next_values(lambda obs: target[obs[:, 0].long()])(batch.next_observations)
    in_state_1 = batch.next_observations[:, 0] == 1
    assert 0 < in_state_1.sum() < 64
    assert set(values.amax(dim=1)[in_state_1].tolist()) == {expected}
    assert set(values.amax(dim=1)[~in_state_1].tolist()) == {0.0}


def test_updates_with_masks_are_dqns_own_where_all_is_allowed():
    class Free(gym.Wrapper):
        def action_masks(self):
            return np.ones(2, bool)

    settings = {**SMALL, "learning_starts": 1000}
    masked = DQN(
        env=make_vec_env(lambda: ActionMasks(Free(gym.make("CartPole-v1"))), seed=0), **settings
    ).learn(60)
    plain = DQN(env="CartPole-v1", **{**settings, "mask_actions": False}).learn(60)
    # The same transitions: what is drawn to explore differs.
    masked.set_parameters(plain.get_parameters())
    for name in ("observations", "next_observations", "rewards", "dones", "timeouts"):
        getattr(masked.replay_buffer, name)[:] = getattr(plain.replay_buffer, name)
    masked.replay_buffer.actions[..., :1] = plain.replay_buffer.actions
    for agent in (masked, plain):
        np.random.seed(0)  # noqa: NPY002  # what the library's buffers draw from
        agent.train(5, 16)
    for ours, theirs in zip(masked.policy.parameters(), plain.policy.parameters(), strict=True):
        assert th.equal(ours, theirs)


def test_without_masks_it_is_the_librarys_agent_and_file(tmp_path):
    settings = {"seed": 0, "learning_starts": 50, "policy_kwargs": {"net_arch": [8]}}
    agents = [
        cls("MlpPolicy", "CartPole-v1", **settings).learn(300)
        for cls in (DQN, stable_baselines3.DQN)
    ]
    for ours, theirs in zip(*(agent.policy.parameters() for agent in agents), strict=True):
        assert th.equal(ours, theirs)
    data = []
    for i, agent in enumerate(agents):
        agent.save(tmp_path / str(i))
        data.append(zipfile.ZipFile(tmp_path / f"{i}.zip").read("data"))
    assert json.loads(data[0]).keys() == json.loads(data[1]).keys()
    assert b"agents." not in data[0]
    loaded = stable_baselines3.DQN.load(tmp_path / "0")
    assert not hasattr(loaded, "mask_actions")
    assert not DQN.load(tmp_path / "1").mask_actions


@BOTH
def test_a_zip_brings_it_back(algorithm, tmp_path):
    env = warehouse()
    algorithm(env=env, **SMALL).learn(100).save(tmp_path / "agent")
    loaded = algorithm.load(tmp_path / "agent", env=env)
    assert loaded.mask_actions
    assert isinstance(loaded.replay_buffer, MaskedReplayBuffer)
    loaded.learn(60)
    masks, buffer = action_masks_of_states(env.envs[0]), loaded.replay_buffer
    done = slice(0, buffer.pos)
    assert masks[buffer.observations[done, 0, 0], buffer.actions[done, 0, 0]].all()


def test_a_plain_file_can_go_on_with_masks_and_a_masked_one_without(tmp_path):
    plain = {**SMALL, "mask_actions": False}
    DQN(env=warehouse(), **plain).save(tmp_path / "plain")
    loaded = DQN.load(tmp_path / "plain", env=warehouse(), mask_actions=True).learn(60)
    loaded.save(tmp_path / "masked")
    assert isinstance(loaded.replay_buffer, MaskedReplayBuffer)
    again = DQN.load(tmp_path / "masked", env=warehouse(), mask_actions=False).learn(60)
    assert type(again.replay_buffer) is stable_baselines3.common.buffers.ReplayBuffer


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_steps": 3}, "^mask_actions needs n_steps of 1, not 3$"),
        (
            {"replay_buffer_class": stable_baselines3.her.HerReplayBuffer},
            "^mask_actions brings its own replay buffer: leave replay_buffer_class$",
        ),
        ({"env": "CartPole-v1"}, r"^mask_actions: the environment has no method action_masks\(\)"),
    ],
)
def test_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        DQN(**{"env": warehouse(), **SMALL, **kwargs})


def test_info_has_to_tell_of_episodes_that_are_cut_off():
    agent = DQN(env="Warehouse-v0", **SMALL)
    with pytest.raises(ValueError, match=r"^mask_actions of DQN: info holds no action_mask, .* "):
        agent.learn(10)


def test_a_mask_that_allows_nothing():
    class Stuck(TwoStates):
        def action_masks(self):
            return np.full(3, self.s == 0)

    with pytest.raises(ValueError, match=r"^the action mask for observation 1 allows no action$"):
        DQN(env=ActionMasks(Stuck()), **SMALL).learn(100)
