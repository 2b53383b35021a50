"""One table of agents, each with settings other than its own, and what can be compared of them."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import BlockCallback, Horizon, calls_until_multiple
from rl_yardstick.agents.common.schedules import ExponentialSchedule

LAKE, COINS, SEGMENTS = "FrozenLake-v1", "BernoulliBandit-v0", "SegmentBandit-v0"
CONSTANT = {"exploration_decay": "constant", "exploration_initial_eps": 0.4}
FALLING = {"exploration_decay": "exponential", "exploration_fraction": 0.7}
COOLING = {"exploration": "boltzmann", "temperature": LinearSchedule(5.0, 0.2, 0.8)}
NOISE = {"exploration": "gaussian_noise", "noise_std": 20.0}
AVERAGE, LESS = {"learning_rate": "sample_average"}, {"learning_rate": LinearSchedule(0.8, 0.1, 1)}
DECAYING, FIRST = {"learning_rate": ExponentialSchedule(0.8, 0.01)}, {"tie_breaking": "first"}
AGENTS = {  # where each is tried, and with which settings
    "qlearning": (LAKE, {**CONSTANT, **FIRST, "learning_rate": 0.5, "mask_actions": False}),
    "sarsa": (LAKE, {**FALLING, **AVERAGE, "initial_q_std": 1.0}),
    "expected_sarsa": (LAKE, {**COOLING, **FIRST}),
    "double_qlearning": (LAKE, {**NOISE, **LESS}),
    "n_step_sarsa": (LAKE, {**NOISE, **DECAYING, "n_steps": 3}),
    "n_step_tree_backup": (LAKE, {**FALLING, "n_steps": 3, "target_policy": "greedy"}),
    "sarsa_lambda": (LAKE, {**COOLING, **AVERAGE, "trace_type": "dutch", "trace_decay": 0.5}),
    "q_lambda": (LAKE, {**CONSTANT, **LESS, "trace_type": "accumulating"}),
    "monte_carlo": (LAKE, {**CONSTANT, **DECAYING, "every_visit": True}),
    "off_policy_monte_carlo": (LAKE, CONSTANT),
    "dyna_q": (LAKE, {**NOISE, "outcomes_kept": 3, "skip_terminal_update": True}),
    "dyna_q_plus": (LAKE, {**CONSTANT, **AVERAGE, "kappa": 0.01}),
    "prioritized_sweeping": (LAKE, {**FALLING, "planning_steps": 1, "initial_q_std": 1.0}),
    "r_max": (LAKE, {"known_after": 3, "value_bound": 1.0}),
    "qlearning_ucb": (LAKE, {"value_bound": 1.0, "horizon": 30.0}),
    "semi_gradient_sarsa": ("MountainCar-v0", {**CONSTANT, "n_tiles": [3, 4]}),
    "semi_gradient_q": (LAKE, {**CONSTANT, **LESS, "initial_q": 0.5}),
    "actor_critic": (LAKE, {"value_step_size": 0.2, "initial_preferences": [0.1, 0, 0, 0]}),
    "reinforce": (LAKE, {"baseline": "value", "learning_rate": 0.5}),
    "value_iteration": (LAKE, {"gamma": 0.9}),
    "policy_iteration": (LAKE, {"gamma": 0.9}),
    "optimal": (LAKE, {}),
    "random": (LAKE, {}),
    "angle": ("CartPole-v1", {}),
    "epsilon_greedy": (SEGMENTS, {"initial_q": 3.0, "learning_rate": 0.2}),
    "boltzmann": (SEGMENTS, {"temperature": 0.7}),
    "ucb": (SEGMENTS, {"variant": "sutton_barto", "c": 0.5, "ignore_context": True}),
    "kl_ucb": (SEGMENTS, {"c": 2.0}),
    "gradient_bandit": (SEGMENTS, {"baseline": False, "learning_rate": 0.3}),
    "exp3": (SEGMENTS, {"mixing": 0.4}),
    "thompson": (SEGMENTS, {"likelihood": "gaussian", "prior_std": 3.0}),
    "linucb": (SEGMENTS, {"ridge": 2.0}),
    "lin_thompson": (SEGMENTS, {"alpha": 0.1}),
    "lin_epsilon_greedy": (SEGMENTS, CONSTANT),
    "mabwiser_epsilon_greedy": (COINS, {}),
    "mabwiser_ucb1": ("GaussianBandit-v0", {}),
    "mabwiser_thompson": (COINS, {}),
    "mabwiser_linucb": (SEGMENTS, {}),
}


class Plain(BaseCallback):
    """Has to be asked after each step; counts the episodes that end there."""

    ended = ()

    def _on_step(self):
        self.ended += (int(sum(self.locals["dones"])),)
        return True


class Every(BlockCallback):
    """Does something on every so many calls, and lets blocks be no longer than that."""

    def __init__(self, calls, do=lambda model: None):
        super().__init__()
        self.calls, self.do = calls, do

    def horizon(self):
        return Horizon(calls=calls_until_multiple(self.n_calls, self.calls))

    def _on_step(self):
        return self.n_calls % self.calls != 0 or self.do(self.model) is not False


class Unknown(gym.Env):
    """An environment of any spaces without a model, which may show what is not in them."""

    def __init__(self, observations=None, actions=None, first=None, shown=None, ends=0.1):
        self.observation_space = observations or spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = actions or spaces.Discrete(2)
        self.first, self.shown, self.ends = first, shown, ends

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample() if self.first is None else self.first, {}

    def step(self, action):
        obs = self.observation_space.sample() if self.shown is None else self.shown
        return obs, 0.5, bool(self.np_random.random() < self.ends), False, {}


def environment(env_id, n_envs=1, seed=3, wrapper=None, folder=None, **env_kwargs):
    """Environments under Monitor, which writes into the folder."""
    more = {"wrapper_class": wrapper, "monitor_dir": folder and str(folder)}
    return make_vec_env(env_id, n_envs, seed, env_kwargs=env_kwargs, **more)


def make(name, env, **settings):
    """An agent of the default policy."""
    algorithm = load_algorithm(name)
    return algorithm(next(iter(algorithm.policy_aliases)), env, **{"seed": 1, **settings})


def memory_of(model):
    """Arrays on running episodes; of those with room to spare, what is in use."""
    memory = getattr(model, "_memory", ())
    if not hasattr(memory, "tiles"):
        return memory
    kept = memory.tiles, memory.actions, memory.rewards
    return [array[i, :n] for array in kept for i, n in enumerate(memory.lengths)]


def state_of(model):
    """Everything that what comes next depends on, and everything that statistics are made of."""
    counts = model.num_timesteps, model._total_timesteps, model._episode_num, model._n_updates
    tables = model.policy.state_dict().items()
    state = {key: part.numpy().tobytes() for key, part in tables if hasattr(part, "numpy")}
    state |= {
        "generator": model.rng.bit_generator.state,
        "action generator": model.action_space.np_random.bit_generator.state,
        "observations": np.asarray(model._last_obs).tolist(),
        "episode starts": model._last_episode_starts.tolist(),
        "pending actions": np.asarray(getattr(model, "_next_actions", ())).tolist(),
        "memory": [array.tobytes() for array in memory_of(model)],
        "counts": (*counts, model._current_progress_remaining),
        "error": getattr(model, "mean_td_error", None),
        "returns": [(info["r"], info["l"]) for info in model.ep_info_buffer],
        "successes": [bool(success) for success in model.ep_success_buffer],
    }
    names = ("episode_returns", "episode_lengths", "rewards", "total_steps", "needs_reset")
    for i, env in enumerate(model.env.envs):
        places = [vars(env.unwrapped).get(name) for name in ("s", "state", "context", "place")]
        state[f"place of {i}"] = [np.asarray(place).tolist() for place in places]
        state[f"Monitor of {i}"] = [env.get_wrapper_attr(name) for name in names]
        limited = env.has_wrapper_attr("_elapsed_steps")
        state[f"time of {i}"] = limited and env.get_wrapper_attr("_elapsed_steps")
        state[f"generator of {i}"] = env.unwrapped.np_random.bit_generator.state
    return state


def assert_same(first, *others):
    """States agree; what does not is named."""
    for other in others:
        assert first.keys() == other.keys()
        assert [key for key in other if other[key] != first[key]] == []
