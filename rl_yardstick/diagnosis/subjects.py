"""What is audited: classes in Stable-Baselines3's style, and functions that train."""

from __future__ import annotations

import inspect
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import numpy as np

from rl_yardstick.agents.registry import ALGORITHMS, load_algorithm
from rl_yardstick.diagnosis.composite_world import GAMMA, N_STATES, Copies, Row
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.components import (
    arguments_of,
    check_arguments,
    constructor_arguments,
    constructor_parameters,
)
from rl_yardstick.pipeline.errors import UserError, one_line, unknown
from rl_yardstick.pipeline.spec import validated

SpaceKind = Literal["discrete", "box"]  # of observations
Settings = Mapping[str, Any]

# What an algorithm claims to be, and its next value: a rule of `backups`, or that of states.
KINDS: Mapping[str, str] = {
    "q_learning": "largest",
    "off_policy_monte_carlo": "largest",
    "sarsa": "next",
    "expected_sarsa": "expected",
    "actor_critic": "states",
    "policy_gradient": "states",
}
_KIND_WORDS = {
    "expected_sarsa": r"expected[ _-]?sarsa",
    "sarsa": r"sarsa",
    "q_learning": r"q[ _-]?(learning|network|lambda)|dqn|qlearn",
    "actor_critic": r"actor[ _-]?critic|a2c|ppo|reinforce|policy[ _-]gradient",
}
_LONGER = r"monte[ _-]?carlo|lambda|trace|n[ _-]?step"  # words of learners that look far ahead


def kind_of(*texts: str | None) -> str | None:
    """The kind that a name or a docstring tells first."""
    for text in texts:
        found = {kind: re.search(words, text or "", re.I) for kind, words in _KIND_WORDS.items()}
        if places := {kind: match.start() for kind, match in found.items() if match}:
            return min(places, key=lambda kind: places[kind])
    return None


def docs_of_module(thing: Any) -> str:
    """The docstring of the module that defines a class or function."""
    return getattr(inspect.getmodule(thing), "__doc__", None) or ""


class CannotTrain(Exception):  # noqa: N818 (a finding)
    """What the audited program raised, in a line."""


def by_user(function: Callable[..., Any], *args: Any, **settings: Any) -> Any:
    """What a function of the audited program returns; `CannotTrain` if it raises anything."""
    try:
        return function(*args, **settings)
    except UserError:
        raise
    except Exception as error:
        raise CannotTrain(f"{type(error).__name__}: {one_line(error)}") from error


class Trained(NamedTuple):
    """What a training in the composite world leaves."""

    values: Floats | None  #: of actions (S, 2) or of states (S, 1); None if they cannot be read
    act: Callable[[int], int]  #: the action in a state when evaluated
    logs: list[list[Row]]  #: of each copy of the world


class Subject(ABC):
    """An algorithm under audit."""

    kind: str | None = None  # one of `KINDS`; None if it is not known
    typed: Settings  # settings that the user gave
    parameters: Mapping[str, inspect.Parameter]
    observes: SpaceKind  # the kind of observations
    kinds: Sequence[SpaceKind] = ("box", "discrete")  # that are tried, in this order

    def __init__(self, name: str, kind: str | None, doc: str = "") -> None:
        self.name, self.kind = name, kind
        #: whether each step learns from the next value alone
        self.is_one_step = not re.search(_LONGER, f"{name} {kind} {doc}", re.I)

    @abstractmethod
    def run(self, make_env: Copies, seed: int, steps: int, changes: Settings) -> Any:
        """A model that is trained, with ``predict``."""

    def train(self, steps: int, seed: int, bump: int = -1, **changes: Any) -> Trained:
        """Train in the composite world.

        Args:
            steps: of the environment.
            seed: of the training.
            bump: the number of a step whose reward is 1 higher.
            **changes: settings under the learner's names.
        """
        copies = Copies(self.observes == "discrete", bump)
        model = by_user(self.run, copies, seed, steps, changes)
        world = copies()
        shown = [world.observation_of(state) for state in range(N_STATES)]

        def act(state: int) -> int:
            action, _ = by_user(model.predict, np.asarray(shown[state]), deterministic=True)
            return int(np.asarray(action).reshape(-1)[0])

        return Trained(by_user(values_of, model, shown), act, copies.of_training())

    def named(self, *names: str) -> str | None:
        """The first of these settings that the learner has."""
        return next((name for name in names if name in self.parameters), None)

    def find_observations(self, wanted: SpaceKind | None) -> None:
        """Take the first kind of observations that the learner can train on."""
        errors: list[str] = []
        for kind in self.kinds if wanted is None else (wanted,):
            self.observes = kind
            try:
                self.train(60, 0).act(0)
                return
            except CannotTrain as error:
                errors.append(str(error))
        told = f"{'; '.join(dict.fromkeys(errors))} (--observations sets their kind)"
        raise UserError(f"{self.name} cannot train on a tiny world: {told}")


