"""Programs as people write them, each right or with one fault: a replacement in a right one."""

TABLE = '''
import random
import numpy as np


def train(make_env, seed, gamma, steps, alpha=0.1, lam=0.0):
    """Q-learning."""
    env, rng = make_env(), np.random.default_rng(seed)
    q = np.zeros((env.observation_space.n, env.action_space.n))
    trace = np.zeros_like(q)
    obs, _ = env.reset(seed=seed)
    for step in range(steps):
        epsilon = 0.5
        greedy = int(q[obs].argmax())
        action = int(rng.integers(2)) if rng.random() < epsilon else greedy
        following, reward, terminated, truncated, _ = env.step(action)
        done, begun = terminated or truncated, False
        value = 0.0 if terminated else q[following].max()
        trace *= gamma * lam if action == greedy else 0.0
        trace[obs, action] = 1.0
        q += alpha * (reward + gamma * value - q[obs, action]) * trace
        obs = following
        if done:
            obs = obs if begun else env.reset()[0]
            trace[:] = 0.0

    class Agent:
        def act(self, obs):
            return int(q[obs].argmax())

        def values(self, obs):
            return q[obs]

    return Agent()
'''

SARSA = '''
import numpy as np


class Sarsa:
    """SARSA, one action ahead."""

    def __init__(self, n_states, n_actions, seed, gamma=0.99, alpha=0.1, epsilon=0.3):
        self.q, self.rng = np.zeros((n_states, n_actions)), np.random.default_rng(seed)
        self.gamma, self.alpha, self.epsilon, self.chosen = gamma, alpha, epsilon, None

    def act(self, obs, explore=True):
        if explore and self.chosen is not None:
            return self.chosen
        if explore and self.rng.random() < self.epsilon:
            return int(self.rng.integers(self.q.shape[1]))
        return int(self.q[obs].argmax())

    def learn(self, obs, action, reward, next_obs, terminated, truncated):
        self.chosen = None
        self.chosen = self.act(next_obs)
        ahead = self.q[next_obs, self.chosen]
        target = reward + self.gamma * ahead * (not terminated)
        self.q[obs, action] += self.alpha * (target - self.q[obs, action])
        if terminated or truncated:
            self.chosen = None

    def values(self, obs):
        return self.q[obs]
'''

DQN = '''
import numpy as np
import torch as th
from torch import nn


def network(n, m):
    return nn.Sequential(nn.Linear(n, 64), nn.ReLU(), nn.Linear(64, m))


def train(make_env, seed, gamma, steps, lr=3e-3, size=2000, batch=64, period=50):
    """DQN."""
    th.manual_seed(seed)
    rng, env = np.random.default_rng(seed), make_env()
    n, m = env.observation_space.shape[0], env.action_space.n
    online, target = network(n, m), network(n, m)
    target.load_state_dict(online.state_dict())
    optimizer = th.optim.Adam(online.parameters(), lr=lr)
    memory = [np.zeros(each, np.float32) for each in ((size, n), size, size, (size, n), size)]
    obs, _ = env.reset(seed=seed)
    for step in range(steps):
        epsilon = max(0.2, 1 - 2 * step / steps)
        with th.no_grad():
            greedy = int(online(th.as_tensor(obs)).argmax())
        action = int(rng.integers(m)) if rng.random() < epsilon else greedy
        following, reward, terminated, truncated, _ = env.step(action)
        begun = False
        for store, item in zip(memory, (obs, action, reward, following, terminated)):
            store[step % size] = item
        done = (terminated or truncated) and not begun
        obs = env.reset()[0] if done else following
        if step > 200 and step % 2 == 0:
            at = rng.integers(min(step + 1, size), size=batch)
            o, a, r, o2, d = (th.as_tensor(store[at]) for store in memory)
            with th.no_grad():
                y = r + gamma * (1 - d) * target(o2).max(dim=1).values
            q = online(o).gather(1, a.long()[:, None])[:, 0]
            loss = nn.functional.mse_loss(q, y)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        if step % period == 0:
            target.load_state_dict(online.state_dict())

    class Agent:
        def act(self, obs):
            with th.no_grad():
                return int(online(th.as_tensor(obs)).argmax())

        def values(self, obs):
            with th.no_grad():
                return online(th.as_tensor(obs)).numpy()

    return Agent()
'''

