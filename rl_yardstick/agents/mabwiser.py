"""MABWiser's bandits with the interface of our own, for comparison (extra ``bandits``)."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from rl_yardstick.agents.bandits.algorithm import BINARY, BanditAlgorithm, Pull
from rl_yardstick.agents.bandits.linear import features
from rl_yardstick.agents.common.model_files import TablePolicy
from rl_yardstick.agents.common.settings import NOT_NEGATIVE, SHARE, check_space, check_vectors
from rl_yardstick.mdp.transition_model import Floats, Ints


class Kind(NamedTuple):
    """One of MABWiser's learning policies."""

    settings: dict[str, str]  # its arguments, and the attributes of our agent that they come from
    statistics: tuple[str, ...]  # where it keeps its state; nothing for the models of LinUCB


SUMS = ("arm_to_sum", "arm_to_count", "arm_to_expectation")
KINDS = {
    "EpsilonGreedy": Kind({"epsilon": "exploration_initial_eps"}, SUMS),
    "UCB1": Kind({"alpha": "c"}, (*SUMS, "arm_to_mean")),
    "ThompsonSampling": Kind({}, ("arm_to_success_count", "arm_to_fail_count")),
    # With another ridge than 1, the library is wrong about untried arms.
    "LinUCB": Kind({"alpha": "alpha"}, ()),
}


class MABWiserPolicy(TablePolicy):
    """Holds a `mabwiser.mab.MAB` over arms numbered from 0, and saves its objects as one tensor."""

    def __init__(self, *args: Any, kind: str, settings: dict[str, float], **kwargs: Any) -> None:
        from mabwiser.mab import MAB, LearningPolicy

        super().__init__(*args, **kwargs)
        self.kind, self.settings = kind, settings
        self.statistics = KINDS[kind].statistics
        arms = range(int(self.action_space.n))  # type: ignore[attr-defined]
        self.mab: Any = MAB(list(arms), getattr(LearningPolicy, kind)(**self.settings))
        self.fitted = False

    def _sizes(self) -> dict[str, Any]:
        return {"kind": self.kind, "settings": self.settings}

    @property
    def parts(self) -> Floats:
        """The state: a row of numbers for each arm, shape (arms, ...)."""
        inside, arms = self.mab._imp, self.mab.arms
        if self.statistics:
            rows = [[getattr(inside, name)[arm] for name in self.statistics] for arm in arms]
            return np.array(rows, dtype=np.float64)
        models = [inside.arm_to_model[arm] for arm in arms]
        return np.stack([np.concatenate([m.A, m.A_inv, m.Xty, m.beta], None) for m in models])

    def learn(self, arm: int, reward: float, context: Floats) -> None:
        """Let the library learn from one reward in ``context``, of shape (features,)."""
        learn = self.mab.partial_fit if self.fitted else self.mab.fit
        learn([arm], [reward], *(() if self.statistics else (context[None],)))
        self.fitted = True

    def judged(self, contexts: Floats) -> Floats:
        """The estimated mean reward of each arm, shape (n, arms)."""
        if not self.fitted:
            return np.zeros((len(contexts), len(self.mab.arms)))
        if not self.statistics:
            models = self.mab._imp.arm_to_model
            return np.stack([contexts @ models[arm].beta for arm in self.mab.arms], axis=1)
        won, seen = self.parts[:, 0], self.parts[:, 1]
        if self.kind == "ThompsonSampling":
            seen = won + seen
        means = np.divide(won, seen, out=np.full(len(won), -np.inf), where=seen > 0)
        return np.tile(means, (len(contexts), 1))

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        """The first of the best arms, shape (n,), for observations of shape (n,) or (n, d)."""
        contexts = features(self.observation_space, observation.numpy())
        return th.from_numpy(self.judged(contexts).argmax(axis=1))

    def get_extra_state(self) -> th.Tensor:
        """The state as a tensor, empty before the first reward."""
        return th.from_numpy(self.parts) if self.fitted else th.zeros(0, dtype=th.float64)

    def set_extra_state(self, state: th.Tensor) -> None:
        """Copy the state of another policy of this kind."""
        if len(state) == 0:
            return
        if len(state) != len(self.mab.arms):
            raise ValueError(f"holds {len(state)} arms, not {len(self.mab.arms)}")
        shown = np.zeros((1, *(self.observation_space.shape or ())))
        context, inside = features(self.observation_space, shown)[0], self.mab._imp
        self.learn(0, 0.0, 0.0 * context)  # makes the library's objects
        n = len(context)
        for arm, row in enumerate(state.numpy()):
            for name, value in zip(self.statistics, row.tolist(), strict=bool(self.statistics)):
                getattr(inside, name)[arm] = value
            if not self.statistics:
                model, ends = inside.arm_to_model[arm], np.cumsum([n * n, n * n, n])
                a, a_inv, model.Xty, model.beta = np.split(row.copy(), ends)
                model.A, model.A_inv = a.reshape(n, n), a_inv.reshape(n, n)
        if self.statistics:
            inside.total_count = float(state[:, 1].sum())


