"""What is audited: classes in Stable-Baselines3's style, and functions that train."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.agents.registry import ALGORITHMS, load_algorithm
from rl_yardstick.diagnosis.faults import KINDS, Target
from rl_yardstick.diagnosis.probe_worlds import (
    ProbeEnv,
    Record,
    SpaceKind,
    World,
    action_number,
    make_env,
)
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.components import (
    arguments_of,
    check_arguments,
    constructor_arguments,
    constructor_parameters,
)
from rl_yardstick.pipeline.errors import UserError, one_line, unknown
from rl_yardstick.pipeline.spec import validated

if TYPE_CHECKING:
    from stable_baselines3.common.callbacks import BaseCallback

GAMMA = 0.8

Spaces = tuple[SpaceKind | None, SpaceKind | None]

# Settings of all audits, unless others are given: full exploration, and targets of one step.
BASE: Mapping[str, Any] = {
    "exploration_initial_eps": 1.0,
    "exploration_final_eps": 1.0,
    "trace_decay": 0.0,
    "n_steps": 1,
}

# Other names of settings; the first is the one that probes use.
OTHER_NAMES: Mapping[str, tuple[str, ...]] = {
    "trace_decay": ("trace_decay", "lambda_", "lam", "lmbda", "td_lambda"),
    "n_steps": ("n_steps", "n_step"),
}


class Trained:
    """A learner that is trained in a world, with some settings changed."""

    def __init__(
        self, subject: Subject, world: World, seed: int, changes: Mapping[str, Any]
    ) -> None:
        self.world, self.record = world, Record(world.n_states)
        self._env = ProbeEnv(world, self.record, *subject.spaces)
        self.model = subject.model_for(self, seed, changes)

    def train(self, steps: int, callback: BaseCallback | None = None) -> None:
        """Train for that many more steps."""
        is_first = not self.model.num_timesteps
        self.model.learn(steps, callback=callback, reset_num_timesteps=is_first)

    def act(self, state: int) -> int:
        """The action in a state when evaluated."""
        observation = np.asarray(self._env.observation_of(state))
        action, _ = self.model.predict(observation, deterministic=True)
        return action_number(action, self._env.action_space)

    def drawn_actions(self, state: int, n: int) -> Floats:
        """Actions as they are drawn in training, numbers of shape (n,)."""
        observations = np.stack([np.asarray(self._env.observation_of(state))] * n)
        actions, _ = self.model.predict(observations, deterministic=False)
        return np.asarray(actions, dtype=np.float64).reshape(n)

    def values(self) -> Floats | None:
        """Its values, shape (S, 2) of actions or (S, 1) of states; None where it has none."""
        return values_of(self.model, [*map(self._env.observation_of, range(self.world.n_states))])

    def state_values(self) -> Floats:
        """State values, shape (S,): action values are averaged over the actions taken."""
        values = self.values()
        assert values is not None
        if values.shape[1] == 1:
            return values[:, 0]
        counts = self.record.counts()
        weights = np.where(counts.sum(axis=1, keepdims=True) > 0, counts, 1)
        means: Floats = np.average(values, axis=1, weights=weights)
        return means


class Subject(ABC):
    """An algorithm under audit."""

    typed: Mapping[str, Any]  # settings that the user gave
    steps = 2000  # of the environment, after which values are read first
    target: Target | None = None  # the kind of its targets; None where that is not known
    uses_ratio = False  # whether it uses importance sampling, for a greedy target policy
    ancestors: Sequence[str] = ()  # names of its class and base classes; none for a script
    is_on_policy = False  # whether it learns from rollouts, as the library's on-policy agents do
    has_values = True  # whether its values can be read
    stepwise: Mapping[str, str] = {}  # settings under which ours calls its environment at each step
    spaces: tuple[SpaceKind, SpaceKind]  # the kinds of observations and actions
    parameters: Mapping[str, inspect.Parameter]

    def __init__(self, name: str, kind: str | None) -> None:
        self.name = name
        self.base = dict(BASE)  # settings that learn tiny worlds, unless the user gave others
        if kind is not None:
            self.target = KINDS[kind]
            self.uses_ratio = kind == "off_policy_monte_carlo"

    @abstractmethod
    def model_for(self, trained: Trained, seed: int, changes: Mapping[str, Any]) -> Any:
        """The model that is to be trained, with some settings changed."""

    def named(self, setting: str) -> str | None:
        """The learner's name for this setting; None where it has no such setting."""
        names = OTHER_NAMES.get(setting, (setting,))
        return next((name for name in names if name in self.parameters), None)

    def accepts(self, setting: str) -> bool:
        """Whether the learner has this setting."""
        return self.named(setting) is not None

    def settings(self, changes: Mapping[str, Any], **defaults: Any) -> dict[str, Any]:
        """All settings under the learner's own names; a copy, since learners write into them."""
        wanted = {**self.base, **defaults, **self.typed, **changes}
        named = {self.named(key): value for key, value in wanted.items()}
        return {name: deepcopy(value) for name, value in named.items() if name is not None}

    def find_spaces(self, wanted: Spaces) -> None:
        """Take the first kinds of observations and actions that the learner can train on."""
        errors: list[Exception] = []
        known: Any = ("discrete", "box")
        for self.spaces in product(*(known if one is None else (one,) for one in wanted)):
            try:
                trained = Trained(self, World(((0, 0), (1, 1))), 0, {})
                trained.train(40)
                trained.act(0)
                self.has_values = trained.values() is not None
                return
            except UserError:
                raise
            except Exception as error:  # noqa: BLE001 (user code may raise anything)
                errors.append(error)
        raise UserError(
            f"{self.name} cannot train on a tiny world: {type(errors[0]).__name__}: "
            f"{one_line(errors[0])} (--observations and --actions set the kinds of its spaces)"
        )