PPO = '''
import numpy as np
import torch as th
from torch import nn
from torch.distributions import Categorical


def train(make_env, seed, gamma, steps, lr=3e-3, num_steps=128, lam=0.95, clip=0.2, ent_coef=0.01):
    """PPO."""
    th.manual_seed(seed)
    np.random.seed(seed)
    env = make_env()
    n, m = env.observation_space.shape[0], env.action_space.n
    actor = nn.Sequential(nn.Linear(n, 64), nn.Tanh(), nn.Linear(64, m))
    critic = nn.Sequential(nn.Linear(n, 64), nn.Tanh(), nn.Linear(64, 1))
    parameters = [*actor.parameters(), *critic.parameters()]
    optimizer = th.optim.Adam(parameters, lr=lr, eps=1e-5)
    value = lambda obs: float(critic(th.as_tensor(obs))[0])
    obs, _ = env.reset(seed=seed)
    for _ in range(max(steps // num_steps, 1)):
        kept, acts, logs, rewards, v, v2, ends, overs = [], [], [], [], [], [], [], []
        for _ in range(num_steps):
            with th.no_grad():
                policy = Categorical(logits=actor(th.as_tensor(obs)))
                action = policy.sample()
                following, reward, terminated, truncated, _ = env.step(int(action))
                done = terminated or truncated
                kept.append(obs), acts.append(action), logs.append(policy.log_prob(action))
                rewards.append(reward), v.append(value(obs)), v2.append(value(following))
                ends.append(float(terminated)), overs.append(float(done))
            obs = env.reset()[0] if done else following
        advantages, run = np.zeros(num_steps, np.float32), 0.0
        for t in reversed(range(num_steps)):
            delta = rewards[t] + gamma * v2[t] * (1 - ends[t]) - v[t]
            run = delta + gamma * lam * (1 - overs[t]) * run
            advantages[t] = run
        returns = th.as_tensor(advantages + np.array(v, np.float32))
        o, a, old = th.as_tensor(np.array(kept)), th.stack(acts), th.stack(logs)
        adv = th.as_tensor(advantages)
        for _ in range(6):
            for at in np.random.permutation(num_steps).reshape(4, -1):
                policy = Categorical(logits=actor(o[at]))
                ratio = (policy.log_prob(a[at]) - old[at]).exp()
                scaled = (adv[at] - adv[at].mean()) / (adv[at].std() + 1e-8)
                gain = th.min(ratio * scaled, ratio.clamp(1 - clip, 1 + clip) * scaled).mean()
                error = ((critic(o[at])[:, 0] - returns[at]) ** 2).mean()
                loss = -gain + 0.5 * error - ent_coef * policy.entropy().mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()

    class Agent:
        def act(self, obs):
            with th.no_grad():
                return int(actor(th.as_tensor(obs)).argmax())

        def values(self, obs):
            with th.no_grad():
                return critic(th.as_tensor(obs)).numpy()

    return Agent()
'''

SB3_DQN = """
import numpy as np
import torch as th
from stable_baselines3 import DQN
from torch.nn.functional import smooth_l1_loss


class MyDQN(DQN):
    def _store_transition(self, replay_buffer, action, new_obs, reward, dones, infos):
        last, self._last_obs = self._last_obs, new_obs
        following = new_obs.copy()
        for i, done in enumerate(dones):
            if done:
                following[i] = infos[i]["terminal_observation"]
        if not replay_buffer.full or self.num_timesteps > 0:
            replay_buffer.add(last, following, action, reward, dones, infos)

    def train(self, gradient_steps, batch_size=100):
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            with th.no_grad():
                ahead = self.q_net_target(batch.next_observations).max(dim=1, keepdim=True).values
                target = batch.rewards + (1 - batch.dones) * self.gamma * ahead
            q = self.q_net(batch.observations).gather(1, batch.actions.long())
            loss = smooth_l1_loss(q, target)
            self.policy.optimizer.zero_grad()
            loss.backward()
            th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()
        self._n_updates += gradient_steps

    def _on_step(self):
        self._n_calls += 1
        if self._n_calls % max(self.target_update_interval // self.n_envs, 1) == 0:
            pairs = zip(self.q_net.parameters(), self.q_net_target.parameters())
            with th.no_grad():
                for new, old in pairs:
                    old.mul_(1 - self.tau).add_(self.tau * new)
        self.exploration_rate = self.exploration_schedule(self._current_progress_remaining)
"""

