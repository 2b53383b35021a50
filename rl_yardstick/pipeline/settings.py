"""Hyperparameters in rl_zoo3's format, read as data; `read_spec` makes a `TrainSpec` from them.

One YAML file per agent maps environment ids to entries. An entry holds arguments of the agent's
constructor, and the special keys of `SPECIAL`. Values are literals: nothing is evaluated, and the
names of classes are looked up among a few packages. A file may also list, under ``tuned_on``, the
seeds on which its entries were tuned.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterable, Mapping
from contextlib import closing, suppress
from copy import deepcopy
from functools import cache, lru_cache, reduce
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from rl_yardstick.agents.own_classes import SMALLEST, fault_of
from rl_yardstick.agents.registry import ALGORITHMS
from rl_yardstick.envs.known_models import time_limit, transition_model
from rl_yardstick.pipeline import components, environments
from rl_yardstick.pipeline.errors import UserError, as_user_error, shown, unknown
from rl_yardstick.pipeline.files import read_text
from rl_yardstick.pipeline.spec import TrainSpec, validated

HYPERPARAMS = Path(__file__).resolve().parents[1] / "hyperparams"
TUNED_ON = "tuned_on"
BUDGETS = ("n_timesteps", "n_episodes")
COMPONENTS = ("env_wrapper", "train_env_wrapper", "vec_env_wrapper", "callback")
ENV_KWARGS = ("env_kwargs", "train_env_kwargs", "eval_env_kwargs")
_OTHERS = ("n_envs", "normalize", "frame_stack", "monitor_kwargs", "noise_type", "noise_std")
SPECIAL = (*BUDGETS, *COMPONENTS, *ENV_KWARGS, *_OTHERS)
_ATARI_ID = re.compile(r"ALE/.*|.*NoFrameskip-v\d+")


# --- files ----------------------------------------------------------------------------------------


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Plain values, and rl_zoo3's ordered mappings and tuples; no key may be there twice."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys = [key.value for key, _ in node.value if key.value != "<<"]  # before they are merged
        found = super().construct_mapping(node, deep=deep)
        if len(set(keys)) < len(keys):
            twice = next(key for key in keys if keys.count(key) > 1)
            line = node.start_mark.line + 1
            raise yaml.YAMLError(f"line {line}: the key {shown(twice)} is there twice")
        return found


_PYTHON = "tag:yaml.org,2002:python"
_Loader.add_constructor(
    f"{_PYTHON}/tuple", lambda loader, node: loader.construct_sequence(node, deep=True)
)
_Loader.add_constructor(
    f"{_PYTHON}/object/apply:collections.OrderedDict",
    lambda loader, node: dict(loader.construct_sequence(node, deep=True)[0]),
)


def read_yaml(path: Path) -> Any:
    """The plain values in a YAML file; UserError if it cannot be read, or asks for objects."""
    return deepcopy(parse_yaml(read_text(path), str(path)))


@lru_cache  # a file is read for each agent, environment and trial
def parse_yaml(text: str, where: str) -> Any:
    """The plain values that a text in YAML spells."""
    kinds = yaml.YAMLError, ValueError, TypeError, RecursionError
    with as_user_error(f"{where} is no valid YAML", *kinds):
        return yaml.load(text, Loader=_Loader)  # noqa: S506  # a safe loader


def _check_names(found: Any, words: str) -> dict[str, Any]:
    """The value, which must be a mapping of names."""
    if not (isinstance(found, dict) and all(isinstance(key, str) for key in found)):
        raise UserError(words)
    return found


def read_saved(path: Path) -> dict[str, Any]:
    """The settings in a run folder of this project or of rl_zoo3."""
    found = _check_names(read_yaml(path), f"{path} must map names to values")
    return {key: _read_dict(value) for key, value in found.items()}


def _read_file(algo: str, path: Path | None) -> dict[str, Any] | None:
    """All entries of an agent's shipped file, or of another one; None if none is shipped."""
    path = path or HYPERPARAMS / f"{algo}.yml"
    if path.parent == HYPERPARAMS and not path.is_file():
        return None
    if path.suffix == ".py":
        raise UserError(f"{path}: hyperparameters are read from YAML; Python files are not run")
    return _check_names(read_yaml(path), f"{path} must map environment ids to hyperparameters")


