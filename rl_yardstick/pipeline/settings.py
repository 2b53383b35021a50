"""Hyperparameters in rl_zoo3's format, read as data; `read_spec` makes a `TrainSpec` from them.

One YAML file per agent maps environment ids to entries. An entry holds arguments of the agent's
constructor, and the special keys of `SPECIAL`. Values are literals: nothing is evaluated, and the
names of classes are looked up among a few packages. A file may also list, under ``tuned_on``, the
seeds on which its entries were tuned.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from rl_yardstick.agents.registry import ALGORITHMS
from rl_yardstick.pipeline.arguments import arguments_of, check_arguments, check_keywords
from rl_yardstick.pipeline.errors import UserError, did_you_mean, shown, unknown
from rl_yardstick.pipeline.files import read_text
from rl_yardstick.pipeline.spec import TrainSpec

HYPERPARAMS = Path(__file__).resolve().parents[1] / "hyperparams"
TUNED_ON = "tuned_on"
BUDGETS = ("n_timesteps", "n_episodes")
COMPONENTS = ("env_wrapper", "train_env_wrapper", "vec_env_wrapper", "callback")
ENV_KWARGS = ("env_kwargs", "train_env_kwargs", "eval_env_kwargs")
_OTHERS = ("n_envs", "normalize", "frame_stack", "monitor_kwargs", "noise_type", "noise_std")
SPECIAL = (*BUDGETS, *COMPONENTS, *ENV_KWARGS, *_OTHERS)
# What rl_zoo3's files have and what is decided elsewhere here.
_SET_ELSEWHERE = {
    "action_noise": "noise_type and noise_std",
    "seed": "--seed",
    "device": "--device",
    "verbose": "--verbose",
    "tensorboard_log": "--tensorboard-log",
}
_ATARI_ID = re.compile(r"ALE/.*|.*NoFrameskip-v\d+")


# --- files ----------------------------------------------------------------------------------------


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Plain values only; the same key twice is a mistake."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys = [key.value for key, _ in node.value if key.value != "<<"]  # before they are merged
        found = super().construct_mapping(node, deep=deep)
        if len(set(keys)) < len(keys):
            twice = next(key for key in keys if keys.count(key) > 1)
            line = node.start_mark.line + 1
            raise yaml.YAMLError(f"line {line}: the key {shown(twice)} is there twice")
        return found


def read_yaml(path: Path) -> Any:
    """The plain values in a YAML file.

    Raises:
        UserError: if it cannot be read, or asks for objects.
    """
    return parse_yaml(read_text(path), str(path))


def parse_yaml(text: str, where: str) -> Any:
    """The plain values that a text in YAML spells."""
    try:
        return yaml.load(text, Loader=_Loader)  # noqa: S506  # a safe loader
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise UserError(f"{where} is no valid YAML: {' '.join(str(error).split())}") from error


def read_entries(path: Path) -> dict[str, Any]:
    """All entries of a file of hyperparameters, with ``tuned_on``."""
    if path.suffix == ".py":
        raise UserError(f"{path}: hyperparameters are read from YAML; Python files are not run")
    entries = read_yaml(path)
    if not (isinstance(entries, dict) and all(isinstance(key, str) for key in entries)):
        raise UserError(f"{path} must map environment ids to hyperparameters")
    return entries


def read_entry(
    algo: str, env_id: str, path: Path | None = None, env_kwargs: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The entry of an environment in ``hyperparams/<algo>.yml``, or in another file.

    Atari games without an entry use the entry ``atari``, all others ``default``. An agent without
    a file, such as the user's own, has an empty entry. If ``env_kwargs`` make the environment equal
    to another id, that id's entry is used: for CliffWalking-v1 with ``is_slippery: True``, the
    entry of CliffWalkingSlippery-v1.
    """
    if path is None and not (HYPERPARAMS / f"{algo}.yml").is_file():
        return {}
    path = path or HYPERPARAMS / f"{algo}.yml"
    entries = read_entries(path)
    key = _same_environment(entries, env_id, env_kwargs) or _key(entries, env_id)
    if key is None:
        hint = did_you_mean(env_id, entries, n=3)
        raise UserError(
            f"{path}: no entry for {shown(env_id)}{' (' + hint + ')' if hint else ''}; "
            "give hyperparameters with -params, or another file with --conf-file"
        )
    entry = entries[key]
    if not (isinstance(entry, dict) and all(isinstance(name, str) for name in entry)):
        raise UserError(f"{path}: the entry {key} must map names to values")
    return {name: _read_dict(value) for name, value in entry.items()}