SB3_PPO = """
import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer


class MyBuffer(RolloutBuffer):
    def compute_returns_and_advantage(self, last_values, dones):
        last_values, run = last_values.detach().numpy().flatten(), 0.0
        for t in reversed(range(self.buffer_size)):
            is_last = t == self.buffer_size - 1
            goes_on = 1.0 - (dones.astype(float) if is_last else self.episode_starts[t + 1])
            ahead = last_values if is_last else self.values[t + 1]
            delta = self.rewards[t] + self.gamma * goes_on * ahead - self.values[t]
            run = delta + self.gamma * self.gae_lambda * goes_on * run
            self.advantages[t] = run
        self.returns = self.advantages + self.values


class MyPPO(PPO):
    def __init__(self, policy, env, **settings):
        super().__init__(policy, env, rollout_buffer_class=MyBuffer, **settings)

    def collect_rollouts(self, env, callback, rollout_buffer, n_rollout_steps):
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        for _ in range(n_rollout_steps):
            with th.no_grad():
                actions, values, logs = self.policy(th.as_tensor(self._last_obs))
            new_obs, rewards, dones, infos = env.step(actions.numpy())
            self.num_timesteps += env.num_envs
            for i, info in enumerate(infos):
                if dones[i] and info.get("TimeLimit.truncated", False):
                    last = th.as_tensor(info["terminal_observation"])[None]
                    with th.no_grad():
                        rewards[i] += self.gamma * float(self.policy.predict_values(last)[0])
            kept = actions.numpy().reshape(-1, 1)
            starts = self._last_episode_starts
            rollout_buffer.add(self._last_obs, kept, rewards, starts, values, logs)
            self._last_obs, self._last_episode_starts = new_obs, dones
        with th.no_grad():
            values = self.policy.predict_values(th.as_tensor(new_obs))
        rollout_buffer.compute_returns_and_advantage(last_values=values, dones=dones)
        return True

    def train(self):
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip = self.clip_range(self._current_progress_remaining)
        for _ in range(self.n_epochs):
            for batch in self.rollout_buffer.get(self.batch_size):
                actions = batch.actions.long().flatten()
                observations = batch.observations
                values, log_prob, entropy = self.policy.evaluate_actions(observations, actions)
                gains = batch.advantages
                gains = (gains - gains.mean()) / (gains.std() + 1e-8)
                ratio = th.exp(log_prob - batch.old_log_prob)
                clipped = th.clamp(ratio, 1 - clip, 1 + clip)
                policy_loss = -th.min(gains * ratio, gains * clipped).mean()
                value_loss = ((batch.returns - values.flatten()) ** 2).mean()
                loss = policy_loss - self.ent_coef * entropy.mean() + self.vf_coef * value_loss
                self.policy.optimizer.zero_grad()
                loss.backward()
                th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
"""

