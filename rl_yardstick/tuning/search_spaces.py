"""Search spaces: read from files, sampled by Optuna, and inverted from settings to parameters.

``hyperparams/search_spaces/ALGO.yml`` maps environment ids to ranges and choices, see
`docs/tuning.md`. An environment's entry overrides ``default`` by name; null removes a name.

Each dimension of a space converts between its settings and the parameters that Optuna stores for
them. Settings are flat here: the name of a nested setting is dotted, as in
``policy_kwargs.net_arch``. A setting with the value `LEFT_OUT` is not given.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.trial import FixedTrial, Trial
from pydantic import ValidationError
from pydantic import dataclasses as checked

from rl_yardstick.agents import ALGORITHMS, load_algorithm
from rl_yardstick.experiments.pool import do_aside
from rl_yardstick.pipeline.components import PACKAGES, constructor_parameters
from rl_yardstick.pipeline.errors import UserError, shown, unknown
from rl_yardstick.pipeline.settings import COMPONENTS, HYPERPARAMS, SPECIAL, override, read_yaml
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.tuning.tuning_spec import SHIPPED

# The value that Optuna stores for a choice.
Word = str | int | float | bool | None
# A function that chooses a value for the parameter of this name.
Pick = Callable[[str, BaseDistribution], Any]
# By the name of another choice, the words of which one must be chosen there; empty for none.
Conditions = dict[str, tuple[Word, ...]]

Scale = Literal["linear", "log", "log_below_one", "powers_of_two"]
# The meaning of a number: a constant, or the start of a schedule.
FORMS = ("constant", "linear", "exponential")
LEFT_OUT = object()  # in place of a setting that is not given
_POINTS = 98  # over a range
_PREFIXES: Mapping[str, str] = {"log_below_one": "one_minus_", "powers_of_two": "log2_"}


@checked.dataclass(frozen=True)
class Range:
    """The numbers between two ends (integers if both are), with six digits for readable files."""

    low: int | float  #: included
    high: int | float  #: included
    scale: Scale = "linear"  #: of equal steps; on "powers_of_two" only these are values
    #: The range of an exponential schedule's end, as a share of its start.
    final_share: tuple[float, float] = (0.001, 1.0)

    def __post_init__(self) -> None:
        low, high, share = self.low, self.high, self.final_share
        if not -np.inf < low < high < np.inf:
            raise ValueError(f"low must be below high, and both finite: not {low} and {high}")
        if self.scale == "log" and low <= 0:
            raise ValueError(f"scale log needs low above 0, not {low}")
        if self.scale == "log_below_one" and high >= 1:
            raise ValueError(f"scale log_below_one needs high below 1, not {high}")
        powers = (isinstance(n, int) and n > 0 and n.bit_count() == 1 for n in (low, high))
        if self.scale == "powers_of_two" and not all(powers):
            raise ValueError("scale powers_of_two needs whole powers of two as low and high")
        if not 0 < share[0] < share[1] < np.inf:
            raise ValueError("final_share must be two numbers above 0, the smaller one first")
        if not (isinstance(low, int) and isinstance(high, int)):
            object.__setattr__(self, "low", float(low))
            object.__setattr__(self, "high", float(high))

    @cached_property
    def distribution(self) -> FloatDistribution | IntDistribution:
        """The distribution of Optuna's parameter for the number."""
        low, high = sorted((self.parameter(self.low), self.parameter(self.high)))
        is_log = self.scale in ("log", "log_below_one")
        if isinstance(low, int) and isinstance(high, int):
            return IntDistribution(low, high, log=is_log)
        return FloatDistribution(low, high, log=is_log)

    def parameter(self, number: float) -> float:
        """Convert a number to Optuna's parameter."""
        if self.scale == "log_below_one":
            return tidy(1.0 - number)
        return int(number).bit_length() - 1 if self.scale == "powers_of_two" else number

    def number(self, parameter: float) -> float:
        """Convert Optuna's parameter to a number."""
        if self.scale == "log_below_one":
            return round(1.0 - tidy(parameter), 12)
        if self.scale == "powers_of_two":
            return 1 << int(parameter)
        number = parameter if isinstance(parameter, int) else tidy(parameter)
        return min(max(number, self.low), self.high)