# --- classes --------------------------------------------------------------------------------------

# Families of the library and of ours: kind of target, steps, and settings that learn tiny worlds
# fast. Rates are constant, and exploration is full.
_NET: Mapping[str, Any] = {"policy_kwargs": {"net_arch": [32]}}
_OFF_POLICY: Mapping[str, Any] = {
    "learning_rate": 3e-3,
    "buffer_size": 2000,
    "learning_starts": 50,
    "batch_size": 64,
    "train_freq": 2,
    "gradient_steps": 1,
    "target_update_interval": 50,
    **_NET,
}
_ACTOR = {key: value for key, value in _OFF_POLICY.items() if key != "target_update_interval"}
_ACTOR |= {"tau": 0.2, "ent_coef": 1e-3}
_ON_POLICY: Mapping[str, Any] = {
    "learning_rate": 5e-3,
    "n_steps": 64,
    "batch_size": 64,
    "n_epochs": 10,
    "gae_lambda": 0.0,
    "policy_kwargs": {"net_arch": {"pi": [32], "vf": [32]}},
}
_QUANTILES = {"policy_kwargs": {"net_arch": [32], "n_quantiles": 10}}
_LSTM = {"policy_kwargs": {**_ON_POLICY["policy_kwargs"], "lstm_hidden_size": 16}}
_FOLLOW = ("NStepTreeBackup", "NStepSARSA", "SARSALambda", "SARSA", "ExpectedSARSA")
_MAXIMISE = ("QLambda", "QLearning", "PrioritizedSweeping", "SemiGradientQ")
_FAMILIES: Mapping[str, tuple[Target | None, int, Mapping[str, Any]]] = {
    **dict.fromkeys(_FOLLOW, ("follows", 1000, {})),
    **dict.fromkeys(_MAXIMISE, ("maximises", 1000, {})),
    **dict.fromkeys(("OffPolicyMonteCarlo", "DoubleQLearning"), ("maximises", 2000, {})),
    "OptimisticAlgorithm": ("maximises", 1000, {"bonus_scale": 1e-3, "known_after": 1}),
    "SemiGradientSARSA": ("follows", 1000, {}),
    "MonteCarlo": ("follows", 1000, {"learning_rate": 0.1}),
    "ActorCritic": ("states", 1000, {}),
    "Reinforce": ("states", 1000, {"baseline": "value"}),
    "QRDQN": ("maximises", 250, {**_OFF_POLICY, **_QUANTILES}),
    "DQN": ("maximises", 250, _OFF_POLICY),
    "TQC": (None, 250, {**_ACTOR, "top_quantiles_to_drop_per_net": 0, **_NET}),
    "CrossQ": (None, 1000, _ACTOR),
    "SAC": (None, 250, _ACTOR),
    "TD3": (None, 250, _ACTOR),
    "A2C": ("states", 400, {**_ON_POLICY, "n_steps": 1, "learning_rate": 1e-2}),
    "RecurrentPPO": ("states", 256, {**_ON_POLICY, **_LSTM}),
    "TRPO": ("states", 256, {**_ON_POLICY, "n_critic_updates": 10}),
    "OnPolicyAlgorithm": ("states", 256, _ON_POLICY),
    "ARS": (None, 2000, {"n_delta": 4, "learning_rate": 0.05, "delta_std": 0.1}),
}