def _key(entries: Mapping[str, Any], env_id: str) -> str | None:
    names = (env_id, "atari" if _ATARI_ID.fullmatch(env_id) else "default", "default")
    return next((name for name in names if name in entries), None)


def _same_environment(
    entries: Mapping[str, Any], env_id: str, env_kwargs: Mapping[str, Any] | None
) -> str | None:
    """The id of an entry that is registered as this environment with the same arguments."""
    from gymnasium import registry

    own = registry.get(env_id)
    if not env_kwargs or own is None:
        return None
    meant = own.entry_point, {**own.kwargs, **env_kwargs}, own.max_episode_steps
    named = (registry[name] for name in entries if name in registry)
    return next(
        (one.id for one in named if (one.entry_point, one.kwargs, one.max_episode_steps) == meant),
        None,
    )


def seeds_tuned_on(algo: str, env_id: str, path: Path | None = None) -> tuple[range, ...] | None:
    """The seeds on which an environment's entry was tuned; None if its file does not say."""
    shipped = HYPERPARAMS / f"{algo}.yml"
    if path is None and not shipped.is_file():
        return None
    entries = read_entries(path or shipped)
    if TUNED_ON not in entries:
        return () if path is None else None
    where = f"{path or shipped}: {TUNED_ON}"
    seeds = entries[TUNED_ON]
    try:
        given = seeds.get(_key(entries, env_id) or "", [])
        ranges = [
            (one["first"], one["count"]) for one in (given if type(given) is list else [given])
        ]
        return tuple(range(first, first + count) for first, count in ranges)
    except (AttributeError, LookupError, TypeError) as error:
        form = "entries to seeds such as {first: 0, count: 10}"
        raise UserError(f"{where} must map {form}") from error


def entry_names(algo: str) -> list[str]:
    """Ids of the environments with an entry in an agent's shipped file, in the file's order."""
    path = HYPERPARAMS / f"{algo}.yml"
    # Parsing all files would take seconds.
    text = read_text(path) if path.is_file() else ""
    names = re.findall(r"^([\w./-]+):", text, re.MULTILINE)
    return [name for name in names if name not in ("default", "atari", TUNED_ON)]


# --- what is typed --------------------------------------------------------------------------------


def parse_assignments(texts: Iterable[str], flag: str) -> dict[str, Any]:
    """The values of ``name:literal`` words, such as ``gamma:0.9 policy_kwargs:dict(...)``."""
    found: dict[str, Any] = {}
    words = list(texts)
    for place, text in enumerate(words):
        name, colon, value = text.partition(":")
        if not (colon and name.isidentifier() and value.strip()):
            hint = _meant(words[place:])
            raise UserError(f"{flag}: {shown(text)} is not of the form name:value{hint}")
        if name in found:
            raise UserError(f"{flag}: {shown(name)} is given twice")
        found[name] = literal(value)
    return found


def _meant(words: Sequence[str]) -> str:
    """A hint for ``name=value``, ``name value``, ``name = value`` and ``name: value``."""
    name, *others = [*words[0].split("=", 1), *words[1:3]]
    name = name.rstrip(":")
    value = next(filter(None, (other.lstrip("=") for other in others)), "")
    is_name = name.isidentifier() and value and ":" not in value
    return f": did you mean {name}:{value}?" if is_name else ""


