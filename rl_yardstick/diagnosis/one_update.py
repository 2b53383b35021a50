"""Subclasses of the library's DQN, PPO and A2C: one update, compared exactly with each formula's.

With plain gradient descent a loss moves the parameters by a sum of gradients, of values or of
log-probabilities, each times an error. The world's own log gives the errors of each formula.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import numpy as np
import torch as th
from stable_baselines3 import A2C, DQN, PPO

from rl_yardstick.diagnosis.backups import (
    BACKUPS,
    NAMES_OF_RULES,
    RIGHT,
    Found,
    Measured,
    fault_of,
    fitted,
    next_values,
    parts_of,
)
from rl_yardstick.diagnosis.composite_world import GAMMA, N_STATES, Copies, Steps
from rl_yardstick.diagnosis.subjects import ClassSubject, Subject, by_user
from rl_yardstick.mdp.transition_model import Floats

PROGRESS, LAMBDA, ENTROPY, TAU = 0.25, 0.9, 0.1, 0.25
OTHERWISE = "one update moves the parameters otherwise than the right one does"
NORMALISED = "advantages-normalised-over-the-rollout"
DOES_NOT_LEARN = ("does-not-learn", "an update leaves the parameters as they were")


def audit_update(subject: Subject) -> tuple[Measured, Found] | None:
    """The measured target and the first fault, if there is one, of a subclass of DQN, PPO or A2C.

    None for other algorithms, and those that do not take the optimizer of their settings.
    """
    if not (isinstance(subject, ClassSubject) and issubclass(subject.cls, DQN | PPO | A2C)):
        return None
    found = OfDQN(subject) if issubclass(subject.cls, DQN) else OfActor(subject)
    if type(found.model.policy.optimizer) is not th.optim.SGD:
        return None
    return found.measured(), next(found.faults(), ("", ""))


def new_model(subject: ClassSubject, **settings: Any) -> tuple[Any, Copies]:
    """An untrained model with plain gradient descent, and the world with its log."""
    copies = Copies(is_discrete=False)
    given = {**subject.typed, "engine": "library", **settings}
    given |= {"gamma": GAMMA, "seed": 1, "device": "cpu", "max_grad_norm": 1e9}
    given |= {"policy_kwargs": {"net_arch": [32], "optimizer_class": th.optim.SGD}}
    given |= {"learning_rate": lambda progress: progress}
    return by_user(subject.made, copies, given), copies


def parameters_of(module: Any) -> Floats:
    """All parameters in one vector, shape (P,)."""
    found = th.nn.utils.parameters_to_vector(module.parameters()).detach()
    return np.asarray(found.double().numpy())


def set_parameters(module: Any, vector: Floats) -> None:
    """Write a vector of shape (P,) into the parameters."""
    th.nn.utils.vector_to_parameters(th.as_tensor(vector).float(), module.parameters())


def slopes(module: Any, numbers: th.Tensor) -> Floats:
    """The gradients of n numbers by all parameters, shape (n, P)."""
    rows, given = [], [*module.parameters()]
    for number in numbers.flatten():
        parts = th.autograd.grad(number, given, retain_graph=True, materialize_grads=True)
        rows.append(th.cat([part.flatten() for part in parts]).double().numpy())
    return np.array(rows)


def in_evaluation(model: Any, best: Floats) -> Iterator[Found]:
    """Whether it does its best action, (S,), when asked."""
    seen = np.repeat(np.eye(N_STATES, dtype=np.float32), 20, axis=0)
    did, _ = by_user(model.predict, seen, deterministic=True)
    share = float(np.mean(did == np.repeat(best, 20)))
    if share < 1:
        fault = "acts-by-the-worst-value" if share < 0.03 else "explores-in-evaluation"
        yield fault, f"asked for its best action, it does it in {share:.0%}"


# --- DQN ------------------------------------------------------------------------------------------


class OfDQN:
    """The audit of a subclass of DQN: a batch from its memory, and what an update makes of it."""

    def __init__(self, subject: ClassSubject) -> None:
        self.subject, n = subject, 180
        self.is_online = getattr(subject.cls, "target_kind", "") == "online"  # of the DQN of 2013
        settings = {"learning_starts": 10**6, "target_update_interval": 10**9}
        self.model, copies = new_model(subject, buffer_size=130, batch_size=64, **settings)
        by_user(self.model.learn, n)
        th.manual_seed(0)
        eye = th.eye(N_STATES)
        for net in (self.model.q_net, self.model.q_net_target):
            start = parameters_of(net)
            for _ in range(50):  # until it prefers different actions
                set_parameters(net, start + 0.3 * th.randn(start.size).double().numpy())
                if 0.3 < net(eye).argmax(dim=1).double().mean() < 0.7:
                    break
        values = self.model.q_net(eye)
        self.slopes = slopes(self.model.q_net, values)  # (2 S, P)
        self.q = values.detach().double().numpy()
        self.t = self.model.q_net_target(eye).detach().double().numpy()
        # the next value of each state, (S,), by the rules of DQN, double DQN and without a target
        self.largest, self.online = self.t.max(axis=1), self.q.max(axis=1)
        self.double = self.t[np.arange(N_STATES), self.q.argmax(axis=1)]
        buffer = self.model.replay_buffer
        with patch.object(buffer, "_get_samples", wraps=buffer._get_samples) as asked:
            self.batch = by_user(buffer.sample, 64)
        places = asked.call_args.args[0]
        log, newer = Steps(copies.logs[0]), np.where(places < n - 130, places + 130, places)
        self.steps, self.oldest = log.take(newer), log.take(places)
        self.cells = self.steps.cells(self.q.size)

    def _moved(self, batch: Any) -> Floats:
        """By how much one update moves the parameters, times the steps in it."""
        net, start = self.model.q_net, parameters_of(self.model.q_net)
        self.model._current_progress_remaining = PROGRESS
        with patch.object(self.model.replay_buffer, "sample", return_value=batch):
            by_user(self.model.train, 1, 64)
        moved = parameters_of(net) - start
        set_parameters(net, start)
        return moved * 64 / PROGRESS

    def measured(self) -> Measured:
        """The target's coefficients, from the errors in cells that explain an update."""
        moved = self._moved(self.batch._replace(rewards=self.batch.rewards / 10))
        used, counts = np.unique(self.cells, return_counts=True)
        errors, *_ = np.linalg.lstsq(self.slopes[used].T, moved, rcond=None)
        per_step = np.zeros(self.q.size)
        per_step[used] = errors / counts
        told, steps = per_step[self.cells], self.steps
        is_clear = (np.abs(told) < 0.98) & (steps.state != 15)  # not clipped, one next state
        own, found = self.q.ravel()[self.cells], []
        for values in (self.largest, self.double, self.online):
            reward, *rest = parts_of(steps, values[steps.shown])
            found.append(fitted(told, [reward / 10, *rest], 50.0 * is_clear, own))
        return min(found, key=lambda each: each.misfit)

    def faults(self) -> Iterator[Found]:
        """Yield the faults, the first of which explains the others."""
        moved = self._moved(self.batch)
        size, hits, scaled = np.linalg.norm(moved), [], []
        if size < 1e-9:
            yield DOES_NOT_LEARN
        for name, direction in self._directions():
            length = max(float(np.linalg.norm(direction)), 1e-9)
            if abs(moved @ direction) < (1 - 1e-5) * size * length:
                continue
            ratio = float(np.sign(moved @ direction) * size / length)
            if min(abs(ratio - 1), abs(ratio - 2) if "mse" in name else 1) < 2e-3:
                hits.append(fault_of(name))
            else:
                scaled.append("gradient-sign-flipped" if ratio < 0 else "step-size-wrong")
        if RIGHT not in (names := hits or scaled):
            yield " or ".join(dict.fromkeys(names)), OTHERWISE
        yield from self._copied()
        yield from in_evaluation(self.model, self.q.argmax(axis=1))
        yield from self._explored()

    def _targets(self) -> dict[str, Floats]:
        d, q, t, right = self.steps, self.q, self.t, BACKUPS[RIGHT]
        found = {}
        for name, formula in BACKUPS.items():
            found[name] = formula(d, self.largest.take)
            found[f"{name} (double)"] = formula(d, self.double.take)
        online = f"{RIGHT} (online)" if self.is_online else "target-always-copied"
        found[online] = right(d, self.online.take)
        found["next-value-is-best-in-own-state (double)"] = right(
            d, lambda s: t[s, q[d.state].argmax(axis=1)]
        )
        found["double-roles-swapped"] = right(d, lambda s: q[s, t[s].argmax(axis=1)])
        for rule in NAMES_OF_RULES.keys() - {"largest", "next", "expected"}:
            found[NAMES_OF_RULES[rule]] = right(d, next_values(t, d, rule))
        scaled = (d.reward - d.reward.mean()) / d.reward.std(ddof=1)
        found["rewards-normalised"] = found[RIGHT] - d.reward + scaled
        return found

    def _directions(self) -> Iterator[tuple[str, Floats]]:
        """The move of the parameters by each formula and loss."""
        d, q, targets = self.steps, self.q, self._targets()
        cell, one, largest = d.state * 2, np.eye(q.size), q.argmax(axis=1)
        did = one[self.cells]
        trained = {
            "trains-the-maximum-not-the-action": one[cell + largest[d.state]],
            "gather-of-action-0": one[cell],
            "gather-of-action-1": one[cell + 1],
            "gather-of-the-other-action": one[cell + 1 - d.action],
            "action-of-another-step": one[cell + d.action_before],
            "action-of-another-step (after)": one[cell + d.next_action],
            "trains-the-mean-of-actions": (one[cell] + one[cell + 1]) / 2,
        }
        # the name of each, the errors of the steps, and the cells that they move, shape (n, 2 S)
        rows = []
        for name, target in targets.items():
            places = {name: did} | (trained if fault_of(name) == RIGHT else {})
            rows += [(fault, target - cells @ q.ravel(), cells) for fault, cells in places.items()]
        own = q.ravel()[self.cells]
        rows.append(("loss-broadcasts-over-the-batch", targets[RIGHT][:, None] - own, did))
        online = BACKUPS[RIGHT](d, self.online.take)
        ahead = GAMMA * d.goes_on[:, None] * one[d.shown * 2 + largest[d.shown]]
        rows.append(("target-not-detached", online - own, did - ahead))
        for loss, most in (("huber", 1.0), ("mse", np.inf)):
            for name, errors, cells in rows:
                mean = np.atleast_2d(np.clip(errors, -most, most)).mean(axis=0)
                yield f"{name} ({loss})", mean @ cells @ self.slopes
        old, old_cells = self.oldest, self.oldest.cells(q.size)
        errors = BACKUPS[RIGHT](old, self.largest.take) - q.ravel()[old_cells]
        yield "stale-buffer", np.clip(errors, -1, 1) @ self.slopes[old_cells]
        yield f"{RIGHT} (absolute)", np.sign(targets[RIGHT] - own) @ did @ self.slopes

    def _copied(self) -> Iterator[Found]:
        """Whether the target network is copied when it should be, and mixed as it should be."""
        if self.is_online:
            return
        model, _ = new_model(self.subject, target_update_interval=1, tau=TAU, learning_starts=10)
        by_user(model.learn, 5)  # nothing is learnt yet: the networks are the same
        before = parameters_of(model.q_net_target)
        set_parameters(model.q_net, before + 1)
        by_user(model._on_step)
        moved = parameters_of(model.q_net_target) - before
        low, high = float(moved.min()), float(moved.max())
        is_turned = abs(low - (1 - TAU)) < 1e-3  # others may mix by a rate of their own
        if is_turned or low < -1e-3 or high > 1.001 or high - low > 1e-3:
            told = f"the target network moves by {low:.3g} to {high:.3g}, tau is {TAU}"
            yield "target-mixed-wrongly", told
        right = range(3, 5)  # copies of a network that learns from the 11th step on, in 45 steps
        for interval, wanted in ((10, right), (10**9, range(1))):
            copies, others = self._changes_of_target(interval)
            if others:
                return  # it mixes them by a rule of its own
            if copies not in wanted:
                name = "target-always-copied" if copies >= wanted.stop else "target-never-copied"
                told = f"the target network is copied {copies} times in 45 steps"
                yield name, f"{told} where target_update_interval is {interval}"

    def _changes_of_target(self, interval: int) -> tuple[int, int]:
        """How often the target network becomes the other network in 45 steps, and changes else."""
        given = {"learning_starts": 10, "buffer_size": 200, "train_freq": 1, "tau": 1.0}
        model, _ = new_model(self.subject, target_update_interval=interval, **given)
        seen = list[tuple[Floats, Floats]]()

        def note(*_: Any) -> bool:
            seen.append((parameters_of(model.q_net), parameters_of(model.q_net_target)))
            return True

        by_user(model.learn, 45, callback=note)
        changes = [(old, new) for old, new in pairwise(seen) if (old[1] != new[1]).any()]
        n_copies = sum(
            any((new[1] == net).all() for net in (old[0], new[0])) for old, new in changes
        )
        return n_copies, len(changes) - n_copies

    def _explored(self) -> Iterator[Found]:
        falls = {"exploration_initial_eps": 0.9, "exploration_final_eps": 0.1}
        falls |= {"exploration_fraction": 0.5, "learning_starts": 10**6}
        model, _ = new_model(self.subject, **falls)
        by_user(model.learn, 10)
        rate = model.exploration_rate
        if abs(rate - 0.1) > 1e-3:
            yield "exploration-schedule", f"exploration ends at {rate:.2f}; right would be 0.10"