class ClassSubject(Subject):
    """A subclass of Stable-Baselines3's `BaseAlgorithm`, an agent of the registry.

    ``kind`` is what it claims to be (default: as its family), ``wanted`` the kinds of observations
    and actions (default: the first that works).
    """

    def __init__(
        self,
        name: str,
        typed: Mapping[str, Any],
        kind: str | None = None,
        wanted: Spaces = (None, None),
    ) -> None:
        super().__init__(name, kind)
        if ALGORITHMS[name].for_bandits:
            raise UserError(f"--algo {name}: it is for bandits, and these worlds have states")
        if ALGORITHMS[name].family in ("planning", "reference"):
            raise UserError(f"--algo {name}: it does not learn")
        self.cls: Any = load_algorithm(name)
        self.parameters = constructor_parameters(self.cls)
        if hasattr(self.cls, "plain") and "gamma" not in self.parameters:
            raise UserError(f"--algo {name}: its constructor must take gamma, which probes set")
        known = arguments_of(name)
        for key in typed:
            if key not in known:
                raise unknown(f"{name} has no hyperparameter", key, known)
        # what the family claims to be, and settings that learn tiny worlds fast
        self.ancestors = [ancestor.__name__ for ancestor in self.cls.__mro__]
        family = next((name for name in self.ancestors if name in _FAMILIES), None)
        if family is not None:
            target, self.steps, settings = _FAMILIES[family]
            self.base |= settings
            self.target = self.target or target
        self.uses_ratio |= family == "OffPolicyMonteCarlo"
        self.is_on_policy = "OnPolicyAlgorithm" in self.ancestors
        if self.is_on_policy:
            self.target = "states"
        if "=interpreted" in known.get("engine", []) and "engine" not in typed:
            self.stepwise = {"engine": "interpreted"}
        arguments = check_arguments(name, typed)
        spec = validated({"algo": name, "env_id": "", "algorithm": arguments})
        self.typed = constructor_arguments(spec, self.cls, is_dict=False)
        self.find_spaces(wanted)

    def model_for(self, trained: Trained, seed: int, changes: Mapping[str, Any]) -> Any:
        from stable_baselines3.common.logger import Logger

        settings = self.settings(changes, gamma=GAMMA, seed=seed, device="cpu")
        env = make_env(trained.world, trained.record, *self.spaces)
        model = self.cls(env=env, **settings)
        model.set_logger(Logger(folder=None, output_formats=[]))
        return model


def values_of(model: Any, observations: list[Any]) -> Floats | None:
    """A model's values at observations, shape (n, 2) or (n, 1); None where it has none."""
    import torch as th

    from rl_yardstick.agents.policies import own_values

    policy, batch = model.policy, np.stack(observations)
    for holder in (policy, model):
        if isinstance(table := getattr(holder, "q_table", None), np.ndarray) and batch.ndim == 1:
            return np.asarray(table[batch], dtype=np.float64)
    if callable(getattr(model, "values", None)):
        return np.stack([np.ravel(model.values(obs)) for obs in observations]).astype(float)
    if not (hasattr(policy, "lstm_critic") or hasattr(policy, "critic")):
        found = own_values(model, batch)
        return None if found is None else found.reshape(len(batch), -1)
    policy.set_training_mode(False)
    with th.no_grad():
        tensor, _ = policy.obs_to_tensor(batch)
        if not hasattr(policy, "lstm_critic"):  # at the actor's action: no others are learnt
            critics = policy.critic(tensor, policy._predict(tensor, deterministic=True))
            critics = th.stack(critics) if isinstance(critics, tuple) else critics.transpose(0, 1)
            means = critics.reshape(len(critics), len(tensor), -1).mean(dim=(0, 2))
            return np.asarray(means.double().numpy())[:, None]
        told, shape = [], (policy.lstm_critic or policy.lstm_actor)
        for last in range(len(tensor)):  # each state after those that lead to it
            start = th.zeros(shape.num_layers, 1, shape.hidden_size)
            begins = th.eye(1, last + 1)[0]
            told.append(policy.predict_values(tensor[: last + 1], (start, start), begins)[-1])
    return np.asarray(th.stack(told).double().numpy())


# --- single files ---------------------------------------------------------------------------------

_NEEDED = ("make_env", "seed", "gamma", "steps")


