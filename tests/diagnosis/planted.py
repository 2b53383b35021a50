"""Hand-written tables in single files, as people write them, each right or with one fault."""

import random

import numpy as np
import torch as th
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.buffers import RolloutBuffer


class Agent:
    """A table, and how it acts."""

    def __init__(self, table, epsilon=0.0):
        self.table, self.epsilon = table, epsilon

    def act(self, obs):
        if random.random() < self.epsilon:  # noqa: S311 (as people write it)
            return random.randrange(self.table.shape[1])  # noqa: S311
        return int(self.table[number(obs)].argmax())

    def values(self, obs):
        return self.table[number(obs)]


def number(obs):
    """The state, of its number or of a vector with a one."""
    return int(np.argmax(obs)) if np.ndim(obs) else int(obs)


def one_step(
    make_env,
    seed,
    gamma,
    steps,
    exploration_initial_eps=1.0,
    exploration_final_eps=0.1,
    lam=0.0,
    learning_rate=0.1,
    *,
    target="max",
    fault="",
):
    """Q-learning, SARSA or Expected SARSA, also with replacing traces."""
    env, rng = make_env(), np.random.default_rng(None if fault == "not-reproducible" else seed)
    q = np.zeros((env.observation_space.n, env.action_space.n))
    traces, epsilon = np.zeros_like(q), exploration_initial_eps
    discount = {"discount-twice": gamma**2, "discount-missing": 1.0}.get(fault, gamma)
    fading = lam if fault == "lambda-alone" else gamma * lam

    def choose(state):
        drawn = np.random if fault == "global-generator" else rng
        if drawn.random() < epsilon:
            return int(rng.integers(len(q[state])))
        return int(q[state].argmax())

    obs, _ = env.reset(seed=seed)
    action = choose(obs)
    for step in range(steps):
        share = {"schedule-backwards": 1 - step / steps, "schedule-constant": 0.0}
        falls = exploration_final_eps - exploration_initial_eps
        epsilon = exploration_initial_eps + share.get(fault, step / steps) * falls
        following, reward, terminated, truncated, _ = env.step(action)
        shown, done = following, terminated or truncated
        if done:
            following, _ = env.reset()
        if fault == "reset-observation":
            shown = following
        next_action = choose(shown)
        is_greedy = q[shown, next_action] == q[shown].max()
        value = q[shown].max() if target == "max" else q[shown, next_action]
        if target == "expected":
            value = epsilon * q[shown].mean() + (1 - epsilon) * q[shown].max()
        ended = terminated and fault != "bootstraps-at-terminal"
        error = reward + (0.0 if ended else discount * value) - q[obs, action]
        traces[obs, action] = 1.0
        q += learning_rate * error * traces
        traces *= fading
        is_cut = target == "max" and not is_greedy
        if is_cut or (done and fault != "kept-across-episodes"):
            traces[:] = 0.0
        obs, action = following, choose(following) if done else next_action
    return Agent(q, 0.05 if fault == "explores-in-evaluation" else 0.0)


def from_memory(make_env, seed, gamma, steps, buffer_size=500, *, fault=""):
    """Q-learning on a table from a memory of steps, whose observations are vectors."""
    env, rng = make_env(), np.random.default_rng(seed)
    n_states = env.observation_space.shape[0]
    q, place = np.zeros((n_states, env.action_space.n)), 0
    memory = []
    obs, _ = env.reset(seed=seed)
    for _ in range(steps):
        action = int(rng.integers(q.shape[1]))
        following, reward, terminated, truncated, _ = env.step(action)
        item = (obs, action, reward, following, terminated)
        if len(memory) < buffer_size:
            memory.append(item)
        elif fault != "stale-buffer":
            memory[place] = item
            place = (place + 1) % buffer_size
        obs = env.reset()[0] if terminated or truncated else following
        for i in rng.integers(len(memory), size=4):
            then, done, paid, after, ended = memory[i]
            goal = paid + (0.0 if ended else gamma * q[number(after)].max())
            q[number(then), done] += 0.1 * (goal - q[number(then), done])
    return Agent(q)