@checked.dataclass(frozen=True)
class Dimension:
    """A choice of values or of sets of settings, a number, or a number with words in its place."""

    name: str  #: of the setting, or of the choice of several settings
    options: dict[Word, dict[str, Any]]  #: the flat settings of each word
    #: The words of `FORMS` that a number may have, and its range; empty and None for a choice.
    forms: tuple[str, ...] = ()
    range: Range | None = None
    when: Conditions = field(default_factory=dict)

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """The names of its settings."""
        number = [] if self.range is None else [self.name]
        return tuple(dict.fromkeys([*number, *(key for o in self.options.values() for key in o)]))

    @property
    def words(self) -> tuple[Word, ...]:
        """What Optuna chooses from, before it chooses a number."""
        return (*self.forms, *self.options)

    @cached_property
    def _parameters(self) -> tuple[str, str, str]:
        """The names of its parameters: word, number, and share of the end."""
        if self.range is None:
            return self.name, "", ""
        prefix = _PREFIXES.get(self.range.scale, "")
        return f"{self.name}_form", prefix + self.name, f"{self.name}_final_share"

    @cached_property
    def distributions(self) -> dict[str, BaseDistribution]:
        """The distribution of each of its parameters."""
        word, number, share = self._parameters
        found: dict[str, BaseDistribution] = {}
        if len(self.words) > 1:
            found[word] = CategoricalDistribution(self.words)
        if self.range is not None:
            found[number] = self.range.distribution
        if self.range is not None and "exponential" in self.forms:
            found[share] = FloatDistribution(*self.range.final_share, log=True)
        return found

    def settings(self, pick: Pick) -> dict[str, Any]:
        """The chosen settings; calls ``pick`` only for the needed parameters."""
        ranges, (choice, number, share) = self.distributions, self._parameters
        word = pick(choice, ranges[choice]) if choice in ranges else self.words[0]
        if self.range is None or word not in self.forms:
            return self._decided(self.options[word])
        start = self.range.number(pick(number, ranges[number]))
        if word == "constant":
            return {self.name: start}
        if word == "linear":
            return {self.name: f"lin_{start}"}
        return {self.name: f"exp_{start}_{tidy(start * pick(share, ranges[share]))}"}

    def params_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters that give these settings; LookupError if there are none."""
        choice, number, share = self._parameters
        for option, given in self.options.items():
            if same(self._decided(given), self._decided(settings)):
                return {choice: option}
        form, start, end = read = _read(settings.get(self.name))
        if self.range is None or form is None:
            raise LookupError(self.name)
        params: dict[str, Any] = {choice: form} if choice in self.distributions else {}
        params[number] = self.range.parameter(start)
        if form == "exponential":
            params[share] = end / start
        if all(self._holds(name, value) for name, value in params.items()):
            again = self.settings(lambda name, _: params[name])[self.name]
            if _read(again) == read:
                return params
        raise LookupError(self.name)

    def _holds(self, param: str, value: Any) -> bool:
        kind = self.distributions.get(param)
        if isinstance(kind, FloatDistribution | IntDistribution):
            return bool(kind.low <= value <= kind.high)
        return isinstance(kind, CategoricalDistribution) and value in kind.choices

    def _decided(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        return {key: settings.get(key, LEFT_OUT) for key in self.keys}

    def including(self, settings: Mapping[str, Any]) -> Dimension:
        """This dimension, widened if necessary to include these settings."""
        added = self._decided(settings)
        value = added.get(self.name, LEFT_OUT)
        changes: list[dict[str, Any]] = [{}]
        form, start, end = _read(value)
        if self.range is not None and form is not None:
            forms = tuple(dict.fromkeys((*self.forms, form)))
            low, high = self.range.final_share
            share = end / start if form == "exponential" else low
            ends = {"low": min(self.range.low, start), "high": max(self.range.high, start)}
            changes.append({"forms": forms})
            with suppress(ValueError):
                shares = min(low, share), max(high, share)
                wider = replace(self.range, **ends, final_share=shares)  # type: ignore[arg-type]
                changes.append({"forms": forms, "range": wider})
        for each in changes:
            with suppress(LookupError, ValueError):
                found = replace(self, **each)
                found.params_of(settings)
                return found
        # The value itself as the word, if that is clearer for readers.
        speaks = all(is_word(option.get(self.name)) for option in self.options.values())
        word = value if speaks and is_word(value) and value not in self.words else SHIPPED
        return replace(self, options={**self.options, word: added})


def ends(distribution: BaseDistribution) -> list[Any]:
    """All words of a choice, or the ends of a range; of floats, also one between them."""
    if isinstance(distribution, CategoricalDistribution):
        return list(distribution.choices)
    assert isinstance(distribution, FloatDistribution | IntDistribution)
    low, high = distribution.low, distribution.high
    if isinstance(distribution, IntDistribution):
        return [low, high]
    steps = np.geomspace if distribution.log else np.linspace
    between = steps(low, high, _POINTS)[1]  # which is rarely a whole number
    return [low, tidy(between), high]


def tidy(number: float) -> float:
    """Round a number to six digits."""
    return float(f"{number:.6g}")


def _read(value: Any) -> tuple[str | None, float, float]:
    """Form, start and end of a number or schedule; no form for other values."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return "constant", value, value
    kind, *numbers = value.split("_") if isinstance(value, str) else [""]
    with suppress(ValueError, LookupError):
        form = {"lin": "linear", "exp": "exponential"}[kind]
        start, end = [*map(float, numbers), 0.0][:2]
        return form, start, end
    return None, 0.0, 0.0