# --- PPO and A2C ----------------------------------------------------------------------------------


class OfActor:
    """The audit of a subclass of PPO or A2C: its rollout, and what an update makes of it."""

    def __init__(self, subject: ClassSubject) -> None:
        self.subject, n = subject, 94  # the last step is inside an episode
        self.is_ppo, self.n = issubclass(subject.cls, PPO), n
        settings = {"n_steps": n, "batch_size": n, "n_epochs": 1, "gae_lambda": LAMBDA}
        settings |= {"ent_coef": ENTROPY, "vf_coef": 0.5, "use_rms_prop": False}
        self.model, copies = new_model(subject, **settings)
        self.policy = self.model.policy
        self.decay = float(self.model.gae_lambda)  # it may set another
        with th.no_grad():
            for each in self.policy.parameters():
                each.add_(0.3 * th.randn_like(each))
        with patch.object(self.model, "train"):
            by_user(self.model.learn, n)
        self.steps = d = Steps(copies.logs[0][:n])
        d.next_state[-1] = d.shown[-1]
        buffer = self.model.rollout_buffer
        self.advantages = buffer.advantages[:, 0].astype(float)
        self.returns = buffer.returns[:, 0].astype(float)
        with th.no_grad():
            told = self.policy.predict_values(th.eye(N_STATES))[:, 0]
        self.v: Floats = np.asarray(told.double().numpy())

    def measured(self) -> Measured:
        """The target's coefficients, from the advantages."""
        d, after = self.steps, np.append(self.advantages[1:], 0.0)
        told = self.advantages - GAMMA * self.decay * (1 - d.over) * after + self.v[d.state]
        return fitted(told, parts_of(d, self.v[d.shown]), np.full(self.n, 50.0))

    def faults(self) -> Iterator[Found]:
        """Yield the faults, the first of which explains the others."""
        table = self._advantages()
        names = [fault_of(name) for name, each in table.items() if self._is_near(each)]
        if RIGHT not in names:
            off = int((~np.isclose(self.advantages, table[RIGHT], atol=1e-4)).sum())
            told = f"stored advantages differ in {off} of {self.n} steps"
            if names == [NORMALISED] and self._is_near(self.returns - self.v[self.steps.state]):
                names, told = ["values-learn-normalised-advantages"], f"{told}, and returns too"
            yield " or ".join(dict.fromkeys(names)), told
        self.of_all_steps = table["lambda-missing"]
        yield from self._updated()
        if self.is_ppo:
            yield from self._minibatches()
        with th.no_grad():
            best = self.policy.get_distribution(th.eye(N_STATES)).mode().numpy()
        yield from in_evaluation(self.model, best)

    def _is_near(self, advantages: Floats) -> bool:
        return np.allclose(self.advantages, advantages, atol=1e-4)

    def _advantages(self) -> dict[str, Floats]:
        """The advantages of a rollout, by each formula of targets and of traces."""
        d, found = self.steps, dict[str, Floats]()
        on, fade, v = 1 - d.over, GAMMA * self.decay, next_values(self.v[:, None], d, "")
        keeps = {
            RIGHT: fade * on,
            "trace-leaks-into-the-next-episode": fade * (on + d.over),
            "trace-leaks-at-truncation": fade * d.goes_on,
            "done-flag-off-by-one": fade * (1 - d.is_first),
            "lambda-missing": GAMMA * on,
            "lambda-zero": 0 * on,
            "discount-missing-in-the-trace": self.decay * on,
            "discount-twice-in-the-trace": GAMMA * fade * on,
            "lambda-twice": self.decay * fade * on,
        }
        targets = {name: formula(d, v) for name, formula in BACKUPS.items()}
        targets["last-value-missing"] = targets[RIGHT].copy()
        targets["last-value-missing"][-1] = d.reward[-1]
        for kept, keep in keeps.items():
            for name, target in targets.items():
                errors, total = target - self.v[d.state], np.zeros(self.n + 1)
                for k in reversed(range(self.n)):
                    total[k] = errors[k] + keep[k] * total[k + 1]
                found[kept if name == RIGHT else f"{name} ({kept})"] = total[:-1]
        right = found[RIGHT]
        found["advantage-sign"] = -right
        found[NORMALISED] = (right - right.mean()) / right.std()
        return found

    def _weights(self, ratio: Floats, a: Floats) -> dict[str, Floats]:
        """The weight of each log-probability's gradient, by each form of the policy's loss."""
        if not self.is_ppo:
            return {RIGHT: a, "advantage-missing": 0 * a + 1}
        low, high, turned = ratio < 0.8, ratio > 1.2, 1 / ratio
        is_best = (a > 0) & high | (a < 0) & low
        return {
            RIGHT: a * ratio * ~is_best,
            "clip-missing": a * ratio,
            "clip-on-the-wrong-side": a * ratio * ~((a > 0) & low | (a < 0) & high),
            "clip-without-minimum": a * ratio * ~(low | high),
            "clip-above-only": a * ratio * ~((a > 0) & high),
            "ratio-inverted": -a * turned * ~((a > 0) & (turned > 1.2) | (a < 0) & (turned < 0.8)),
            "ratio-missing": a,
            "advantage-missing": ratio,
        }

    def _updated(self) -> Iterator[Found]:
        d, n, policy, a = self.steps, self.n, self.policy, self.advantages
        noise = np.tile([0.4, -0.1, -0.4, 0.1, 0.3, -0.3], n)[:n]
        self.model.rollout_buffer.log_probs[:, 0] += noise  # else no ratio differs from 1
        seen = th.eye(N_STATES)[d.state], th.as_tensor(d.action)
        values, logs, entropies = policy.evaluate_actions(*seen)
        gains, of_values = slopes(policy, logs) / n, slopes(policy, values) / n
        of_entropy, before = ENTROPY * slopes(policy, entropies.mean())[0], parameters_of(policy)
        self.model._current_progress_remaining = PROGRESS
        by_user(self.model.train)
        moved = (parameters_of(policy) - before) / PROGRESS
        if (size := np.linalg.norm(moved)) < 1e-9:
            yield DOES_NOT_LEARN
        own, scaled = self.v[d.state], (a - a.mean()) / (a.std(ddof=1) + 1e-8)
        returns = a + own
        critics = {
            RIGHT: a,
            f"{RIGHT} (of all steps)": self.of_all_steps,
            f"{RIGHT} (huber)": np.clip(a, -1, 1),
            "loss-broadcasts-over-the-batch": returns.mean() - own,
            "value-target-is-the-advantage": a - own,
            "returns-subtract-the-value": a - 2 * own,
            "returns-normalised": (returns - returns.mean()) / (returns.std() + 1e-8) - own,
        }
        forms = {RIGHT: scaled if self.is_ppo else a}
        forms["advantage-normalisation"] = a if self.is_ppo else scaled
        found = []
        for form, advantages in forms.items():
            for name, weights in self._weights(np.exp(-noise), advantages).items():
                for critic, error in critics.items():
                    matrix = np.array([weights @ gains, of_entropy, error @ of_values]).T
                    sizes, *_ = np.linalg.lstsq(matrix, moved, rcond=None)
                    if np.linalg.norm(matrix @ sizes - moved) < 2e-3 * size:
                        names = [each for each in (name, form, fault_of(critic)) if each != RIGHT]
                        found.append((len(names), " and ".join(names), sizes))
        if not found:
            yield "", OTHERWISE
            return
        _, name, sizes = min(found, key=lambda each: each[0])
        yield from self._sized(name, sizes)

    def _sized(self, name: str, sizes: Floats) -> Iterator[Found]:
        """The fault of an update whose parts have these step sizes; 1 would be right."""
        policy, entropy, value = sizes
        told = f"steps of policy, entropy, values: {policy:.2f}, {entropy:.2f}, {value:.2f} times"
        spread = self.advantages.std(ddof=1)
        checks = {
            name: bool(name),
            "gradient-sign-flipped": max(sizes) < 0,
            "policy-never-learns": abs(policy) < 1e-3,
            "advantage-sign": policy < 0,
            "value-loss-missing": abs(value) < 1e-3,
            "entropy-missing": abs(entropy) < 1e-3,
            "entropy-sign": entropy < 0,
            "advantage-normalised-without-std": abs(policy / spread / entropy - 1) < 0.02,
            "entropy-weight": abs(entropy / policy - 1) > 0.02,
            "step-size-wrong": abs(policy - 1) > 0.01 or not 0.4 < value < 2.1,
        }
        yield from ((fault, told) for fault, is_there in checks.items() if is_there)

    def _minibatches(self) -> Iterator[Found]:
        model, _ = new_model(self.subject, n_steps=96, batch_size=32, n_epochs=3)
        policy = model.policy
        with patch.object(policy, "evaluate_actions", wraps=policy.evaluate_actions) as asked:
            by_user(model.learn, 96)
        batches = [call.args for call in asked.call_args_list]
        n_different = len({b"".join(each.numpy().tobytes() for each in one) for one in batches})
        n = len(batches)
        if (n_different, n) != (9, 9):
            told = f"{n_different} different minibatches in {n} updates; right would be 9"
            yield "minibatches-reused" if n == 9 else "minibatches-or-epochs", told
