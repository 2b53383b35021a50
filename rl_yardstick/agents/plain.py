"""Plain classes with ``act`` and ``learn``, as algorithms of Stable-Baselines3's kind."""

from __future__ import annotations

import base64
import hmac
import inspect
import pickle
import random
from copy import deepcopy
from functools import cache, cached_property
from typing import Any, ClassVar, Self

import cloudpickle
import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import set_random_seed

from rl_yardstick.agents.common import model_files
from rl_yardstick.agents.common.algorithm import OnlineAlgorithm, Transitions
from rl_yardstick.agents.own_classes import GIVEN, hyperparameters_of, parameters_of
from rl_yardstick.mdp.transition_model import Floats


class PlainPolicy(model_files.TablePolicy):
    """Asks a plain agent, which holds what it has learnt."""

    owner: PlainAgent

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        rows = rows_of(observation)
        greedy = self.owner.greedy_actions(rows) if deterministic else None
        actions = [self.owner.judged.act(row) for row in rows] if greedy is None else greedy
        return th.from_numpy(np.stack([self.owner.as_array(action) for action in actions]))


class PlainAgent(OnlineAlgorithm):
    """The base of the algorithms of `algorithm_of`: one environment, and an agent of `plain`.

    Evaluations ask a copy of the agent, so that they change nothing in its training.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"PlainPolicy": PlainPolicy}
    hidden_arguments = ("learning_rate", "policy_kwargs", "supported_action_spaces")
    excluded_from_states = ("judged",)
    _rebuilt = (*OnlineAlgorithm._rebuilt, "agent", "_action", "judged")
    plain: ClassVar[type]
    policy: PlainPolicy
    agent: Any  # of the class `plain`

    def __init__(self, policy: str | type[BasePolicy] = "PlainPolicy", *a: Any, **kw: Any) -> None:
        own = hyperparameters_of(self.plain)
        self.hyperparams = {name: kw.pop(name) for name in own if name in kw}
        self.state: dict[str, Any] = {}  # of the agent, in a zip
        super().__init__(policy, *a, **kw)
        if kw.get("_init_setup_model", True) and self.n_envs != 1:
            raise ValueError("it learns from one environment at a time: n_envs must be 1")

    def _setup_model(self) -> None:
        super()._setup_model()
        if self.seed is not None:
            set_random_seed(self.seed)  # the global generators, which the user's class may use
        self.policy.owner = self
        self.agent = self._made()
        try:
            model_files.encode((self.judged, self._state())[1])  # what fails, fails at the start
        except TypeError as error:
            if not str(error).startswith("cannot "):  # an error of the user's own code
                raise
            way_out = "leave it out, by __getstate__ or state_dict"
            raise ValueError(f"{self.plain.__name__} {error}: {way_out}") from error

    def _made(self) -> Any:
        seen, done, outside = self.observation_space, self.action_space, gym.Env[Any, Any]()
        outside.observation_space, outside.action_space = seen, done  # it has no steps
        given = {"observation_space": seen, "action_space": done, "seed": self.seed, "env": outside}
        given |= {"n_states": getattr(seen, "n", None), "n_actions": getattr(done, "n", None)}
        kept = {name: given[name] for name in given if name in parameters_of(self.plain)}
        own, given = hyperparameters_of(self.plain), self.hyperparams
        if lacks := [k for k, one in own.items() if one.default is one.empty and k not in given]:
            ways = f"give -params {lacks[0]}:VALUE; filled in are {', '.join(GIVEN)}"
            raise ValueError(f"{self.plain.__name__} needs {', '.join(lacks)}: {ways}")
        return self.plain(**kept, **given)

    # --- acting and learning ----------------------------------------------------------------------

    @cached_property
    def judged(self) -> Any:
        """A copy of the agent, until that learns on."""
        return deepcopy(self.agent)

    def greedy_actions(self, rows: list[Any]) -> list[Any] | None:
        """The actions at observations without exploration; None if the class has none."""
        if "explore" in parameters_of(self.plain, "act"):
            return [self.judged.act(row, explore=False) for row in rows]
        values = self.values_at(rows)
        if values is None or values.ndim == 1:
            return None
        return [*(values.argmax(axis=1) + getattr(self.action_space, "start", 0)).tolist()]

    def values_at(self, rows: list[Any]) -> Floats | None:
        """Its values at n observations, shape (n, A) or (n,); None without ``values``."""
        if not callable(getattr(self.plain, "values", None)):
            return None
        values = np.array([self.judged.values(row) for row in rows], dtype=np.float64)
        n, name = getattr(self.action_space, "n", 0), f"{self.plain.__name__}.values(obs)"
        if values.shape[1:] not in ((), (n,)):
            raise ValueError(f"{name} is not one number, or {n} of them")
        if np.isnan(values).any():
            raise ValueError(f"{name} is NaN for an observation")
        return values

    def as_array(self, action: Any) -> NDArray[Any]:
        """An action as environments take it: within the bounds of a Box, as in the library."""
        space: Any = self.action_space
        if isinstance(space, gym.spaces.Box):
            found = np.asarray(action, dtype=space.dtype).reshape(space.shape)
            action = np.clip(found, space.low, space.high)
        if not space.contains(action):
            hint = ": return int(...)" if space.shape == () and type(action) is not int else ""
            raise ValueError(f"{self.plain.__name__}.act returned {action!r}, not in {space}{hint}")
        return np.asarray(action, dtype=space.dtype)

    def _choose_actions(self) -> NDArray[Any]:
        vars(self).pop("judged", None)
        self._action = self.agent.act(rows_of(self._last_obs)[0])
        return self.as_array(self._action)[None]

    def _learn_from(self, transitions: Transitions) -> None:
        vars(self).pop("judged", None)
        is_over = bool(transitions.dones[0])
        terminated, reward = bool(transitions.terminated[0]), float(transitions.rewards[0])
        obs, next_obs = rows_of(transitions.obs)[0], rows_of(transitions.next_obs)[0]
        takes = parameters_of(self.plain, "learn")
        told = {"truncated": is_over and not terminated} if "truncated" in takes else {}
        self.agent.learn(obs, self._action, reward, next_obs, terminated, **told)
        if is_over:
            self._begin_episodes()

    def _begin_episodes(self) -> None:
        if hasattr(self.plain, "reset"):
            self.agent.reset()

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, *a: Any, **kw: Any
    ) -> Any:
        """As in the library; ``reset`` is called where an episode starts."""
        if episode_start is not None and hasattr(self.plain, "reset"):
            if len(episode_start) > 1:
                raise ValueError("an agent with reset() plays one environment at a time")
            if episode_start[0]:
                self.judged.reset()
        return super().predict(observation, state, episode_start, *a, **kw)

    def why_not_exact(self, observations: NDArray[Any]) -> str:
        """Why its greedy actions are no function of observations; empty if they are one."""
        kept = []
        for part in (observations, observations[::-1]):  # the first may make rows of a table
            try:
                actions, _ = self.predict(part, deterministic=True)
            except AttributeError:  # of what `reset` sets
                self.judged.reset()
                actions, _ = self.predict(part, deterministic=True)
            generators = random.getstate(), np.random.get_state()  # noqa: NPY002
            kept.append((actions, cloudpickle.dumps((self.judged, generators))))
        if np.array_equal(kept[0][0], kept[1][0][::-1]) and kept[0][1] == kept[1][1]:
            return ""
        return "act draws at random or remembers (see values and explore in docs/own-agent.md)"

    # --- files: the state as data by `state_dict`, else a pickle with the user's signature --------

    def save(self, *a: Any, **kw: Any) -> None:
        """As of every agent."""
        self.state = self._state()
        super().save(*a, **kw)
        self.state = {}

    def _state(self) -> dict[str, Any]:
        if hasattr(self.plain, "state_dict") and hasattr(self.plain, "load_state_dict"):
            return {"state_dict": dict(self.agent.state_dict())}
        pickled = cloudpickle.dumps(self.agent)
        content = hmac.digest(model_files.key_of_user(), pickled, "sha256") + pickled
        return {"pickle": base64.b64encode(content).decode()}

    @classmethod
    def load(cls, *a: Any, **kw: Any) -> Self:
        """As of every agent."""
        model = super().load(*a, **kw)
        kind, content = model.state.popitem()
        if kind == "state_dict":
            model.agent.load_state_dict(content)
        else:
            given, pickled = (part := base64.b64decode(content))[:32], part[32:]
            wanted = hmac.digest(model_files.key_of_user(), pickled, "sha256")
            if not hmac.compare_digest(given, wanted):
                raise ValueError("it holds a pickle, not signed with your key, which is not loaded")
            model.agent = pickle.loads(pickled)  # noqa: S301  # signed
        vars(model).pop("judged", None)
        return model


def rows_of(observations: Any) -> list[Any]:
    """Each of n observations as its space has it, without the axis of length n."""
    if isinstance(observations, dict):
        columns = [np.asarray(column) for column in observations.values()]
        return [dict(zip(observations, row, strict=True)) for row in zip(*columns, strict=True)]
    found = np.asarray(observations)
    return found.tolist() if found.ndim == 1 else [*found]


@cache
def algorithm_of(plain: type) -> type[PlainAgent]:
    """The algorithm that trains agents of a plain class; its arguments are those of both."""
    own = {"plain": plain, "__module__": plain.__module__}
    made: Any = type(plain.__name__, (PlainAgent,), own)
    every = {**made.__signature__.parameters, **hyperparameters_of(plain)}.values()
    made.__signature__ = inspect.Signature(sorted(every, key=lambda one: one.kind))
    return made  # type: ignore[no-any-return]