class ScriptSubject(Subject):
    """A function ``train(make_env, seed, gamma, steps, ...)`` that returns a trained agent.

    The agent has ``act(obs)``, an action, and ``values(obs)``, a number or one for each action.
    Probes that need a setting give it as the argument of that name.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Any],
        typed: Mapping[str, Any],
        kind: str | None = None,
        wanted: Spaces = (None, None),
    ) -> None:
        super().__init__(name, kind)
        self.function, self.typed = function, typed
        if self.target == "states":  # ``n_steps`` may be the length of a rollout
            self.base.pop("n_steps")
        try:
            self.parameters = inspect.signature(function).parameters
        except (TypeError, ValueError) as error:
            raise UserError(f"{name}: {one_line(error)}") from error
        takes_any = any(p.kind is p.VAR_KEYWORD for p in self.parameters.values())
        missing = [each for each in _NEEDED if not (takes_any or self.accepts(each))]
        if missing:
            raise UserError(
                f"{name} must take {', '.join(_NEEDED)}: {', '.join(missing)} is missing"
            )
        for key in typed:
            if not self.accepts(key):
                raise unknown(f"-params: unknown argument of {name}", key, self.parameters)
        self.find_spaces(wanted)

    def model_for(self, trained: Trained, seed: int, changes: Mapping[str, Any]) -> ScriptModel:
        make = partial(make_env, trained.world, trained.record, *self.spaces)
        settings = {"seed": seed, "gamma": GAMMA, **self.settings(changes)}
        return ScriptModel(partial(self.function, make_env=make, **settings), trained.record)


@dataclass
class ScriptModel:
    """What a function trains, asked as the library's models are."""

    train: Callable[..., Any]
    record: Record
    policy, num_timesteps = None, 0

    def learn(self, steps: int, **_: Any) -> None:
        """Train for that many more steps, from the beginning."""
        self.num_timesteps += steps
        self.record.clear()
        agent = self.train(steps=self.num_timesteps)
        if not callable(getattr(agent, "act", None)):
            raise UserError("a script's function must return something with act(obs)")
        self._act, self.values = agent.act, getattr(agent, "values", None)

    def predict(self, observation: NDArray[Any], **_: Any) -> tuple[Any, None]:
        """The action at an observation."""
        return self._act(observation if observation.ndim else int(observation)), None


# --- trainings whose values are read --------------------------------------------------------------

MOST_DOUBLINGS = 3  # of a training whose values still change


class NotSettled(Exception):  # noqa: N818 (not an error)
    """Values after n and after 2n steps still differ at the largest number of steps."""


@dataclass
class Lab:
    """Trains one subject with one seed, and caches the values that have settled."""

    subject: Subject
    seed: int
    _values: dict[Any, Floats | None] = field(default_factory=dict)

    def begin(self, world: World, steps: int | None = None, **changes: Any) -> Trained:
        """Train for some steps."""
        trained = Trained(self.subject, world, self.seed, changes)
        trained.train(self.subject.steps if steps is None else steps)
        return trained

    def settled(self, world: World, **changes: Any) -> Floats:
        """The values of all states, shape (S,), once they no longer change.

        Raises:
            NotSettled: if they go on changing.
        """
        most = self.subject.steps * 2**MOST_DOUBLINGS
        known = {**self.subject.base, **self.subject.typed}
        changes = {name: value for name, value in changes.items() if known.get(name) != value}
        key = world, tuple(sorted(changes.items()))
        if key not in self._values:
            trained = self.begin(world, **changes)
            steps, values = self.subject.steps, trained.state_values()
            self._values[key] = None
            while self._values[key] is None and np.isfinite(values).all() and steps < most:
                trained.train(steps)
                before, steps, values = values, 2 * steps, trained.state_values()
                if np.abs(values - before).max() <= 0.05 * max(1.0, np.abs(values).max()):
                    self._values[key] = values
        if (found := self._values[key]) is None:
            raise NotSettled(f"values did not settle within {most:,} steps")
        return found

    def mean(self, world: World) -> tuple[Floats, float]:
        """Mean values in the second half of training, (S,), and action 1's share in the last state.

        For learners whose values depend on the actions taken, and so never settle.
        """
        trained, readings = self.begin(world), []
        n = 10 if isinstance(self.subject, ClassSubject) else 1  # a script trains from the start
        for _ in range(n):
            trained.train(self.subject.steps // n)
            readings.append(trained.state_values())
        counts = trained.record.counts()[-1]
        share = counts[1] / counts.sum() if counts.sum() else 0.5
        return np.mean(np.array(readings), axis=0), float(share)
