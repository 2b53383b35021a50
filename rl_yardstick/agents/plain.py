"""Plain classes with ``act`` and ``learn``, as algorithms of Stable-Baselines3's kind."""

from __future__ import annotations

import base64
import inspect
import pickle
import random
from collections import defaultdict
from collections.abc import Iterator
from copy import deepcopy
from functools import cache
from typing import Any, ClassVar, Self

import cloudpickle
import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import set_random_seed

from rl_yardstick.agents.common import model_files
from rl_yardstick.agents.common.algorithm import OnlineAlgorithm, Transitions
from rl_yardstick.agents.own_classes import hyperparameters_of, parameters_of
from rl_yardstick.mdp.transition_model import Floats


class PlainPolicy(model_files.TablePolicy):
    """Asks a plain agent, which holds what it has learnt."""

    owner: PlainAgent

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        ask = self.owner.greedy_action if deterministic else self.owner.judged.act
        actions = [self.owner.as_array(ask(row)) for row in self.owner.rows(observation)]
        return th.from_numpy(np.stack(actions))


class PlainAgent(OnlineAlgorithm):
    """The base of the algorithms of `algorithm_of`: one environment, and an agent of `plain`.

    Evaluations ask a copy of the agent, so that they change nothing in its training.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"PlainPolicy": PlainPolicy}
    hidden_arguments = ("learning_rate", "policy_kwargs", "supported_action_spaces")
    excluded_from_states = ("_judged",)
    plain: ClassVar[type]
    policy: PlainPolicy
    agent: Any  # of the class `plain`

    def __init__(self, policy: str | type[BasePolicy] = "PlainPolicy", *a: Any, **kw: Any) -> None:
        own = hyperparameters_of(self.plain)
        self.hyperparams = {name: kw.pop(name) for name in own if name in kw}
        self.state: dict[str, Any] = {}  # of the agent, in a zip
        self._judged: Any = None  # a copy of the agent, until that learns on
        super().__init__(policy, *a, **kw)
        if self.n_envs != 1 and kw.get("_init_setup_model", True):
            raise ValueError("it learns from one environment at a time: n_envs must be 1")

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self.policy = self.policy_class(self.observation_space, self.action_space)
        self.policy.owner = self
        self.agent = self._made()
        self._judged, _ = deepcopy(self.agent), self._state()  # what fails, fails at the start

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed all generators, also the global ones, which the user's class may use."""
        super().set_random_seed(seed)
        if seed is not None:
            set_random_seed(seed)

    def _made(self) -> Any:
        seen, done = self.observation_space, self.action_space
        given = {"observation_space": seen, "action_space": done, "seed": self.seed}
        given |= {"n_states": getattr(seen, "n", None), "n_actions": getattr(done, "n", None)}
        given["env"] = outside = gym.Env[Any, Any]()  # for its spaces; it has no steps
        outside.observation_space, outside.action_space = seen, done
        kept = {name: given[name] for name in given if name in parameters_of(self.plain)}
        own = {n: p.default for n, p in hyperparameters_of(self.plain).items()} | self.hyperparams
        if lacking := [name for name in own if own[name] is inspect.Parameter.empty]:
            raise ValueError(f"it needs {', '.join(lacking)}: -params {lacking[0]}:VALUE")
        return self.plain(**kept, **self.hyperparams)

    # --- acting and learning ----------------------------------------------------------------------

    @property
    def judged(self) -> Any:
        """A copy of the agent as it is now."""
        if self._judged is None:
            self._judged = deepcopy(self.agent)
        return self._judged

    def greedy_action(self, obs: Any) -> Any:
        """The action without exploration, where the class has one."""
        if "explore" in parameters_of(self.plain, "act"):
            return self.judged.act(obs, explore=False)
        is_discrete = isinstance(self.action_space, spaces.Discrete)
        if is_discrete and hasattr(self.plain, "values") and (values := self._values(obs)).ndim:
            return int(values.argmax()) + int(self.action_space.start)  # type: ignore[attr-defined]
        return self.judged.act(obs)

    def _values(self, obs: Any) -> Floats:
        values = np.asarray(self.judged.values(obs), dtype=np.float64)
        n_actions = getattr(self.action_space, "n", 1)
        if values.shape not in ((), (n_actions,)) or np.isnan(values).any():
            wanted = f"one number, or one for each of {n_actions} actions"
            raise ValueError(f"{self.plain.__name__}.values({obs}) is {values}, not {wanted}")
        return values

    def values_at(self, observations: Any) -> Floats | None:
        """Its ``values``, shape (n, A) or (n,); None without this method."""
        if not hasattr(self.plain, "values"):
            return None
        return np.stack([self._values(row) for row in self.rows(observations)])

    def as_array(self, action: Any) -> NDArray[Any]:
        """An action as environments take it: within the bounds of a Box, as in the library."""
        space: Any = self.action_space
        if isinstance(space, spaces.Box):
            found = np.asarray(action, dtype=space.dtype).reshape(space.shape)
            action = np.clip(found, space.low, space.high)
        if not space.contains(action):
            raise ValueError(f"{self.plain.__name__}.act returned {action!r}, not in {space}")
        return np.asarray(action, dtype=space.dtype)

    def rows(self, observations: Any) -> Iterator[Any]:
        """Each of n observations as its space has it, without the axis of length n."""
        if isinstance(observations, dict):
            parts = {key: np.asarray(value) for key, value in observations.items()}
            for i in range(len(next(iter(parts.values())))):
                yield {key: part[i] for key, part in parts.items()}
        else:
            found = np.asarray(observations)
            yield from found.tolist() if found.ndim == 1 else found

    def _choose_actions(self) -> NDArray[Any]:
        self._judged = None
        self._action = self.agent.act(next(self.rows(self._last_obs)))
        return self.as_array(self._action)[None]

    def _learn_from(self, transitions: Transitions) -> None:
        self._judged, is_over = None, bool(transitions.dones[0])
        terminated, reward = bool(transitions.terminated[0]), float(transitions.rewards[0])
        obs, next_obs = (next(self.rows(o)) for o in (transitions.obs, transitions.next_obs))
        takes = parameters_of(self.plain, "learn")
        told = {"truncated": is_over and not terminated} if "truncated" in takes else {}
        self.agent.learn(obs, self._action, reward, next_obs, terminated, **told)
        if is_over:
            self._begin_episodes()

    def _begin_episodes(self) -> None:
        if hasattr(self.plain, "reset"):
            self.agent.reset()

    def predict(self, obs: Any, state: Any = None, start: Any = None, *a: Any, **kw: Any) -> Any:
        """As in the library; ``reset`` is called where an episode starts."""
        start = kw.pop("episode_start", start)
        if start is not None and hasattr(self.plain, "reset"):
            if len(start) > 1:
                raise ValueError("an agent with reset() plays one environment at a time")
            if start[0]:
                self.judged.reset()
        return super().predict(obs, state, start, *a, **kw)

    def why_not_exact(self, observations: NDArray[Any]) -> str:
        """Why its greedy actions are no function of observations; empty if they are one."""
        kept = []
        for part in (observations, observations[::-1]):  # the first may make rows of a table
            actions, _ = self.predict(part, deterministic=True)
            generators = random.getstate(), np.random.get_state()  # noqa: NPY002
            kept.append((actions, cloudpickle.dumps((self.judged, generators))))
        if np.array_equal(kept[0][0], kept[1][0][::-1]) and kept[0][1] == kept[1][1]:
            return ""
        return "act draws at random or remembers (see values and explore in docs/own-agent.md)"

    # --- files ------------------------------------------------------------------------------------

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "agent", "_judged", "_action"]

    def save(self, *a: Any, **kw: Any) -> None:
        """Write the zip: the agent's state as data, or as a pickle with the user's signature."""
        self.state = self._state()
        super().save(*a, **kw)
        self.state = {}

    def _state(self) -> dict[str, Any]:
        if hasattr(self.plain, "state_dict") and hasattr(self.plain, "load_state_dict"):
            return {"state_dict": dict(self.agent.state_dict())}
        found = self.agent.__getstate__() or {}
        if isinstance(found, dict) and not hasattr(self.plain, "__setstate__"):
            kept = {n: value for n, value in found.items() if not isinstance(value, gym.Env)}
            kept = {n: dict(v) if type(v) is defaultdict else v for n, v in kept.items()}
            try:
                model_files.encode(kept)
                return {"attributes": kept}
            except model_files.UnknownTypeError:
                pass
        content = model_files.signed(cloudpickle.dumps(self.agent))
        return {"pickle": base64.b64encode(content).decode()}

    @classmethod
    def load(cls, *a: Any, **kw: Any) -> Self:
        """As of every agent; hyperparameters among the keywords change attributes of that name."""
        changed = {name: kw.pop(name) for name in hyperparameters_of(cls.plain) if name in kw}
        model = super().load(*a, **kw)
        kind, content = model.state.popitem()
        if kind == "pickle":
            pickled = model_files.verified(base64.b64decode(content))
            model.agent, content = pickle.loads(pickled), {}  # noqa: S301  # signed
        elif kind == "state_dict":
            model.agent.load_state_dict(content)
            content = {}
        if lacking := [name for name in changed if not hasattr(model.agent, name)]:
            raise ValueError(f"{cls.__name__} has no attribute {lacking[0]} to change")
        for name, value in {**content, **changed}.items():
            old = vars(model.agent).get(name)
            factory = old.default_factory if isinstance(old, defaultdict) else None
            setattr(model.agent, name, defaultdict(factory, value) if factory else value)
        model.hyperparams |= changed
        model._judged = None
        return model


@cache
def algorithm_of(plain: type) -> type[PlainAgent]:
    """The algorithm that trains agents of a plain class; its arguments are those of both."""
    own = {"plain": plain, "__module__": plain.__module__}
    made: Any = type(plain.__name__, (PlainAgent,), own)
    every = {**made.__signature__.parameters, **hyperparameters_of(plain)}
    every = {name: one.replace(kind=one.KEYWORD_ONLY) for name, one in every.items()}
    made.__signature__ = inspect.Signature([*every.values()])
    return made  # type: ignore[no-any-return]