# --- classes --------------------------------------------------------------------------------------

# Families of the library and of ours: what they claim to be, and settings under which they learn
# this world in few steps. Settings that a class does not have are left out.
_NETWORK: Settings = {
    "learning_rate": 3e-3,
    "buffer_size": 4000,
    "learning_starts": 100,
    "batch_size": 64,
    "train_freq": 2,
    "target_update_interval": 50,
    "n_epochs": 10,
    "policy_kwargs": {"net_arch": [32]},
}
_FAMILIES: Mapping[str, tuple[str, Settings]] = {
    **dict.fromkeys(("NStepTreeBackup", "ExpectedSARSA"), ("expected_sarsa", {})),
    **dict.fromkeys(("NStepSARSA", "SARSALambda", "SARSA", "SemiGradientSARSA"), ("sarsa", {})),
    "MonteCarlo": ("sarsa", {"learning_rate": 0.1}),
    "OptimisticAlgorithm": ("q_learning", {"bonus_scale": 1e-3, "known_after": 1}),
    "TabularAlgorithm": ("q_learning", {}),
    "SemiGradientQ": ("q_learning", {}),
    "ActorCritic": ("actor_critic", {}),
    "Reinforce": ("actor_critic", {"baseline": "value"}),
    "QRDQN": ("q_learning", {**_NETWORK, "policy_kwargs": {"net_arch": [32], "n_quantiles": 10}}),
    "DQN": ("q_learning", _NETWORK),
    "OnPolicyAlgorithm": ("actor_critic", {**_NETWORK, "n_steps": 128}),
}
_EXPLORES: Settings = {"exploration_initial_eps": 1.0, "exploration_final_eps": 1.0}