# program: its text, and the function or class that is audited
PROGRAMS = {
    "table": (TABLE, "train"),
    "sarsa": (SARSA, "Sarsa"),
    "script_dqn": (DQN, "train"),
    "script_ppo": (PPO, "train"),
    "sb3_dqn": (SB3_DQN, "MyDQN"),
    "sb3_ppo": (SB3_PPO, "MyPPO"),
}
BEGINS = "if truncated:\n            following, begun = env.reset()[0], True\n        "
# Each row: the program, its fault, what is replaced, and by what. Names of a fault that cannot be
# told apart from outside are joined by "or"; no name: it is only called wrong.
FAULTS = [
    (
        "table",
        "bootstraps-at-terminal",
        "0.0 if terminated else q[following].max()",
        "q[following].max()",
    ),
    ("table", "no-bootstrap-at-truncation", "0.0 if terminated", "0.0 if done"),
    ("table", "bootstrap-mask-inverted", "0.0 if terminated", "0.0 if truncated"),
    (
        "table",
        "reset-observation",
        "        value = 0.0",
        f"        {BEGINS}value = 0.0",
    ),
    (
        "table",
        "own-state-at-truncation",
        "q[following].max()",
        "q[obs if done else following].max()",
    ),
    ("table", "truncation-undiscounted", "gamma * value", "(1 if truncated else gamma) * value"),
    ("table", "discount-twice", "reward + gamma * value", "reward + gamma * gamma * value"),
    ("table", "", "reward + gamma * value", "reward + 0.5 * gamma * value"),
    ("table", "", "reward + gamma * value", "reward - 0.2 + gamma * value"),
    (
        "table",
        "reward-clipped",
        "alpha * (reward",
        "alpha * (np.sign(reward) * min(abs(reward), 1)",
    ),
    ("table", "next-value-is-mean", "q[following].max()", "q[following].mean()"),
    ("table", "next-value-is-smallest", "q[following].max()", "q[following].min()"),
    ("table", "bootstraps-from-own-state", "else q[following].max()", "else q[obs].max()"),
    (
        "table",
        "explores-in-evaluation",
        "return int(q[obs]",
        "return random.randrange(2) if random.random() < 0.1 else int(q[obs]",
    ),
    (
        "table",
        "acts-by-the-worst-value",
        "return int(q[obs].argmax())",
        "return int(q[obs].argmin())",
    ),
    ("table", "not-reproducible", "np.random.default_rng(seed)", "np.random.default_rng()"),
    (
        "table",
        "step-before-terminal-never-learnt",
        "        q += alpha",
        "        q += 0 if terminated else alpha",
    ),
    (
        "sarsa",
        "maximises-instead-of-follows",
        "self.q[next_obs, self.chosen]",
        "self.q[next_obs].max()",
    ),
    ("sarsa", "no-bootstrap-at-truncation", "(not terminated)", "(not (terminated or truncated))"),
    ("sarsa", "bootstraps-at-terminal", " * (not terminated)", ""),
    ("sarsa", "discount-missing", "self.gamma * ahead", "ahead"),
    ("sarsa", "reward-sign-flipped", "target = reward", "target = -reward"),
    (
        "script_dqn",
        "no-bootstrap-at-truncation",
        "following, terminated)):",
        "following, terminated or truncated)):",
    ),
    ("script_dqn", "bootstraps-at-terminal", " * (1 - d)", ""),
    (
        "script_dqn",
        "target-not-detached",
        "with th.no_grad():\n                y = r + gamma * (1 - d) * target",
        "if True:\n                y = r + gamma * (1 - d) * online",
    ),
    (
        "script_dqn",
        "loss-broadcasts-over-the-batch",
        "a.long()[:, None])[:, 0]",
        "a.long()[:, None])",
    ),
    ("script_dqn", "discount-twice", "gamma * (1 - d)", "gamma**2 * (1 - d)"),
    (
        "script_dqn",
        "reset-observation",
        "        for store, item",
        f"        {BEGINS}for store, item",
    ),
    ("script_dqn", "next-value-is-mean", ".max(dim=1).values", ".mean(dim=1)"),
    ("script_dqn", "reward-clipped", "y = r +", "y = r.clamp(-1, 1) +"),
    ("script_ppo", "no-bootstrap-at-truncation", "(1 - ends[t])", "(1 - overs[t])"),
    ("script_ppo", "bootstraps-at-terminal", " * (1 - ends[t])", ""),
    (
        "script_ppo",
        "value-target-is-the-advantage",
        "advantages + np.array(v, np.float32)",
        "advantages",
    ),
    (
        "script_ppo",
        "advantage-sign or ratio-inverted",
        "adv = th.as_tensor(advantages)",
        "adv = -th.as_tensor(advantages)",
    ),
    (
        "script_ppo",
        "loss-broadcasts-over-the-batch",
        "critic(o[at])[:, 0] - returns",
        "critic(o[at]) - returns",
    ),
    ("script_ppo", "discount-missing", "gamma * v2[t]", "v2[t]"),
    (
        "sb3_dqn",
        "no-bootstrap-at-truncation",
        "reward, dones, infos)\n\n",
        "reward, dones, [{}] * len(infos))\n\n",
    ),
    ("sb3_dqn", "reset-observation", 'following[i] = infos[i]["terminal_observation"]', "pass"),
    ("sb3_dqn", "bootstraps-at-terminal", "(1 - batch.dones) * ", ""),
    ("sb3_dqn", "target-always-copied", "self.q_net_target(batch.next", "self.q_net(batch.next"),
    (
        "sb3_dqn",
        "discount-on-reward-too",
        "batch.rewards + (1 - batch.dones) * self.gamma * ahead",
        "self.gamma * (batch.rewards + (1 - batch.dones) * ahead)",
    ),
    (
        "sb3_dqn",
        "trains-the-maximum-not-the-action",
        ".gather(1, batch.actions.long())",
        ".max(dim=1, keepdim=True).values",
    ),
    (
        "sb3_dqn",
        "loss-broadcasts-over-the-batch",
        "smooth_l1_loss(q, target)",
        "smooth_l1_loss(q, target[:, 0])",
    ),
    ("sb3_dqn", "", "self.gamma * ahead", "0.5 * self.gamma * ahead"),
    (
        "sb3_dqn",
        "target-mixed-wrongly",
        "old.mul_(1 - self.tau).add_(self.tau * new)",
        "old.mul_(self.tau).add_((1 - self.tau) * new)",
    ),
    (
        "sb3_dqn",
        "exploration-schedule",
        "schedule(self._current_progress_remaining)",
        "schedule(1 - self._current_progress_remaining)",
    ),
    ("sb3_dqn", "gradient-sign-flipped", "loss = smooth", "loss = -smooth"),
    ("sb3_dqn", "stale-buffer", "full or self.num_timesteps > 0", "full"),
    ("sb3_ppo", "no-bootstrap-at-truncation", "dones[i] and info.get", "False and info.get"),
    (
        "sb3_ppo",
        "reset-observation",
        'th.as_tensor(info["terminal_observation"])[None]',
        "th.as_tensor(new_obs)[i : i + 1]",
    ),
    ("sb3_ppo", "truncation-undiscounted", "rewards[i] += self.gamma * ", "rewards[i] += "),
    (
        "sb3_ppo",
        "bootstraps-at-terminal",
        'if dones[i] and info.get("TimeLimit.truncated", False)',
        "if dones[i]",
    ),
    (
        "sb3_ppo",
        "trace-leaks-into-the-next-episode",
        "self.gae_lambda * goes_on * run",
        "self.gae_lambda * run",
    ),
    ("sb3_ppo", "lambda-missing", "self.gamma * self.gae_lambda * goes_on", "self.gamma * goes_on"),
    ("sb3_ppo", "last-value-missing", "last_values=values", "last_values=0 * values"),
    ("sb3_ppo", "clip-missing", "th.min(gains * ratio, gains * clipped)", "(gains * ratio)"),
    ("sb3_ppo", "ratio-inverted", "log_prob - batch.old_log_prob", "batch.old_log_prob - log_prob"),
    ("sb3_ppo", "entropy-sign", "- self.ent_coef", "+ self.ent_coef"),
    ("sb3_ppo", "advantage-normalised-without-std", " / (gains.std() + 1e-8)", ""),
    (
        "sb3_ppo",
        "value-target-is-the-advantage",
        "(batch.returns - values",
        "(batch.advantages - values",
    ),
    (
        "sb3_ppo",
        "minibatches-or-epochs",
        "                self.policy.optimizer.step()",
        "                self.policy.optimizer.step()\n                break",
    ),
]


def text_of(program: str, old: str = "", new: str = "") -> str:
    """The text of a program with one replacement, which must find its place."""
    text, _ = PROGRAMS[program]
    assert not old or text.count(old) == 1, (program, old)
    return text.replace(old, new) if old else text