class MABWiserAgent(BanditAlgorithm):
    """The base of the agents that learn and choose by MABWiser, which takes the first of ties."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MABWiserPolicy": MABWiserPolicy}
    policy: MABWiserPolicy
    kind: ClassVar[str]  # one of `KINDS`

    hidden_arguments = ("learning_rate", "mask_actions", "tie_breaking")

    def __init__(
        self, policy: str | type[BasePolicy] = "MABWiserPolicy", *args: Any, **kwargs: Any
    ) -> None:
        super().__init__(policy, *args, tie_breaking="first", **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        if KINDS[self.kind].statistics:
            check_space(self, "observations", self.observation_space)
        else:
            check_vectors(self, self.observation_space)

    def _policy_arguments(self) -> dict[str, Any]:
        settings = {name: getattr(self, ours) for name, ours in KINDS[self.kind].settings.items()}
        return {"kind": self.kind, "settings": settings}

    def _contexts(self, obs: NDArray[Any]) -> Floats:
        return features(self.observation_space, obs)

    def _choose(  # type: ignore[override]  # the library knows no masks
        self, contexts: Floats, rng: np.random.Generator
    ) -> tuple[Ints, Floats]:
        # The library needs a reward first, and would take an untried arm's mean reward for 0.
        mab, first = self.policy.mab, None if self.policy.fitted else 0
        if self.kind == "UCB1":
            counts = mab._imp.arm_to_count
            first = next((arm for arm in mab.arms if counts[arm] == 0), None)
        mab._rng.rng = rng
        told = [() if self.policy.statistics else (context[None],) for context in contexts]
        arms = [int(mab.predict(*each)) if first is None else first for each in told]
        return np.array(arms, dtype=np.int64), np.ones(len(arms))

    def _learn(self, pull: Pull) -> None:
        self.policy.learn(pull.arm, pull.reward, np.array(pull.context))


class MABWiserEpsilonGreedy(MABWiserAgent):
    """MABWiser's epsilon-greedy on sample averages, with a constant epsilon; ignores contexts."""

    kind = "EpsilonGreedy"
    ranges = {"exploration_initial_eps": SHARE}  # noqa: RUF012

    def __init__(self, *args: Any, exploration_initial_eps: float = 0.1, **kwargs: Any) -> None:
        self.exploration_initial_eps = exploration_initial_eps
        super().__init__(*args, **kwargs)


class MABWiserUCB1(MABWiserAgent):
    """MABWiser's UCB1, with a degree of exploration ``c``, its alpha; ignores contexts."""

    kind = "UCB1"
    ranges = {"c": NOT_NEGATIVE}  # noqa: RUF012

    def __init__(self, *args: Any, c: float = 1.0, **kwargs: Any) -> None:
        self.c = c
        super().__init__(*args, **kwargs)


class MABWiserThompson(MABWiserAgent):
    """MABWiser's Thompson sampling with Beta(1, 1) priors; ignores contexts."""

    kind = "ThompsonSampling"
    rewards_known = BINARY  # other rewards would silently make its Beta distributions wrong


class MABWiserLinUCB(MABWiserAgent):
    """MABWiser's LinUCB, with ``alpha`` standard deviations and a ridge of 1."""

    kind = "LinUCB"
    ranges = {"alpha": NOT_NEGATIVE}  # noqa: RUF012

    def __init__(self, *args: Any, alpha: float = 1.0, **kwargs: Any) -> None:
        self.alpha = alpha
        super().__init__(*args, **kwargs)
