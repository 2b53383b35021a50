"""Probes of all but targets: what an agent does, its schedules, seeds and saved files.

A probe returns None where it does not apply.
"""

from __future__ import annotations

import tempfile
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from rl_yardstick.diagnosis.faults import UNEXPLAINED, Finding, checked
from rl_yardstick.diagnosis.probe_worlds import ARM_0, CHAIN, SAFE_FORK, World
from rl_yardstick.diagnosis.subjects import ClassSubject, Lab, Subject, Trained
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.errors import one_line


def probe_choice(lab: Lab) -> Finding:
    """The agent learns the action that pays, and always takes it in evaluation."""
    trained = [lab.begin(world) for world in (ARM_0, World(((0, 1),)))]
    chosen = [float(np.mean([each.act(0) for _ in range(400)])) for each in trained]
    text = (
        f"it does action 1 in {chosen[0]:.1%} of 400 where 0 pays, in {chosen[1]:.1%} where 1 does"
    )
    right = "0 % and 100 %"
    if chosen == [0, 1]:
        return Finding("ok", text)
    if chosen[0] > 0.6 and chosen[1] < 0.4:  # the reverse of what pays
        if lab.subject.target in ("states", None):
            return Finding("fault", text, "advantage-sign", right)
        return Finding("unsaid", f"{text}: {UNEXPLAINED}")
    if all(0 < share < 1 for share in chosen) or (chosen[0] < 0.4 and chosen[1] > 0.6):
        return Finding("fault", text, "explores-in-evaluation", right)
    return Finding("unsaid", text)


def probe_entropy(lab: Lab) -> Finding | None:
    """Without rewards, the entropy term keeps the policy random."""
    if not (lab.subject.accepts("ent_coef") and isinstance(lab.subject, ClassSubject)):
        return None
    spreads = []
    for weight in (1e-3, 0.5):
        trained = lab.begin(World(((0, 0),)), ent_coef=weight)
        spreads.append(float(trained.drawn_actions(0, 1000).std()))
    low, high = spreads
    text = f"actions vary by {low:.2f} with a weight of 0.001, and by {high:.2f} with 0.5"
    return checked(high < min(0.3, low), text, "entropy-sign", "about 0.5 in both")


# --- schedules ------------------------------------------------------------------------------------


def _learning_rate(subject: Subject) -> float | None:
    """A constant learning rate that a schedule can replace; None without one."""
    rate = {**subject.base, **subject.typed}.get("learning_rate", 0.1)
    has_rate = subject.accepts("learning_rate") and isinstance(rate, float)
    has_rate &= not hasattr(getattr(subject, "cls", None), "plain")  # a number alone
    return rate if has_rate and not subject.uses_ratio else None


def probe_schedules(lab: Lab) -> Finding | None:
    """A falling learning rate does fall in the course of training, and a rising one does rise."""
    subject = lab.subject
    if not isinstance(subject, ClassSubject):
        return None
    if subject.accepts("value_step_size"):
        return Finding("skipped", "values have a step size of their own, which has no schedule")
    rate = _learning_rate(subject)
    if rate is None:
        return None
    from stable_baselines3.common.utils import LinearSchedule

    rate /= 10 if subject.is_on_policy else 1  # or each rollout is overfitted
    falling = _moves(lab, subject, LinearSchedule(rate, rate / 20, 1.0))
    rising = _moves(lab, subject, LinearSchedule(rate / 20, rate, 1.0))
    if falling is None or rising is None:
        return Finding("unsaid", "values do not move with random rewards")
    early, late = np.array(falling) / np.array(rising)
    text = (
        f"values move {early:.2f} times as much where it falls to a twentieth as where it "
        f"rises from there, early in training, and {late:.2f} times late"
    )
    fault = "schedule-backwards" if early < 0.8 else "schedule-constant"
    return checked(not late < 0.6, text, fault, "more than once, and less than once")