def read_entry(
    algo: str, env_id: str, path: Path | None = None, env_kwargs: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The entry of an environment in ``hyperparams/<algo>.yml``, or in another file.

    Atari games without an entry use the entry ``atari``, all others ``default``; an agent without
    a file an empty one. If ``env_kwargs`` make the environment equal to another id, that id's entry
    is used: for CliffWalking-v1 with ``is_slippery: True``, the entry of CliffWalkingSlippery-v1.
    Another file may also be a single entry, or the parameters of a trial; see `from_trial`.
    """
    if (entries := _read_file(algo, path)) is None:
        return {}
    key, own = _key(entries, env_id), gym.registry.get(env_id)
    path = path or HYPERPARAMS / f"{algo}.yml"
    if env_kwargs and own is not None:
        meant = own.entry_point, {**own.kwargs, **env_kwargs}, own.max_episode_steps
        named = [gym.registry[name] for name in entries if name in gym.registry]
        same = [s.id for s in named if (s.entry_point, s.kwargs, s.max_episode_steps) == meant]
        key = same[0] if same else key
    if key is None and not {*components.arguments_of(algo), *SPECIAL}.isdisjoint(entries):
        with as_user_error(f"{path}: these are no hyperparameters", TypeError, LookupError):
            return from_trial(algo, entries)  # one without an id, as in rl_zoo3's config.yml
    if key is None:
        way_out = "give hyperparameters with -params, or another file with --conf-file"
        raise UserError(f"{unknown(f'{path}: no entry for', env_id, entries, n=3)}; {way_out}")
    entry = _check_names(entries[key], f"{path}: the entry {key} must map names to values")
    return {name: _read_dict(value) for name, value in entry.items()}


def _key(entries: Mapping[str, Any], env_id: str) -> str | None:
    names = (env_id, "atari" if _ATARI_ID.fullmatch(env_id) else "default", "default")
    return next((name for name in names if name in entries), None)


def seeds_tuned_on(algo: str, env_id: str, path: Path | None = None) -> tuple[range, ...] | None:
    """The seeds on which an environment's entry was tuned; None if its file does not say."""
    entries = _read_file(algo, path)
    if entries is None or TUNED_ON not in entries:
        return None if entries is None or path is not None else ()
    try:
        given = entries[TUNED_ON].get(_key(entries, env_id) or "", [])
        ranges = given if type(given) is list else [given]
        return tuple(range(one["first"], one["first"] + one["count"]) for one in ranges)
    except (AttributeError, LookupError, TypeError) as error:
        form = "must map entries to seeds such as {first: 0, count: 10}"
        raise UserError(f"{path or algo}: {TUNED_ON} {form}") from error


@cache
def entry_names(algo: str) -> list[str]:
    """Ids of the environments with an entry in an agent's shipped file, in the file's order."""
    path = HYPERPARAMS / f"{algo}.yml"
    # Parsing all files would take seconds.
    text = read_text(path) if path.is_file() else ""
    names = re.findall(r"^([\w./-]+):", text, re.MULTILINE)
    return [name for name in names if name not in ("default", "atari", TUNED_ON)]


# --- trials of rl_zoo3 ----------------------------------------------------------------------------

_WIDTHS = {"tiny": [64], "small": [64, 64], "medium": [256, 256], "big": [400, 300]}
_WIDTHS |= {"large": [256, 256, 256], "verybig": [512, 512, 512]}
_ACTIVATIONS = {"tanh": "nn.Tanh", "relu": "nn.ReLU", "elu": "nn.ELU", "leaky_relu": "nn.LeakyReLU"}
_INSIDE = {
    "policy_kwargs": "net_arch activation_fn ortho_init log_std_init sde_net_arch n_quantiles "
    "lstm_hidden_size enable_critic_lstm",
    "replay_buffer_kwargs": "n_sampled_goal goal_selection_strategy",
}
_WITH_TWO_NETWORKS = ("ppo", "ppo_lstm", "ppo_mask", "trpo", "a2c")
# What the first versions, which sampled gamma itself, set without sampling it.
_UNSAMPLED: Mapping[str, dict[str, Any]] = {
    **{algo: {"ortho_init": False} for algo in ("ppo", "ppo_lstm", "trpo")},
    **{algo: {"ent_coef": "auto", "target_entropy": "auto"} for algo in ("sac", "tqc")},
}


def from_trial(algo: str, params: Mapping[str, Any]) -> dict[str, Any]:
    """The hyperparameters of the parameters that rl_zoo3's search samples, in any of its versions.

    Others are left as they are, so a whole entry comes out as it is. Raises UserError for a word
    that rl_zoo3 does not have.
    """
    found = _decoded(params)
    if algo in _WITH_TWO_NETWORKS and isinstance(found.get("net_arch"), list):
        found["net_arch"] = {"pi": found["net_arch"], "vf": found["net_arch"]}
    is_old = "gamma" in params and "net_arch" in params
    if is_old and algo in _UNSAMPLED:
        found = {**_UNSAMPLED[algo], **found}
    if is_old and "n_steps" in found and "batch_size" in found:
        found["batch_size"] = min(found["batch_size"], found["n_steps"])
    if "net_arch" in params and "train_freq" in found:
        n_updates = max(found["train_freq"] // found.pop("subsample_steps", 1), 1)
        found.setdefault("gradient_steps", n_updates)
    if "top_frac_size" in found:
        found["n_top"] = max(int(found.pop("top_frac_size") * found["n_delta"]), 1)
    if found.pop("lr_schedule", "constant") == "linear":
        found["learning_rate"] = f"lin_{found['learning_rate']}"
    if found.get("noise_type", "") is None:
        found = {key: value for key, value in found.items() if key[:6] != "noise_"}
    for outer, names in _INSIDE.items():
        if inner := {name: found.pop(name) for name in names.split() if name in found}:
            found[outer] = {**(found.get(outer) or {}), **inner}
    return found


def _decoded(params: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters with their words, powers and differences replaced by values."""
    found = {name: _read_dict(value) for name, value in params.items()}
    for name, value in params.items():
        is_rest, is_power = name.startswith("one_minus_"), name.endswith("_pow")
        if is_rest or is_power:
            if not (isinstance(value, int | float) and 0 <= value < 64):
                raise UserError(f"{name}: must be a number from 0 to 63, not {shown(value)}")
            short = name.removeprefix("one_minus_").removesuffix("_pow")
            found[short] = 1 - found.pop(name) if is_rest else 2 ** found.pop(name)
    for name, table in (("net_arch", _WIDTHS), ("activation_fn", _ACTIVATIONS)):
        if isinstance(word := found.get(name), str):
            if word not in table:
                raise unknown(f"a trial of rl_zoo3 has no {name}", word, table)
            found[name] = table[word]
    return found


# --- what is typed --------------------------------------------------------------------------------


def parse_assignments(texts: Iterable[str], flag: str) -> dict[str, Any]:
    """The values of ``name:literal`` words, such as ``gamma:0.9 policy_kwargs:dict(...)``."""
    found: dict[str, Any] = {}
    for text in texts:
        name, colon, value = text.partition(":")
        if not (colon and name.isidentifier() and value.strip()):
            hint = f": did you mean {text.replace('=', ':', 1)}?" if "=" in text else ""
            raise UserError(f"{flag}: {shown(text)} is not of the form name:value{hint}")
        if name in found:
            raise UserError(f"{flag}: {shown(name)} is given twice")
        found[name] = literal(value)
    return found


def literal(text: str) -> Any:
    """The literal of Python or YAML that a text spells, also as ``dict(...)``; or else the text."""
    with suppress(SyntaxError, ValueError, RecursionError, MemoryError):
        return _literal(ast.parse(text.strip(), mode="eval").body)
    if text.strip().startswith(("[", "{")):  # YAML has more literals, such as {a: 1}
        with suppress(UserError):
            return deepcopy(parse_yaml(text, text))
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


def layered(settings: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with ``changes`` applied; arguments of environments are merged one by one."""
    merged = {
        key: {**settings[key], **changes[key]}
        for key in ENV_KWARGS
        if isinstance(settings.get(key), dict) and isinstance(changes.get(key), dict)
    }
    return override(settings, {**changes, **merged})


def changed_entry(
    algo: str, env_id: str, path: Path | None, *changes: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, str]]:
    """The entry of `read_entry` with ``changes`` in their order, and notes for `origins`.

    Changes stand alone if the agent's own file has no entry.
    """
    entry, own = dict[str, Any](), reduce(layered, changes, dict[str, Any]())
    try:
        entry = read_entry(algo, env_id, path, own.get("env_kwargs"))
    except UserError:
        if path is not None or not own:
            raise
    return training_follows(reduce(layered, changes, entry), own)


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
    module, _, name = algo.rpartition(".") if entry is None else entry.entry_point.partition(":")
    cls = getattr(sys.modules.get(module), name, None)  # imported already if it is the user's
    if cls is not None and (fault := fault_of(cls)):
        what = algo if entry is None else f"{algo}: {entry.entry_point}"
        raise UserError(f"{what} {fault}", SMALLEST if isinstance(cls, type) else "")
    if entry is None:
        raise unknown("unknown agent", algo, ALGORITHMS)
    if not entry.is_installed:
        fault = f"{entry.package}, which is not installed: {entry.install_command}"
        raise UserError(f"{algo} needs {fault}")


def special_settings(entry: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a spec that the special keys of an entry give."""
    special = {key: entry[key] for key in SPECIAL if entry.get(key) is not None}
    for key in COMPONENTS:
        special[key] = _components(special.get(key), key)
    if isinstance(special.get("normalize"), bool):
        special["normalize"] = {} if special["normalize"] else None
    return special


def _components(value: Any, where: str) -> list[dict[str, Any]]:
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


def read_spec(algo: str, env_id: str, entry: Mapping[str, Any], **fields: Any) -> TrainSpec:
    """The spec of an entry, with files read and numbers for ``auto``; its ``origins`` tell how.

    ``fields`` are other fields of `TrainSpec`. Raises UserError for an agent, a key or a value that
    does not exist or does not fit.
    """
    check_agent(algo)
    entry = {key: _read_dict(value) for key, value in entry.items() if value is not None}
    fields = {"map_name": environments.map_name(env_id, entry), **fields}
    entry = environments.with_files_read(env_id, entry)
    if all(budget in entry for budget in BUDGETS):
        raise UserError("give n_timesteps or n_episodes, not both")
    special = special_settings(entry)
    if "noise_type" not in entry:  # then noise_std is an argument of some agents
        special.pop("noise_std", None)
    rest = {key: value for key, value in entry.items() if key not in special}
    known = components.arguments_of(algo)
    for key in rest:
        if key in components.SET_ELSEWHERE:
            raise UserError(f"{key} is set by {components.SET_ELSEWHERE[key]}, not here")
        if key not in known:
            raise unknown(f"{algo} has no hyperparameter", key, [*known, *SPECIAL])
    for key in components.WRAPPERS:
        if special.get(key) is not None:
            special[key] = components.check_arguments(key, special[key], f"{key}: ")
    algorithm = components.check_arguments(algo, rest)
    if special.get("normalize") is not None and isinstance(algorithm.get("gamma"), float):
        # As in rl_zoo3, rewards are normalised with the agent's discount.
        special["normalize"].setdefault("gamma", algorithm["gamma"])
    asked = [key for key in components.AUTO if algorithm.get(key) == "auto"]
    plain = {key: value for key, value in algorithm.items() if key not in asked}
    if str(special.get("n_timesteps")).startswith("auto"):
        asked.insert(0, str(special.pop("n_timesteps")))
    code = components.digests_of(fields.get("gym_packages", ()), algo, env_id)
    found = {"algo": algo, "env_id": env_id, "algorithm": plain, "code": code}
    found |= {**special, **fields}
    spec = validated(found)
    if any("auto" in wrapper.kwargs.values() for wrapper in spec.train_env_wrapper):
        spec = _with_rewards(spec)
    if asked:
        spec = _with_numbers(spec, asked)
    if not (spec.n_timesteps or spec.n_episodes):
        raise UserError("the training has no budget: give -n STEPS or --n-episodes N")
    return spec


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


# --- the values of ``auto``, which follow from the environment's size and rewards ----------------

# With gamma, a reward one time limit ahead has the weight 0.6.

STEPS_PER_PAIR, FEWEST_PAIRS = 2500, 100  # training steps per state and action
VISITS_AVERAGED = 10  # a step size of 1 / n averages over about the last n visits
FIRST_STEP_SIZE, LAST_STEP_SIZES = 0.3, (0.003, 0.05)
_STEPS = re.compile(r"auto(?:_([1-9]\d{0,8}))?")


def _with_numbers(spec: TrainSpec, asked: list[str]) -> TrainSpec:
    """Settings of tables, from the evaluation environment."""
    environments.check_fit(spec)
    where, n_timesteps = f"{spec.algo} on {spec.env_id}", spec.n_timesteps
    origins, algorithm = dict(spec.origins), dict(spec.algorithm)
    with closing(environments.make_single_env(spec)) as env:
        spaces = env.observation_space, env.action_space
        counts = [int(space.n) for space in spaces if isinstance(space, gym.spaces.Discrete)]
        if len(counts) < 2:
            raise UserError(f"{where}: auto needs Discrete observations and actions")
        n_pairs = counts[0] * counts[1]
        for key in asked:
            if key.startswith("auto"):
                if (match := _STEPS.fullmatch(key)) is None:
                    form = "auto, or auto_1000 with the steps for each pair of state and action"
                    raise UserError(f"n_timesteps: {key!r} is not {form}")
                per_pair, pairs = int(match[1] or STEPS_PER_PAIR), max(n_pairs, FEWEST_PAIRS)
                n_timesteps = per_pair * pairs
                size = "{:,} states and {:,} actions".format(*counts)
                least = f", counted as {pairs} pairs" if pairs > n_pairs else ""
                origins["n_timesteps"] = f"auto: {per_pair:,} for each pair of {size}{least}"
            elif key == "gamma":
                if (limit := time_limit(env)) is None:
                    raise UserError(f"{where}: gamma: auto needs an environment with a time limit")
                algorithm[key] = round(1 - 1 / (2 * limit), 7)
                origins[key] = f"auto: 1 - 1/(2 x time limit of {limit:,})"
            elif key == "learning_rate":
                low, high = LAST_STEP_SIZES
                last = VISITS_AVERAGED * n_pairs / n_timesteps if n_timesteps else high
                algorithm[key] = f"exp_{FIRST_STEP_SIZE:g}_{min(max(last, low), high):.2g}"
                rule = f"ends at {VISITS_AVERAGED} x states x actions / steps"
                origins[key] = f"auto: {rule}, within {low} and {high}" if n_timesteps else "auto"
            else:
                model = transition_model(env)
                if model is None or not (ends := model.terminated & (model.prob > 0)).any():
                    needed = "a known model whose episodes can end"
                    raise UserError(f"{where}: {key}: auto needs {needed}")
                algorithm[key] = float(model.reward[ends].max())
                origins[key] = "auto: the highest reward that ends an episode"
    return spec.changed(n_timesteps=n_timesteps, algorithm=algorithm, origins=origins)


def _with_rewards(spec: TrainSpec) -> TrainSpec:
    """The arguments of training wrappers, from the rewards that reach them."""
    wrappers, told = list(spec.train_env_wrapper), []
    for place, wrapper in enumerate(wrappers):
        kwargs = dict(wrapper.kwargs)
        for key in [key for key in ("scale", "min_reward") if kwargs.get(key) == "auto"]:
            inner = spec.changed(train_env_wrapper=wrappers[:place])
            with closing(environments.make_single_env(inner, training=True)) as env:
                model = transition_model(env)
            if model is None:
                raise UserError(f"{spec.env_id}: {key}: auto needs an environment with a model")
            rewards = model.reward[model.prob > 0]
            low, high = float(rewards.min()), float(rewards.max())
            largest = max(-low, high)
            if key == "scale":
                kwargs[key], how = 1 / largest if largest else 1.0, "1 / the largest reward"
            elif high <= 0 or -high / 10 < low:
                kwargs[key], how = low, "the lowest reward"
            else:  # large costs would teach a network to stand still
                kwargs[key], how = -high / 10, "a tenth of the highest reward below zero"
            told.append(f"{key} auto: {kwargs[key]:g}, {how}")
        wrappers[place] = wrapper.model_copy(update={"kwargs": kwargs})
    origins = {**spec.origins, "train_env_wrapper": "; ".join(told)}
    return spec.changed(train_env_wrapper=wrappers, origins=origins)