class ClassSubject(Subject):
    """A subclass of Stable-Baselines3's `BaseAlgorithm`, or a plain class: an agent by name.

    ``kind`` is what it claims to be (default: as its family or its name), ``wanted`` the kind of
    observations (default: the first that works).
    """

    def __init__(
        self, name: str, typed: Settings, kind: str | None = None, wanted: SpaceKind | None = None
    ) -> None:
        cls: Any = load_algorithm(name)
        plain = getattr(cls, "plain", None)
        docs = inspect.getdoc(plain or cls) or "", docs_of_module(plain) if plain else ""
        super().__init__(name, kind, " ".join(docs))
        if ALGORITHMS[name].for_bandits:
            raise UserError(f"--algo {name}: it is for bandits, and this world has states")
        if ALGORITHMS[name].family in ("planning", "reference"):
            raise UserError(f"--algo {name}: it does not learn")
        self.cls, self.parameters = cls, constructor_parameters(cls)
        if plain is not None and "gamma" not in self.parameters:
            raise UserError(f"--algo {name}: its constructor must take gamma, which is set to 0.8")
        known = arguments_of(name)
        for key in typed:
            if key not in known:
                raise unknown(f"{name} has no hyperparameter", key, known)
        ancestors = [ancestor.__name__ for ancestor in cls.__mro__]
        families = (_FAMILIES[each] for each in ancestors if each in _FAMILIES)
        claims, settings = next(families, (None, {}))
        self.kind = kind or claims or kind_of(name.rpartition(".")[2], *docs)
        self.base = {**_EXPLORES, **settings}
        if plain is None:
            self.kinds = ("discrete", "box")
        arguments = check_arguments(name, typed)
        spec = validated({"algo": name, "env_id": "", "algorithm": arguments})
        self.typed = constructor_arguments(spec, cls, is_dict=False)
        self.find_observations(wanted)

    def run(self, make_env: Copies, seed: int, steps: int, changes: Settings) -> Any:
        wanted = {**self.base, "gamma": GAMMA, "seed": seed, "device": "cpu"}
        model = self.made(make_env, {**wanted, **self.typed, **changes})
        model.learn(steps)
        return model

    def made(self, make_env: Copies, wanted: Settings) -> Any:
        """An untrained model, with those of the settings that its class has."""
        from stable_baselines3.common.logger import Logger

        settings = {name: deepcopy(each) for name, each in wanted.items() if self.named(name)}
        model = self.cls(env=make_env(), **settings)
        model.set_logger(Logger(folder=None, output_formats=[]))
        return model


def values_of(model: Any, observations: list[Any]) -> Floats | None:
    """A model's values at n observations, shape (n, 2) or (n, 1); None where it has none."""
    from rl_yardstick.agents.policies import own_values

    policy, batch = getattr(model, "policy", None), np.stack(observations)
    for holder in (policy, model):
        if isinstance(table := getattr(holder, "q_table", None), np.ndarray) and batch.ndim == 1:
            return np.asarray(table[batch], dtype=np.float64)
    if callable(getattr(model, "values", None)):
        return np.stack([np.ravel(model.values(obs)) for obs in observations]).astype(float)
    found = None if policy is None else own_values(model, batch)
    return None if found is None else found.reshape(len(batch), -1).astype(float)


# --- single files ---------------------------------------------------------------------------------

_NEEDED = ("make_env", "seed", "gamma", "steps")


class ScriptSubject(Subject):
    """A function ``train(make_env, seed, gamma, steps, ...)`` that returns a trained agent.

    The agent has ``act(obs)``, an action, and ``values(obs)``, a number or one for each action.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Any],
        typed: Settings,
        kind: str | None = None,
        wanted: SpaceKind | None = None,
    ) -> None:
        docs = inspect.getdoc(function) or "", docs_of_module(function)
        super().__init__(name, kind or kind_of(name, *docs), " ".join(docs))
        self.function, self.typed = function, typed
        try:
            self.parameters = inspect.signature(function).parameters
        except (TypeError, ValueError) as error:
            raise UserError(f"{name}: {one_line(error)}") from error
        takes_any = any(p.kind is p.VAR_KEYWORD for p in self.parameters.values())
        missing = [each for each in _NEEDED if not (takes_any or self.named(each))]
        if missing:
            told = f"{', '.join(_NEEDED)}: {', '.join(missing)} is missing"
            raise UserError(f"{name} must take {told}")
        for key in typed:
            if not self.named(key):
                raise unknown(f"-params: unknown argument of {name}", key, self.parameters)
        self.find_observations(wanted)

    def run(self, make_env: Copies, seed: int, steps: int, changes: Settings) -> Any:
        settings: Any = {"seed": seed, "gamma": GAMMA, **deepcopy(dict(self.typed)), **changes}
        agent = self.function(make_env=make_env, steps=steps, **settings)
        if not callable(getattr(agent, "act", None)):
            raise UserError("a script's function must return something with act(obs)")

        def predict(observation: Any, **_: Any) -> tuple[Any, None]:
            return agent.act(observation if observation.ndim else int(observation)), None

        return SimpleNamespace(predict=predict, values=getattr(agent, "values", None))