def _moves(lab: Lab, subject: ClassSubject, schedule: Any) -> tuple[float, float] | None:
    """How much values move from one reading to the next, early in a training and late."""
    from stable_baselines3.common.callbacks import BaseCallback

    trained = Trained(subject, World(((0, 0),), noise=1.0), lab.seed, {"learning_rate": schedule})
    rollout = int({**subject.base, **subject.typed}.get("n_steps", 1))
    every = max(20, rollout) if subject.is_on_policy else 20
    readings: list[Floats] = []

    class Reader(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls % every == 0 and (values := trained.values()) is not None:
                readings.append(values)
            return True

    trained.train(max(2 * subject.steps, 24 * every), Reader())
    if len(readings) < 16:
        return None
    moves = np.abs(np.diff(np.array(readings), axis=0)).mean(axis=(1, 2))
    n = len(moves)
    early, late = moves[: n // 6].mean(), moves[-n // 4 :].mean()
    return (float(early), float(late)) if min(early, late) > 1e-9 else None


def probe_exploration(lab: Lab) -> Finding | None:
    """Exploration that falls in the course of training does fall."""
    subject = lab.subject
    is_set = subject.accepts("exploration_initial_eps") and subject.accepts("exploration_final_eps")
    if isinstance(subject, ClassSubject) and not is_set:
        return None
    if isinstance(subject, ClassSubject) and subject.typed.get("engine") == "compiled":
        return Finding("skipped", "compiled training does not record actions")
    changes: dict[str, Any] = dict(subject.stepwise)
    if is_set:
        changes |= {"exploration_initial_eps": 1.0, "exploration_final_eps": 0.0}
        changes |= {"exploration_fraction": 0.5}
    changes |= {"learning_starts": 10}
    trained = lab.begin(World(((1, 0),), noise=1e-9), 2 * subject.steps, **changes)
    is_other = np.array(trained.record.actions) != trained.act(0)
    n = len(is_other)  # without the first steps, before anything is learnt
    early, late = float(is_other[n // 8 : n // 4].mean()), float(is_other[-n // 4 :].mean())
    text = f"the best action is not taken in {early:.1%} of the first steps, {late:.1%} of the last"
    if late > early + 0.1:
        return Finding("fault", text, "schedule-backwards", "less at the end")
    if is_set and late > 0.15:
        return Finding("fault", text, "schedule-constant", "0 % at the end")
    return Finding("unsaid" if is_set and early < 0.15 else "ok", text)


# --- seeds and files ------------------------------------------------------------------------------


def probe_seeds(lab: Lab) -> Finding:
    """The same seed gives the same training, whatever the state of the global generators."""
    from stable_baselines3.common.utils import set_random_seed

    results, agents = [], []
    steps = 130 if lab.subject.is_on_policy else 300
    half = {"exploration_initial_eps": 0.5, "exploration_final_eps": 0.5}
    for state in (1, 1, 2):
        set_random_seed(state)
        trained = lab.begin(SAFE_FORK, steps, **half)
        agents.append(trained)
        values = trained.values()
        found = [trained.act(state) for state in range(SAFE_FORK.n_states)]
        found += [] if values is None else [*values.ravel()]
        results.append((trained.record.actions, found))
    first, again, other = results
    differ = "two trainings with the same seed differ"
    if first != again:
        if both := _held_by_both(*agents[:2]):
            text = f"two agents have the same {both}, and {differ}"
            return Finding("fault", text, "shared-buffer", "one for each")
        text = f"{differ}, in the same state of the global generators"
        return Finding("fault", text, "not-reproducible", "none")
    if first != other:
        text = f"{differ} if NumPy's, Python's and PyTorch's global generators do"
        return Finding("fault", text, "global-generator", "none")
    return Finding("ok", "three trainings with the same seed are the same")


def _held_by_both(one: Trained, other: Trained) -> str:
    """The name of a mutable attribute that two models share; empty if there is none."""
    import torch as th
    from stable_baselines3.common.buffers import BaseBuffer

    kinds = (BaseBuffer, np.ndarray, th.Tensor, th.nn.Module, list, dict, deque)
    mine, theirs = (vars(each.model) for each in (one, other))
    held = (name for name, value in mine.items() if isinstance(value, kinds))
    return next((name for name in held if mine[name] is theirs.get(name)), "")


def probe_files(lab: Lab) -> Finding | None:
    """A loaded model equals the saved one."""
    subject = lab.subject
    if not isinstance(subject, ClassSubject):
        return None
    from stable_baselines3.common.utils import LinearSchedule

    changes: dict[str, Any] = {"exploration_initial_eps": 0.9, "exploration_final_eps": 0.1}
    if (rate := _learning_rate(subject)) is not None:
        changes["learning_rate"] = LinearSchedule(rate, rate / 20, 1.0)
    trained = lab.begin(CHAIN, 300, **changes)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "model.zip")
        try:
            trained.model.save(path)
            loaded = subject.cls.load(path, device="cpu")
        except Exception as error:  # noqa: BLE001 (user code may raise anything)
            text = f"it cannot be saved and loaded: {type(error).__name__}: {one_line(error)}"
            return Finding("unsaid", text)
    lost = _lost(trained, loaded)
    if lost:  # what it forgets first explains most
        return Finding("fault", "; ".join(lost.values()), next(iter(lost)), "the same")
    return Finding("ok", "values, optimizers and schedules are the same after loading")


def _lost(trained: Trained, loaded: Any) -> dict[str, str]:
    """What a loaded model has lost, by fault."""
    lost, model, before = {}, trained.model, trained.values()
    trained.model = loaded
    after = trained.values()
    is_same = before is None or (after is not None and bool(np.allclose(before, after)))
    if not (is_same and _same(model.policy.state_dict(), loaded.policy.state_dict())):
        told = [[] if each is None else np.round(each, 2).tolist() for each in (before, after)]
        lost["zip-forgets-tables"] = f"values {told[0]} are {told[1]} after loading"
    there, now = _optimizers(model), _optimizers(loaded)
    for place, optimizer in there.items():
        if place not in now or not _same(optimizer.state_dict(), now[place].state_dict()):
            n = len(optimizer.state_dict()["state"])
            lost["zip-forgets-optimizer"] = f"{place}: the state of {n} parameters is not the same"
    pairs: dict[str, list[Any]] = {}
    for key in ("lr_schedule", "exploration_schedule", "clip_range"):
        found = [getattr(each, key, None) for each in (model, loaded)]
        if callable(found[0]):
            pairs[key] = [[s(1.0), s(0.5)] if callable(s) else s for s in found]
    for key in ("num_timesteps", "_current_progress_remaining", "exploration_rate"):
        pairs[key] = [getattr(each, key, None) for each in (model, loaded)]
    for key, (was, is_now) in pairs.items():
        if was != is_now:
            lost["zip-forgets-schedules"] = f"{key} was {was}, after loading {is_now}"
    return lost


def _optimizers(model: Any) -> dict[str, Any]:
    """All optimizers of a model, by the path of their attribute."""
    from torch.optim import Optimizer

    holders = {"": model, "policy": model.policy}
    holders |= {key: each for key, each in vars(model).items() if hasattr(each, "optimizer")}
    inside = getattr(model.policy, "_modules", {}).items()
    holders |= {f"policy.{key}": each for key, each in inside if hasattr(each, "optimizer")}
    return {
        f"{place}.{key}".strip("."): value
        for place, holder in holders.items()
        for key, value in vars(holder).items()
        if isinstance(value, Optimizer)
    }


def _same(one: Any, other: Any) -> bool:
    """Whether nested dictionaries and lists of tensors and numbers are equal."""
    import torch as th

    try:
        th.testing.assert_close(one, other, rtol=0, atol=0)
    except AssertionError:
        return False
    return True