def several_steps(make_env, seed, gamma, steps, n_steps=3, *, fault=""):
    """n-step SARSA."""
    env, rng = make_env(), np.random.default_rng(seed)
    q = np.zeros((env.observation_space.n, env.action_space.n))
    obs, _ = env.reset(seed=seed)
    action, window = int(rng.integers(q.shape[1])), []
    for _ in range(steps):
        following, reward, terminated, truncated, _ = env.step(action)
        window.append((obs, action, reward))
        next_action, done = int(rng.integers(q.shape[1])), terminated or truncated
        ahead = 0.0 if terminated else q[following, next_action]
        while window and (done or len(window) >= n_steps):
            n, faded = len(window), 1.0 if fault == "n-step-return" else gamma
            total = sum(faded**k * paid for k, (_, _, paid) in enumerate(window))
            then, did, _ = window.pop(0)
            q[then, did] += 0.1 * (total + gamma**n * ahead - q[then, did])
        obs, action = env.reset()[0] if done else following, next_action
    return Agent(q)


def preferences(make_env, seed, gamma, steps, *, fault=""):
    """One-step actor-critic on tables, with a softmax of preferences."""
    env, rng = make_env(), np.random.default_rng(seed)
    likes = np.zeros((env.observation_space.n, env.action_space.n))
    v = np.zeros(len(likes))
    obs, _ = env.reset(seed=seed)
    for _ in range(steps):
        chances = np.exp(likes[obs] - likes[obs].max())
        chances /= chances.sum()
        action = int(rng.choice(len(chances), p=chances))
        following, reward, terminated, truncated, _ = env.step(action)
        error = reward + (0.0 if terminated else gamma * v[following]) - v[obs]
        v[obs] += 0.1 * error
        slope = -chances
        slope[action] += 1.0
        likes[obs] += (-0.1 if fault == "advantage-sign" else 0.1) * error * slope
        obs = env.reset()[0] if terminated or truncated else following
    agent = Agent(likes)
    agent.values = lambda obs: v[[number(obs)]]
    return agent


MEMORIES = {}


class DQNSharesMemory(DQN):
    """Has one memory for all agents of the class, as a mutable default would make it."""

    def _setup_model(self):
        key = f"{self.observation_space} {self.action_space} {self.buffer_size}"
        self.replay_buffer = MEMORIES.get(key)
        super()._setup_model()
        MEMORIES[key] = self.replay_buffer


class DQNNeverCopies(DQN):
    """Its target network stays as it began."""

    def _on_step(self):
        tau, self.tau = self.tau, 0.0
        super()._on_step()
        self.tau = tau


class DQNAlwaysCopies(DQN):
    """Its target network follows at each training."""

    def train(self, gradient_steps, batch_size=100):
        self.q_net_target.load_state_dict(self.q_net.state_dict())
        super().train(gradient_steps, batch_size)


class DQNWithoutOptimizer(DQN):
    """Saves its weights alone."""

    def _get_torch_save_params(self):
        return ["q_net", "q_net_target"], []


class PPOEntropy(PPO):
    """Entropy is made small."""

    def train(self):
        weight, self.ent_coef = self.ent_coef, -self.ent_coef
        super().train()
        self.ent_coef = weight


class PPORatio(PPO):
    """Old by new, instead of new by old."""

    def train(self):
        evaluate = self.policy.evaluate_actions

        def turned_round(*args):
            values, log_prob, entropy = evaluate(*args)
            return values, -log_prob, entropy

        self.policy.evaluate_actions = turned_round
        self.rollout_buffer.log_probs *= -1
        super().train()
        del self.policy.evaluate_actions


class GAEWithoutLambda(RolloutBuffer):
    """Advantages that fade by gamma alone."""

    def compute_returns_and_advantage(self, last_values, dones):
        decay, self.gae_lambda = self.gae_lambda, float(self.gae_lambda > 0)
        super().compute_returns_and_advantage(last_values, dones)
        self.gae_lambda = decay


class PPOTraces(PPO):
    """Its advantages do not fade by lambda."""

    def __init__(self, *args, **kwargs):
        kwargs.setdefault("rollout_buffer_class", GAEWithoutLambda)
        super().__init__(*args, **kwargs)


class ForgetfulDQN(DQN):
    """Its weights are not in the file, but zeros."""

    def get_parameters(self):
        parameters = super().get_parameters()
        weights = parameters["policy"].items()
        return {**parameters, "policy": {name: th.zeros_like(part) for name, part in weights}}


class ForgetfulPPO(PPO):
    """Its learning rate's schedule is not in the file."""

    def _excluded_save_params(self):
        return [*super()._excluded_save_params(), "learning_rate", "lr_schedule"]
