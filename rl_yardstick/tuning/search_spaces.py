"""Search spaces: read from files, sampled by Optuna, and inverted from settings to parameters.

``hyperparams/search_spaces/ALGO.yml`` maps environment ids to ranges and choices, see
`docs/search-spaces.md`. An environment's entry overrides ``default`` name by name; null removes a
name.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.trial import BaseTrial

from rl_yardstick.pipeline.errors import UserError, shown, unknown
from rl_yardstick.pipeline.models.load import agent_class
from rl_yardstick.pipeline.settings.components import default_policy
from rl_yardstick.pipeline.settings.hyperparams import (
    Hyperparams,
    check_algorithm_kwargs,
    override,
    split,
)
from rl_yardstick.pipeline.settings.values import (
    DottedName,
    algorithm_parameters,
    check_arguments,
    constructor_parameters,
    parse_literal,
)
from rl_yardstick.pipeline.settings.yaml import read_yaml
from rl_yardstick.tuning.dimensions import (
    FINAL_SHARE,
    FORMS,
    LEFT_OUT,
    Choice,
    Dimension,
    NumberRange,
    Pick,
    Scale,
    Word,
    is_word,
    same,
    spread,
)

# The number of points over a range for a check between its ends: the second is rarely an integer.
_PARTS = 98

_FOLDER = Path(__file__).resolve().parents[1] / "hyperparams" / "search_spaces"
# Settings that change the task, so that a search would choose the easiest task.
_TASK = ("env_kwargs", "eval_env_kwargs")
# The keys of each type of entry, and their types.
_RANGE: Mapping[str, Any] = {
    "low": float,
    "high": float,
    "scale": Scale,
    "forms": list[Any],
    "final_share": list[float],
    "when": dict[str, Any],
}
_CHOICE: Mapping[str, Any] = {"choices": dict[str, Any] | list[Any], "when": dict[str, Any]}
_SETS: Mapping[str, Any] = {"sets": dict[str, dict[str, Any]], "when": dict[str, Any]}


@dataclass(frozen=True)
class SearchSpace:
    """The search space of one agent on one environment."""

    entries: Mapping[str, Dimension]  #: dimensions by name, in the order of sampling
    #: The default values of settings; settings without one are left out.
    defaults: Mapping[str, Any]
    widened: tuple[str, ...] = ()  #: names of the dimensions that `including` widened

    @property
    def keys(self) -> tuple[str, ...]:
        """The names of the space's settings, nested ones dotted: ``policy_kwargs.net_arch``."""
        return tuple(dict.fromkeys(key for each in self.entries.values() for key in each.keys))

    def suggest(self, trial: BaseTrial) -> dict[str, Any]:
        """Sample settings in the form of hyperparameter files; `merged` puts them into an entry.

        Samples a conditional parameter only if its conditions hold. ``trial`` may be a FixedTrial.
        """
        return self._chosen(lambda name, ends: _ask(trial, name, ends))

    def at(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """The settings of parameters; parameters whose conditions do not hold are ignored."""
        return self._chosen(lambda name, _: params[name])

    def _chosen(self, pick: Pick) -> dict[str, Any]:
        words: dict[str, Any] = {}

        def noting(name: str, ends: BaseDistribution) -> Any:
            words[name] = pick(name, ends)
            return words[name]

        chosen: dict[str, Any] = {}
        for each in self.entries.values():
            if _is_there(each, words):
                chosen.update(each.settings(noting))
        nested: dict[str, Any] = {}
        for key, value in chosen.items():
            outer, _, inner = key.partition(".")
            if value is not LEFT_OUT:
                (nested.setdefault(outer, {}) if inner else nested)[inner or outer] = value
        return nested

    def distributions(self) -> dict[str, BaseDistribution]:
        """The distributions of all Optuna parameters, including conditional ones."""
        return {
            name: ends
            for each in self.entries.values()
            for name, ends in each.distributions.items()
        }

    def grid(self, n: int) -> dict[str, list[Any]]:
        """Grid values of each parameter: all words, or at most ``n`` numbers from end to end."""
        return {name: spread(ends, n) for name, ends in self.distributions().items()}

    def params_of(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The parameters for which `suggest` returns these settings; missing ones have defaults.

        Raises:
            UserError: if the settings lie outside the space, see `including`.
        """
        flat = self.flat(settings)
        params: dict[str, Any] = {}
        for each in self.entries.values():
            if not _is_there(each, params):
                continue
            try:
                params.update(each.params_of(flat))
            except LookupError as error:
                raise UserError(
                    f"{each.name}: the search space does not hold {shown(flat.get(each.name))}"
                ) from error
        return params

    def including(self, settings: Mapping[str, Any]) -> SearchSpace:
        """The space, widened if necessary to include these settings; see ``widened``."""
        flat = self.flat(settings)
        params: dict[str, Any] = {}
        entries, widened = dict(self.entries), list(self.widened)
        for name, each in self.entries.items():
            if not _is_there(each, params):
                continue
            entries[name] = each.including(flat)
            params.update(entries[name].params_of(flat))
            if entries[name] != each:
                widened.append(name)
        return replace(self, entries=entries, widened=tuple(widened))

    def merged(self, shipped: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
        """The shipped entry of hyperparameters, changed by the settings that `suggest` returned.

        Removes settings of the space that are not in ``settings``, because their conditions do not
        hold.
        """
        kept = _with_mappings(shipped, self.keys)
        for key in self.keys:
            outer, _, inner = key.partition(".")
            if inner and isinstance(kept.get(outer), dict):
                kept[outer] = {k: v for k, v in kept[outer].items() if k != inner}
            elif not inner:
                kept.pop(outer, None)
        changes = {
            key: {**kept[key], **value}
            if isinstance(value, dict) and isinstance(kept.get(key), dict)
            else value
            for key, value in settings.items()
        }
        return {key: value for key, value in override(kept, changes).items() if value != {}}

    def flat(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """The values of an entry for the space's keys; missing settings have their defaults."""
        given, found = _with_mappings(settings, self.keys), {}
        for key in self.keys:
            outer, _, inner = key.partition(".")
            value = given.get(outer, LEFT_OUT)
            if inner:
                value = value.get(inner, LEFT_OUT) if isinstance(value, Mapping) else LEFT_OUT
            found[key] = self.defaults.get(key, LEFT_OUT) if value is LEFT_OUT else value
        return found


def _with_mappings(settings: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """The settings; mappings that are written as texts are parsed if the keys are nested."""
    outer = {key.partition(".")[0] for key in keys if "." in key}
    return {
        key: _plain(parse_literal(value, key)) if key in outer and isinstance(value, str) else value
        for key, value in settings.items()
    }


def _plain(value: Any) -> Any:
    """Replace class names by texts, as in a file."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.name if isinstance(value, DottedName) else value


def _is_there(dimension: Dimension, chosen: Mapping[str, Any]) -> bool:
    """Whether a dimension's conditions hold under the chosen words."""
    return all(
        other in chosen and any(same(chosen[other], word) for word in words)
        for other, words in dimension.when.items()
    )


def _ask(trial: BaseTrial, name: str, kind: BaseDistribution) -> Any:
    match kind:
        case FloatDistribution():
            return trial.suggest_float(name, kind.low, kind.high, log=kind.log)
        case IntDistribution():
            return trial.suggest_int(name, kind.low, kind.high, log=kind.log)
        case CategoricalDistribution():
            return trial.suggest_categorical(name, kind.choices)
    raise TypeError(kind)


# Points of a space.


def corners(space: SearchSpace) -> Iterator[dict[str, Any]]:
    """Settings at the ends of the space: all low, all high, and each end or word separately."""
    lowest, highest = _ends(space)
    yield space.at(lowest)
    yield space.at(highest)
    yield from steps_aside(space, lowest)


def steps_aside(space: SearchSpace, params: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Settings that differ from those of the parameters in one end or word."""
    base = {**_ends(space)[0], **params}  # including parameters of other conditions
    for changed, values in space.grid(2).items():
        for value in values:
            yield _with_one(space, base, changed, value)


def _ends(space: SearchSpace) -> tuple[dict[str, Any], dict[str, Any]]:
    """The lowest and the highest parameters."""
    grid = space.grid(2)
    return {name: v[0] for name, v in grid.items()}, {name: v[-1] for name, v in grid.items()}


def _with_one(
    space: SearchSpace, params: Mapping[str, Any], changed: str, value: Any
) -> dict[str, Any]:
    """Settings of the parameters with one changed, and words that fulfil its conditions."""
    needed: dict[str, Any] = {}
    names = [name for name, each in space.entries.items() if changed in each.distributions]
    while names:
        for other, words in space.entries[names.pop()].when.items():
            needed[other] = words[0]
            names.append(other)
    return space.at({**params, **needed, changed: value})


# Reading from a file.


def read_search_space(algo: str, env_id: str, path: Path | str | None = None) -> SearchSpace:
    """Read the search space of an agent on an environment.

    Args:
        algo: the agent, whose file is ``hyperparams/search_spaces/<algo>.yml``.
        env_id: the environment; for ``envs:Warehouse-v0``, the part after the colon is used.
        path: another file to read.

    Raises:
        UserError: if the file cannot be read, is not of this format, has nothing to search, or
            has settings that the agent refuses.
    """
    path = _FOLDER / f"{algo}.yml" if path is None else Path(path)
    if not path.is_file():
        raise UserError(f"{path}: there is no such file: name one with --search-space FILE")
    where, said = _entry(path, env_id.partition(":")[2] or env_id)
    entries = {name: _dimension(name, value, f"{where}: {name}") for name, value in said.items()}
    if not entries:
        raise UserError(f"{where}: there is nothing to search for {algo}")
    _check_names(entries, where)
    _check_conditions(entries, where)
    space = SearchSpace(entries, {})
    known = _defaults(algo)
    space = replace(space, defaults={key: known[key] for key in space.keys if key in known})
    for settings in corners(space):
        _check_settings(algo, settings, where)
    for name, kind in space.distributions().items():  # also between the ends
        if isinstance(kind, FloatDistribution):
            between = _with_one(space, _ends(space)[0], name, spread(kind, _PARTS)[1])
            try:
                _check_settings(algo, between, where)
            except UserError as error:
                raise UserError(f"{error}: write low and high without a point") from error
    return space


def _entry(path: Path, env_id: str) -> tuple[str, dict[str, Any]]:
    """The place of an environment's entry, and the entry merged with the default."""
    file = read_yaml(path)
    for name, entry in file.items() if isinstance(file, dict) else [("", None)]:
        is_entry = isinstance(entry, dict) and all(isinstance(key, str) for key in entry)
        if not (isinstance(name, str) and (is_entry or entry is None)) or not name:
            raise UserError(
                f"{path}: must map environment ids to names of settings and their ranges"
            )
    if env_id not in file and "default" not in file:
        raise UserError(f"{path}: no entry for {shown(env_id)}, and no default")
    both = {**(file.get("default") or {}), **(file.get(env_id) or {})}
    where = f"{path}: {env_id if env_id in file else 'default'}"
    return where, {name: value for name, value in both.items() if value is not None}


def _dimension(name: str, said: Any, place: str) -> Dimension:
    """Read the value of a name: a list, or a mapping as described in `docs/search-spaces.md`."""
    if isinstance(said, list):
        said = {"choices": said}
    if not isinstance(said, dict):
        raise UserError(
            f"{place} must be a list of values, or map low and high, choices or sets to theirs; "
            f"not {shown(said)}"
        )
    known = _CHOICE if "choices" in said else _SETS if "sets" in said else _RANGE
    parameters = {
        key: inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, annotation=annotation)
        for key, annotation in known.items()
    }
    checked = check_arguments(said, parameters, place, "key")
    when = {other: _words(said, place) for other, said in checked.get("when", {}).items()}
    if known is _RANGE:
        ends = {end: said[end] for end in ("low", "high") if isinstance(said.get(end), int)}
        # A range has integers if both ends are written as integers.
        whole = ends if len(ends) == 2 else {}
        return replace(_number_range(name, {**checked, **whole}, place), when=when)
    options = checked["sets"] if known is _SETS else _options(name, checked["choices"], place)
    if len(options) < 2:
        raise UserError(f"{place}: there must be two values at least to choose from")
    return Choice(name, options, when)


def _words(said: Any, place: str) -> tuple[Word, ...]:
    words = said if isinstance(said, list) else [said]
    for word in words:
        if not is_word(word):
            raise UserError(f"{place}: when names values of another choice, not {shown(word)}")
    return tuple(words)


def _options(name: str, choices: Any, place: str) -> dict[Word, dict[str, Any]]:
    if isinstance(choices, dict):
        return {word: {name: value} for word, value in choices.items()}
    for value in choices:
        if not is_word(value):
            raise UserError(
                f"{place}: {shown(value)} needs a name, as in choices: {{small: [64, 64]}}"
            )
    return {value: {name: value} for value in choices}


def _number_range(name: str, checked: Mapping[str, Any], place: str) -> NumberRange:
    for end in ("low", "high"):
        if end not in checked:
            raise UserError(f"{place}: {end} is missing")
    low, high, scale = checked["low"], checked["high"], checked.get("scale", "linear")
    if not -math.inf < low < high < math.inf:
        raise UserError(
            f"{place}: low must be below high, and both finite: not {shown(low)} and {shown(high)}"
        )
    if scale in {"log", "powers_of_two"} and low <= 0:
        raise UserError(f"{place}: scale {scale} needs low above 0, not {shown(low)}")
    if scale == "log_below_one" and high >= 1:
        raise UserError(f"{place}: scale {scale} needs high below 1, not {shown(high)}")
    are_powers = (isinstance(end, int) and end.bit_count() == 1 for end in (low, high))
    if scale == "powers_of_two" and not all(are_powers):
        raise UserError(f"{place}: scale {scale} needs whole powers of two as low and high")
    forms = checked.get("forms", ["constant"])
    if not any(isinstance(form, str) and form in FORMS for form in forms):
        raise UserError(f"{place}: forms must name one of {', '.join(FORMS)}, and what else may be")
    for form in forms:
        if not is_word(form):
            raise UserError(f"{place}: forms are words and single values, not {shown(form)}")
    share = tuple(checked.get("final_share", FINAL_SHARE))
    if len(share) != 2 or not 0 < share[0] < share[1] < math.inf:
        raise UserError(f"{place}: final_share must be two numbers above 0, the smaller one first")
    own = tuple(form for form in forms if form in FORMS)
    instead = {form: form for form in forms if form not in FORMS}
    return NumberRange(name, low, high, scale, own, (share[0], share[1]), instead)


def _check_names(entries: Mapping[str, Dimension], where: str) -> None:
    """Check that no setting has two dimensions, and that none changes the task."""
    deciders: dict[str, str] = {}
    for name, each in entries.items():
        task = next((key for key in each.keys if key.partition(".")[0] in _TASK), None)
        if task is not None:
            raise UserError(
                f"{where}: {task} is what settings are judged on, and not searched: give it by "
                "--env-kwargs, or search train_env_kwargs"
            )
        decided = () if each.when else each.keys  # conditional ones may exclude each other
        for key in (*decided, *each.distributions):
            other = deciders.setdefault(key, name)
            if other != name:
                raise UserError(f"{where}: {other} and {name} both decide {key}: leave one out")


def _check_conditions(entries: Mapping[str, Dimension], where: str) -> None:
    """Check that conditions name earlier choices, and existing words of these."""
    before: dict[str, Choice] = {}
    for name, each in entries.items():
        for other, words in each.when.items():
            place = f"{where}: {name}: when"
            if other not in before:
                raise unknown(f"{place}: no choice above it is called", other, before)
            options = before[other].options
            strange = next((word for word in words if word not in options), None)
            if strange is not None:
                raise unknown(f"{place}: {other} has no value", str(strange), map(str, options))
        if isinstance(each, Choice):
            before[name] = each


def _check_settings(algo: str, settings: Mapping[str, Any], where: str) -> None:
    """Check that an agent accepts settings, by names, types and bounds."""
    parameters = algorithm_parameters(agent_class(algo))
    check_algorithm_kwargs(split(settings, where).algorithm, parameters, where)


def _defaults(algo: str) -> dict[str, Any]:
    """The default values of an agent's settings, as far as there are defaults."""
    algorithm = agent_class(algo)
    policy = algorithm.policy_aliases.get(default_policy(algorithm, is_dict=False), object)
    return {
        **{key.name: key.default for key in fields(Hyperparams) if "wrapper" not in key.name},
        **dict.fromkeys(("env_wrapper", "train_env_wrapper", "vec_env_wrapper", "callback")),
        "normalize": False,
        **_argument_defaults(algorithm_parameters(algorithm), ""),
        **_argument_defaults(constructor_parameters(policy), "policy_kwargs."),
    }


def _argument_defaults(parameters: Mapping[str, inspect.Parameter], prefix: str) -> dict[str, Any]:
    return {
        prefix + name: f"nn.{p.default.__name__}" if isinstance(p.default, type) else p.default
        for name, p in parameters.items()
        if p.default is not p.empty
    }