def literal(text: str) -> Any:
    """The literal of Python or YAML that a text spells, also as ``dict(...)``; or else the text."""
    try:
        return _literal(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        pass
    # YAML has more literals, such as {a: 1}.
    if text.strip().startswith(("[", "{")):
        try:
            return parse_yaml(text, text)
        except UserError:
            pass
    return text


_YAML_WORDS = {"true": True, "false": False, "null": None}


def _literal(node: ast.expr) -> Any:
    if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "dict" and not node.args:
        return {str(word.arg): _literal(word.value) for word in node.keywords}
    if isinstance(node, ast.Name) and node.id in _YAML_WORDS:
        return _YAML_WORDS[node.id]
    if isinstance(node, ast.Attribute | ast.Name):  # nn.ReLU: looked up when it is needed
        return ast.unparse(node)
    if isinstance(node, ast.List | ast.Tuple):
        return [_literal(item) for item in node.elts]
    if isinstance(node, ast.Dict):
        pairs = zip(node.keys, node.values, strict=True)
        return {ast.literal_eval(key): _literal(value) for key, value in pairs if key}
    return ast.literal_eval(node)


def _read_dict(value: Any) -> Any:
    """rl_zoo3's files hold mappings as texts: ``"dict(norm_obs=False)"``."""
    return literal(value) if isinstance(value, str) and value.startswith(("dict(", "{")) else value


def override(entry: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Change an entry; a new budget replaces the old one, also in another unit."""
    gone = BUDGETS if any(name in changes for name in BUDGETS) else ()
    return {**{key: value for key, value in entry.items() if key not in gone}, **changes}


def training_follows(
    entry: Mapping[str, Any], typed: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, str]]:
    """Apply typed env_kwargs to training too; returns the entry, and notes for `origins`."""
    variant, own = entry.get("train_env_kwargs") or {}, typed.get("train_env_kwargs") or {}
    asked = typed.get("env_kwargs") or {}
    gone = {key: variant[key] for key in asked if key in variant and key not in own}
    if not gone:
        return dict(entry), {}
    told = ", ".join(f"{key}: {value}" for key, value in gone.items() if value != asked[key])
    kept = {key: value for key, value in variant.items() if key not in gone}
    how = f"without {told}, because typed env_kwargs apply to training too"
    return {**entry, "train_env_kwargs": kept}, {"train_env_kwargs": how} if told else {}


# --- specs ----------------------------------------------------------------------------------------


def check_agent(algo: str) -> None:
    """Raise UserError if there is no such agent, or a package that it needs is missing."""
    entry = ALGORITHMS.get(algo)
    if entry is None and algo.lower() == "her":
        raise UserError(
            "hindsight experience replay is no agent but a replay buffer, for environments with "
            "goals: --algo sac -params replay_buffer_class:HerReplayBuffer policy:MultiInputPolicy"
        )
    if entry is None:
        raise unknown("unknown agent", algo, ALGORITHMS)
    if not entry.is_installed:
        raise UserError(
            f"{algo} needs {entry.package}, which is not installed: {entry.install_command}"
        )


def read_spec(algo: str, env_id: str, entry: Mapping[str, Any], **fields: Any) -> TrainSpec:
    """The spec of an entry, with numbers in place of ``auto``.

    Args:
        algo: the agent.
        env_id: the environment, which is registered.
        entry: its hyperparameters.
        fields: other fields of `TrainSpec`.

    Raises:
        UserError: for an agent, a key or a value that does not exist or does not fit.
    """
    from rl_yardstick.pipeline.auto import resolved

    check_agent(algo)
    entry = {key: _read_dict(value) for key, value in entry.items() if value is not None}
    if all(entry.get(budget) is not None for budget in BUDGETS):
        raise UserError("give n_timesteps or n_episodes, not both")
    # Without noise_type, noise_std is an argument of some agents.
    keys = [key for key in SPECIAL if key != "noise_std" or "noise_type" in entry]
    special = {key: entry[key] for key in keys if key in entry}
    rest = {key: value for key, value in entry.items() if key not in keys}
    for key in rest:
        if key in _SET_ELSEWHERE:
            raise UserError(f"{key} is set by {_SET_ELSEWHERE[key]}, not here")
        if key not in arguments_of(algo):
            raise unknown(f"{algo} has no hyperparameter", key, [*arguments_of(algo), *SPECIAL])
    for key in COMPONENTS:
        special[key] = components(special.get(key), key)
    if isinstance(special.get("normalize"), bool):
        special["normalize"] = {} if special["normalize"] else None
    for key in ("normalize", "monitor_kwargs"):
        if special.get(key) is not None:
            special[key] = check_keywords(key, special[key])
    algorithm = check_arguments(algo, rest)
    if special.get("normalize") is not None and isinstance(algorithm.get("gamma"), float):
        # As in rl_zoo3, rewards are normalised with the agent's discount.
        special["normalize"].setdefault("gamma", algorithm["gamma"])
    found = {"algo": algo, "env_id": env_id, "algorithm": algorithm, **special, **fields}
    return resolved(found)


def components(value: Any, where: str) -> list[dict[str, Any]]:
    """Wrappers or callbacks in rl_zoo3's forms: a name, ``{name: kwargs}``, or a list of these."""
    found: list[dict[str, Any]] = []
    for item in value if isinstance(value, list) else [] if value is None else [value]:
        if isinstance(item, str):
            found.append({"name": item})
        elif isinstance(item, dict) and len(item) == 1:
            name, kwargs = next(iter(item.items()))
            found.append({"name": name, "kwargs": kwargs or {}})
        else:
            raise UserError(f"{where}: {shown(item)} is no class name with arguments")
    return found


# Settings of the task: a run's shipped settings are those for its own task.
_TASK = ("env_kwargs", "eval_env_kwargs", "env_wrapper")


def shipped_hyperparams(spec: TrainSpec) -> dict[str, Any]:
    """The shipped entry of a run's agent on its task; the run's own budget without an entry."""
    own = spec.hyperparams
    task = {key: own[key] for key in _TASK if key in own}
    entry: dict[str, Any] = {}
    with suppress(UserError):
        entry = read_entry(spec.algo, spec.env_id, env_kwargs=spec.env_kwargs)
    entry, _ = training_follows({k: v for k, v in entry.items() if k not in _TASK}, task)
    if not any(entry.get(key) for key in BUDGETS):
        entry |= {key: own[key] for key in BUDGETS if key in own}
    entry |= task
    with suppress(UserError):  # if an automatic value does not exist here
        return read_spec(spec.algo, spec.env_id, entry, gym_packages=spec.gym_packages).hyperparams
    return {key: value for key, value in entry.items() if not str(value).startswith("auto")}


class _SavedLoader(_Loader):
    """Also reads what rl_zoo3 writes into run folders: ordered mappings and tuples."""


def _mapping(loader: Any, node: Any) -> dict[str, Any]:
    ((pairs,),) = [loader.construct_sequence(node, deep=True)]
    return dict(pairs)


_PYTHON = "tag:yaml.org,2002:python"
_SavedLoader.add_constructor(f"{_PYTHON}/object/apply:collections.OrderedDict", _mapping)
_SavedLoader.add_constructor(
    f"{_PYTHON}/tuple", lambda loader, node: loader.construct_sequence(node, deep=True)
)


def read_saved(path: Path) -> dict[str, Any]:
    """The settings in a run folder of this project or of rl_zoo3."""
    try:
        found = yaml.load(read_text(path), Loader=_SavedLoader)  # noqa: S506  # a safe loader
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise UserError(f"{path} is no valid YAML: {' '.join(str(error).split())}") from error
    if not (isinstance(found, dict) and all(isinstance(key, str) for key in found)):
        raise UserError(f"{path} must map names to values")
    return {key: _read_dict(value) for key, value in found.items()}