def is_word(value: object) -> bool:
    """Whether Optuna can store the value in a choice."""
    return value is None or isinstance(value, str | int | float)


def same(first: object, second: object) -> bool:
    """Whether two values are the same setting: 1 equals 1.0 but not true; tuples equal lists."""
    return _comparable(first) == _comparable(second)


def _comparable(value: object) -> object:
    if isinstance(value, Mapping):
        return {key: _comparable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_comparable(item) for item in value]
    return (bool, value) if isinstance(value, bool) else value


# Settings that change the task, so that a search would choose the easiest task.
_TASK = ("env_kwargs", "eval_env_kwargs")


@dataclass(frozen=True)
class SearchSpace:
    """The search space of one agent on one environment."""

    entries: Mapping[str, Dimension]  #: dimensions by name, in the order of sampling
    #: The default values of the agent's settings; settings without one are left out.
    defaults: Mapping[str, Any]
    widened: tuple[str, ...] = ()  #: names of the dimensions that `including` widened

    @property
    def keys(self) -> tuple[str, ...]:
        """The names of the space's settings, nested ones dotted: ``policy_kwargs.net_arch``."""
        return tuple(dict.fromkeys(key for each in self.entries.values() for key in each.keys))

    @property
    def distributions(self) -> dict[str, BaseDistribution]:
        """The distributions of all Optuna parameters, including conditional ones."""
        every = self.entries.values()
        return {name: kind for each in every for name, kind in each.distributions.items()}

    def suggest(self, trial: Trial | FixedTrial) -> dict[str, Any]:
        """Sample settings, nested ones by dotted names; `merged` puts them into an entry.

        Samples a conditional parameter only if its conditions hold.
        """
        return self.chosen(trial._suggest)

    def chosen(self, pick: Pick) -> dict[str, Any]:
        """The settings of the parameters that ``pick`` chooses; see `suggest`."""
        words: dict[str, Any] = {}

        def noting(name: str, kind: BaseDistribution) -> Any:
            words[name] = pick(name, kind)
            return words[name]

        chosen: dict[str, Any] = {}
        for each in self.entries.values():
            if _is_there(each, words):
                chosen.update(each.settings(noting))
        return {key: value for key, value in chosen.items() if value is not LEFT_OUT}

    def including(self, settings: Mapping[str, Any]) -> tuple[SearchSpace, dict[str, Any]]:
        """The space, widened if necessary to include these settings; missing ones have defaults.

        Returns:
            The space, whose ``widened`` names the dimensions that were too narrow; and the
            parameters for which its `suggest` returns the settings.
        """
        flat = self.flat(settings)
        params: dict[str, Any] = {}
        entries, widened = dict(self.entries), list(self.widened)
        for name, each in self.entries.items():
            if _is_there(each, params):
                entries[name] = each.including(flat)
                params.update(entries[name].params_of(flat))
                widened += [name] if entries[name] != each else []
        return replace(self, entries=entries, widened=tuple(widened)), params

    def merged(self, shipped: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
        """The shipped entry of hyperparameters, changed by the settings that `suggest` returned.

        Removes settings of the space that are not in ``settings``, because their conditions do not
        hold.
        """
        kept = {key: value for key, value in shipped.items() if key not in self.keys}
        entry = override(kept, {key: value for key, value in settings.items() if "." not in key})
        for key in self.keys:
            outer, dot, inner = key.partition(".")
            if dot:
                given = entry.get(outer)
                others = dict(given) if isinstance(given, dict) else {}
                others.pop(inner, None)
                entry[outer] = others | ({inner: settings[key]} if key in settings else {})
        return {key: value for key, value in entry.items() if value != {}}

    def flat(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The values of an entry for the space's keys; missing settings have their defaults."""
        found = {}
        for key in self.keys:
            outer, _, inner = key.partition(".")
            value = settings.get(outer, LEFT_OUT)
            if inner:
                value = value.get(inner, LEFT_OUT) if isinstance(value, Mapping) else LEFT_OUT
            found[key] = self.defaults.get(key, LEFT_OUT) if value is LEFT_OUT else value
        return found


def _is_there(dimension: Dimension, chosen: Mapping[str, Any]) -> bool:
    """Whether a dimension's conditions hold under the chosen words."""
    return all(
        other in chosen and any(same(chosen[other], word) for word in words)
        for other, words in dimension.when.items()
    )


def corners(space: SearchSpace) -> Iterator[dict[str, Any]]:
    """Settings at the ends of the space: all low, all high, and each of `ends` separately."""
    values = {name: ends(kind) for name, kind in space.distributions.items()}
    lowest = {name: several[0] for name, several in values.items()}
    yield space.chosen(lambda name, _: lowest[name])
    yield space.chosen(lambda name, _: values[name][-1])
    for each in space.entries.values():
        needed = _needed(space, each)
        for name in each.distributions:
            for value in values[name]:
                params = {**lowest, **needed, name: value}
                yield space.chosen(lambda name, _: params[name])  # noqa: B023  # called at once


def _needed(space: SearchSpace, dimension: Dimension) -> dict[str, Any]:
    """Words that fulfil the conditions of a dimension, and the conditions of these."""
    needed: dict[str, Any] = {}
    for other, words in dimension.when.items():
        needed |= {other: words[0], **_needed(space, space.entries[other])}
    return needed


# --- reading from a file --------------------------------------------------------------------------

_RANGE = ("low", "high", "scale", "forms", "final_share")


def read_search_space(algo: str, env_id: str, path: Path | str | None = None) -> SearchSpace:
    """Read the search space of an agent on an environment; ``path`` is another file than its own.

    Raises UserError if the file cannot be read, is not of this format, or has nothing to search.
    Whether the agent takes its settings is for the agent to say, see `corners`.
    """
    path = HYPERPARAMS / "search_spaces" / f"{algo}.yml" if path is None else Path(path)
    if not path.is_file():
        raise UserError(f"{path}: there is no such file: name one with --search-space FILE")
    where, said = _entry(path, env_id)
    entries = {name: _dimension(name, value, f"{where}: {name}") for name, value in said.items()}
    if not entries:
        raise UserError(f"{where}: there is nothing to search for {algo}")
    _check(entries, where)
    return SearchSpace(entries, _defaults(algo))


def _entry(path: Path, env_id: str) -> tuple[str, dict[str, Any]]:
    """The place of an environment's entry, and the entry merged with the default."""
    file = read_yaml(path)
    entries = [*file.items()] if isinstance(file, dict) else []
    if (
        not all(isinstance(n, str) and isinstance(e, dict | type(None)) for n, e in entries)
        or not entries
    ):
        raise UserError(f"{path}: must map environment ids to names of settings and their ranges")
    if env_id not in file and "default" not in file:
        raise UserError(f"{path}: no entry for {shown(env_id)}, and no default")
    both = {**(file.get("default") or {}), **(file.get(env_id) or {})}
    where = f"{path}: {env_id if env_id in file else 'default'}"
    return where, {str(name): value for name, value in both.items() if value is not None}


def _dimension(name: str, said: Any, place: str) -> Dimension:
    """Read the value of a name: a list, or a mapping as described in `docs/tuning.md`."""
    said = {"choices": said} if isinstance(said, list) else said
    if not isinstance(said, dict):
        raise UserError(
            f"{place} must be a list of values, or map low and high, choices or sets to theirs; "
            f"not {shown(said)}"
        )
    kind = next((key for key in ("choices", "sets") if key in said), "forms")
    known = ("when", *((kind,) if kind != "forms" else _RANGE))
    for key in said:
        if key not in known:
            raise unknown(f"{place}: unknown key", str(key), known)
    options, when = said.get(kind, ["constant"]), said.get("when", {})
    if isinstance(options, list):
        if strange := [value for value in options if not is_word(value)]:
            example = "choices: {small: [64, 64]}"
            raise UserError(f"{place}: {shown(strange[0])} needs a name, as in {example}")
        options = {value: value for value in options}
    if not (isinstance(options, dict) and isinstance(when, dict)):
        raise UserError(f"{place}: {kind} must be a list or a mapping, and when a mapping")
    forms = tuple(word for word in options if kind == "forms" and word in FORMS)
    if kind == "forms" and not forms:
        raise UserError(f"{place}: forms must name one of {', '.join(FORMS)}")
    if kind != "forms" and len(options) < 2:
        raise UserError(f"{place}: there must be two values at least to choose from")
    words = {k: v if kind == "sets" else {name: v} for k, v in options.items() if k not in forms}
    conditions = {k: tuple(v) if isinstance(v, list) else (v,) for k, v in when.items()}
    numbers = {key: value for key, value in said.items() if key not in ("forms", "when")}
    try:
        limits = Range(**numbers) if kind == "forms" else None
        return Dimension(name, words, forms, limits, conditions)
    except ValidationError as error:
        first = error.errors()[0]
        key = f"{first['loc'][0]}: " if first["loc"] else ""
        reason = first["msg"].removeprefix("Value error, ")
        raise UserError(f"{place}: {key}{reason[:1].lower()}{reason[1:]}") from None


def _check(entries: Mapping[str, Dimension], where: str) -> None:
    """Check that no setting has two dimensions or changes the task, and the words of conditions."""
    deciders: dict[str, str] = {}
    before: dict[str, Dimension] = {}
    for name, each in entries.items():
        if task := [key for key in each.keys if key.partition(".")[0] in _TASK]:
            raise UserError(
                f"{where}: {task[0]} is what settings are judged on, and not searched: give it by "
                "--env-kwargs, or search train_env_kwargs"
            )
        decided = () if each.when else each.keys  # conditional ones may exclude each other
        for key in (*decided, *each.distributions):
            if (other := deciders.setdefault(key, name)) != name:
                raise UserError(f"{where}: {other} and {name} both decide {key}: leave one out")
        for other, words in each.when.items():
            place = f"{where}: {name}: when"
            if other not in before:
                raise unknown(f"{place}: no choice above it is called", other, before)
            options = before[other].options
            if strange := [str(word) for word in words if word not in options]:
                raise unknown(f"{place}: {other} has no value", strange[0], map(str, options))
        if each.range is None:
            before[name] = each


@cache
def _defaults(algo: str) -> Mapping[str, Any]:
    """The default values of an agent's settings, read by a worker, which has loaded PyTorch."""
    package = ALGORITHMS[algo].entry_point.partition(".")[0]
    is_known = package in PACKAGES and "torch" not in sys.modules
    return do_aside(_read_defaults, algo) if is_known else _read_defaults(algo)


def _read_defaults(algo: str) -> dict[str, Any]:
    algorithm = load_algorithm(algo)
    policies = algorithm.policy_aliases
    usual = next((name for name in policies if name.startswith("Mlp")), next(iter(policies), ""))
    defaults = {key: TrainSpec.model_fields[key].default for key in SPECIAL}
    defaults |= {**dict.fromkeys(COMPONENTS), "normalize": False}
    for prefix, cls in (("", algorithm), ("policy_kwargs.", policies.get(usual, object))):
        for name, parameter in constructor_parameters(cls).items():
            value = parameter.default
            if value is not parameter.empty:
                is_class = isinstance(value, type)
                defaults[prefix + name] = f"nn.{value.__name__}" if is_class else value
    return defaults
