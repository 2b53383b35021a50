"""MABWiser's bandits with the interface of our own, for comparison (extra ``bandits``)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from rl_yardstick.agents.bandits.algorithm import BINARY, BanditAlgorithm, Pull
from rl_yardstick.agents.bandits.linear import features, number_of_features
from rl_yardstick.agents.common.model_files import TablePolicy
from rl_yardstick.agents.common.settings import NOT_NEGATIVE, SHARE, check_space, check_vectors
from rl_yardstick.mdp.transition_model import Floats, Ints

# MABWiser's learning policies: their arguments, with the attributes of our agents that hold them;
# and where they keep their state, in dictionaries by arm or in the attributes of LinUCB's models.
SUMS = ("arm_to_sum", "arm_to_count", "arm_to_expectation")
KINDS: dict[str, tuple[dict[str, str], tuple[str, ...]]] = {
    "EpsilonGreedy": ({"epsilon": "exploration_initial_eps"}, SUMS),
    "UCB1": ({"alpha": "c"}, (*SUMS, "arm_to_mean")),
    "ThompsonSampling": ({}, ("arm_to_success_count", "arm_to_fail_count")),
    # With another ridge than 1, the library is wrong about untried arms.
    "LinUCB": ({"alpha": "alpha"}, ("A", "A_inv", "Xty", "beta")),
}


class MABWiserPolicy(TablePolicy):
    """Holds a `mabwiser.mab.MAB` over arms numbered from 0, and saves its objects as one tensor."""

    sizes = ("kind", "settings")

    def __init__(self, *args: Any, kind: str, settings: dict[str, float], **kwargs: Any) -> None:
        from mabwiser.mab import MAB, LearningPolicy

        super().__init__(*args, **kwargs)
        self.kind, self.settings = kind, settings
        arms = range(int(self.action_space.n))  # type: ignore[attr-defined]
        self.mab: Any = MAB(list(arms), getattr(LearningPolicy, kind)(**self.settings))
        self.fitted, self.reads_contexts = False, kind == "LinUCB"

    def _places(self, arm: int) -> list[tuple[dict[Any, Any], Any]]:
        """Where the library keeps the state of an arm: dictionaries and keys."""
        inside, names = self.mab._imp, KINDS[self.kind][1]
        if self.reads_contexts:
            return [(vars(inside.arm_to_model[arm]), name) for name in names]
        return [(getattr(inside, name), arm) for name in names]

    @property
    def parts(self) -> Floats:
        """The state: a row of numbers for each arm, shape (arms, ...)."""
        rows = [[place[key] for place, key in self._places(arm)] for arm in self.mab.arms]
        return np.stack([np.concatenate(row, axis=None) for row in rows]).astype(np.float64)

    def learn(self, arm: int, reward: float, context: Floats) -> None:
        """Let the library learn from one reward in ``context``, of shape (features,)."""
        learn = self.mab.partial_fit if self.fitted else self.mab.fit
        learn([arm], [reward], context[None] if self.reads_contexts else None)
        self.fitted = True

    def judged(self, contexts: Floats) -> Floats:
        """The estimated mean reward of each arm, shape (n, arms)."""
        if not self.fitted:
            return np.zeros((len(contexts), len(self.mab.arms)))
        if self.reads_contexts:
            models = self.mab._imp.arm_to_model
            return np.stack([contexts @ models[arm].beta for arm in self.mab.arms], axis=1)
        won, seen = self.parts[:, 0], self.parts[:, 1]
        seen = won + seen if self.kind == "ThompsonSampling" else seen
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
        """Make the library's objects, with the state of another policy of this kind."""
        if len(state) == 0:
            return
        self.learn(0, 0.0, np.zeros(number_of_features(self.observation_space)))
        if state.shape != self.parts.shape:
            raise ValueError(f"holds arms of shape {tuple(state.shape)}, not {self.parts.shape}")
        for arm, rest in enumerate(state.numpy().copy()):
            for place, key in self._places(arm):
                part, rest = np.split(rest, [np.size(place[key])])  # noqa: PLW2901
                place[key] = part.reshape(np.shape(place[key]))[()]
        if not self.reads_contexts:
            self.mab._imp.total_count = float(state[:, 1].sum())


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
        if self.kind == "LinUCB":
            check_vectors(self, self.observation_space)
        else:
            check_space(self, "observations", self.observation_space)

    def _policy_arguments(self) -> dict[str, Any]:
        settings = {name: getattr(self, ours) for name, ours in KINDS[self.kind][0].items()}
        return {"kind": self.kind, "settings": settings}

    def _contexts(self, obs: NDArray[Any]) -> Floats:
        return features(self.observation_space, obs)

    def _choose(  # type: ignore[override]  # the library knows no masks
        self, contexts: Floats, rng: np.random.Generator
    ) -> tuple[Ints, Floats]:
        # The library needs a reward first, and would take an untried arm's mean reward for 0.
        mab, first = self.policy.mab, None if self.policy.fitted else 0
        if self.kind == "UCB1":
            first = next((arm for arm in mab.arms if not mab._imp.arm_to_count[arm]), None)
        mab._rng.rng = rng
        told = [context[None] if self.policy.reads_contexts else None for context in contexts]
        arms = [int(mab.predict(each)) if first is None else first for each in told]
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
