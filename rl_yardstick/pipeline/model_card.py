"""Writes the model card of a pack: metadata for model hubs, results, and how to play."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import gymnasium as gym
import yaml

from rl_yardstick.agents import ALGORITHMS
from rl_yardstick.pipeline.errors import visible
from rl_yardstick.pipeline.user_modules import copy_of

# Wrappers that a plain script would need too.
_WRAPPERS = ("env_wrapper", "vec_env_wrapper", "frame_stack")
_LIBRARIES = ("stable_baselines3", "sb3_contrib")
_DEEP = {"dqn", "double_dqn", "deep_qlearning"}
# Agents of this project whose model files the library can read, unless they use action masks.
_OF_THE_LIBRARY = {"dqn": "DQN", "ppo": "PPO", "a2c": "A2C"}


def card(record: Mapping[str, Any], files: Collection[str]) -> str:
    """Make the README.md of a pack from its ``run.json`` and the names of its other files."""
    spec = record["spec"]
    algo, env_id = spec["algo"], spec["env_id"]
    pictures = [name for name in ("value_map.png", "learning_curve.png") if name in files]
    films = [name for name in files if name.startswith("replay.")]
    maker = "Trained with Yardstick (the Python package `rl-yardstick`)"
    seed = f"seed {plain_text(spec['seed'])}"
    engine = f"; engine: {plain_text(record['engine'])}" if record.get("engine") else ""
    sections = [
        f"---\n{_front_matter(record)}---\n",
        f"# {plain_text(algo)} on {plain_text(env_id)}\n",
        f"{maker} for {record['n_timesteps']:,} environment steps, {seed}{engine}.\n",
        _figures(record),
        *(f"![{n.partition('.')[0].replace('_', ' ')}]({n})\n" for n in [*films, *pictures]),
        "## Play it\n",
        _playing(record, files),
        "## Settings\n",
        fenced("yaml", str(yaml.safe_dump(spec["hyperparams"]))),
        "## Versions\n",
        "".join(f"- {plain_text(k)} {plain_text(v)}\n" for k, v in record["versions"].items()),
    ]
    return visible("\n".join(sections))


def plain_text(value: object) -> str:
    """Escape a value for Markdown, because the run may come from anyone."""
    return re.sub(r"[\\`*<>|&\[\]]", lambda found: f"\\{found[0]}", " ".join(str(value).split()))


def _front_matter(record: Mapping[str, Any]) -> str:
    spec, final = record["spec"], record.get("final") or {}
    figures: list[tuple[str, str, Any]] = []  # the first in the format of hubs, the others exact
    if final:
        told = f"{final['mean_return']:.2f} +/- {final['std_return']:.2f}"
        names = {"mean_return": "mean return", **_measured(final), "success_rate": "success rate"}
        figures = [("mean_reward", "mean_reward", told)]
        figures += [(key, label, final.get(key)) for key, label in names.items()]
    metrics = [
        {"type": name, "value": value, "name": label, "verified": False}
        for name, label, value in figures
        if value is not None
    ]
    env = str(spec["env_id"])
    is_deep = spec["algo"] in _DEEP or _plain_class(spec) is not None
    kind = ["deep-reinforcement-learning"] if is_deep else []
    place = {
        "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
        "dataset": {"name": env, "type": env},
        "metrics": metrics,
    }
    data = {
        "library_name": "stable-baselines3",
        "tags": [env, *kind, "reinforcement-learning", "stable-baselines3"],
        "model-index": [{"name": spec["algo"], "results": [place]}],
    }
    return str(yaml.safe_dump(data, sort_keys=False))


def _figures(record: Mapping[str, Any]) -> str:
    final = record.get("final")
    if not final:
        pulls = record.get("pulls") or {}
        return _table([(name.replace("_", " "), value) for name, value in pulls.items()])
    if final["exact"]:
        how = "computed exactly, from the model of the environment; no episode was sampled"
    else:
        how = f"mean of {final['n_episodes']} sampled episodes of the greedy policy"
    rows = [
        ("mean return", final["mean_return"]),
        ("its standard deviation over episodes", final["std_return"]),
        ("mean length of an episode", final["mean_length"]),
        ("success rate", final.get("success_rate")),
        ("best random or constant policy", final.get("baseline")),
        ("optimum of an agent that sees the state, which is hidden", final.get("full_optimum")),
        *((label, final.get(name)) for name, label in _measured(final).items()),
    ]
    return _table([*rows, ("how", how)])


def _measured(final: Mapping[str, Any]) -> dict[str, str]:
    """The labelled figures that compare the return with the optimum."""
    if "optimum_at_least" not in final:
        return {
            "optimum": "optimum",
            "gap": "gap to the optimum",
            "score": "score (1: optimum, 0: best random or constant policy)",
        }
    is_proven = final.get("optimum_is_proven", True)
    unproven = "an upper end that is not proven"
    upper = "the bracket's upper end" if is_proven else "the bracket's upper end, not proven"
    return {
        "optimum_at_least": "optimum, bracketed: what a policy was shown to reach",
        "optimum": "optimum, bracketed: " + ("what no policy exceeds" if is_proven else unproven),
        "gap_at_least": "gap to the bracket's lower end",
        "gap": "gap to the bracket's upper end",
        "score": f"score (1: {upper}, 0: best random or constant policy)",
        "score_at_most": "score with 1 at the bracket's lower end",
    }


def _table(rows: list[tuple[str, Any]]) -> str:
    told = [(plain_text(name), plain_text(value)) for name, value in rows if value is not None]
    return "| figure | value |\n|---|---|\n" + "".join(f"| {a} | {b} |\n" for a, b in told)


def _playing(record: Mapping[str, Any], files: Collection[str]) -> str:
    spec = record["spec"]
    modules = to_type(spec, files)
    parts = [
        "With Yardstick, in this folder (nothing in it is run, but for modules that you type):\n"
        if modules
        else "With Yardstick, from this folder or its zip (nothing in it is run):\n",
        fenced("sh", f"yardstick enjoy .{_flag(modules)}\n"),
    ]
    text = _script(record, files)
    if text is not None:
        parts += ["In Python:\n", fenced("python", text)]
    if _plain_class(spec) is not None:
        place = shlex.quote(f"{spec['algo']}/{record['env_name']}_1")
        packages = [*(spec.get("gym_packages") or []), *([] if _is_known(spec) else ["envs"])]
        agent = shlex.join(["--algo", spec["algo"], "--env", spec["env_id"]])
        copying = f"mkdir -p {shlex.quote(spec['algo'])} && cp -r PACK {place}\n"
        playing = f"python -m rl_zoo3.enjoy {agent}{_flag(packages)} -f .\n"
        parts += [
            "With rl_zoo3, which finds agents by the names of folders (this one is `PACK`):\n",
            fenced("sh", copying + playing),
        ]
    return "\n".join(parts)


def _flag(packages: Sequence[str]) -> str:
    return f" --gym-packages {shlex.join(packages)}" if packages else ""


def _is_known(spec: Mapping[str, Any]) -> bool:
    """Whether the environment belongs to Gymnasium."""
    registered = gym.registry.get(spec["env_id"])
    return registered is not None and str(registered.entry_point).startswith("gymnasium.")


def to_type(spec: Mapping[str, Any], files: Collection[str]) -> list[str]:
    """The argument for ``--gym-packages``: the module's copy in the pack, or else its name."""
    names = map(str, spec.get("gym_packages") or [])
    return [copy_of(name, files.__contains__) or name for name in names]


def _plain_class(spec: Mapping[str, Any]) -> tuple[str, str] | None:
    """Library and class that load an agent's zip without this project, or None."""
    algo = spec["algo"]
    if spec["hyperparams"].get("mask_actions"):
        return None
    if algo in _OF_THE_LIBRARY:
        return "stable_baselines3", _OF_THE_LIBRARY[algo]
    entry = ALGORITHMS[algo].entry_point if algo in ALGORITHMS else ""
    module, _, name = entry.partition(":")
    library = module.partition(".")[0]
    return (library, name) if library in _LIBRARIES else None


def _script(record: Mapping[str, Any], files: Collection[str]) -> str | None:
    """A short script that plays the agent without this project's commands, or None."""
    spec, env_name = record["spec"], record["env_name"]
    settings = spec["hyperparams"]
    if any(settings.get(name) for name in _WRAPPERS) or spec.get("gym_packages"):
        return None
    env_id = spec["env_id"]
    given = {**(settings.get("env_kwargs") or {}), **(settings.get("eval_env_kwargs") or {})}
    statistics = f"{env_name}/vecnormalize.pkl"
    normalizes = statistics in files
    plain = _plain_class(spec)
    library, name = plain or ("", f"load_algorithm({spec['algo']!r})")
    agents = "from rl_yardstick.agents import load_algorithm  # Yardstick's agents"
    lines = (
        (not _is_known(spec), "import envs  # Yardstick's environments"),
        (True, f"from {library} import {name}" if plain else agents),
        (True, "from stable_baselines3.common.env_util import make_vec_env"),
        (True, "from stable_baselines3.common.evaluation import evaluate_policy"),
        (normalizes, "from stable_baselines3.common.vec_env import VecNormalize"),
        (True, f"\nenv = make_vec_env({env_id!r}, env_kwargs={given!r}, seed=0)"),
        (normalizes, f"env = VecNormalize.load({statistics!r}, env)"),
        (normalizes, "env.training = env.norm_reward = False"),
        (True, f"model = {name}.load({env_name + '.zip'!r})"),
        (True, "mean, std = evaluate_policy(model, env, n_eval_episodes=10)"),
        (True, 'print(f"return {mean:.2f} +/- {std:.2f}")'),
    )
    return "".join(f"{line}\n" for is_needed, line in lines if is_needed)


def fenced(language: str, text: str) -> str:
    """A text as a block of code, with a fence that does not occur in the text."""
    longest = max((len(run) for run in re.findall(r"`+", text)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{fence}{language}\n{text}{fence}\n"


def results(record: Mapping[str, Any]) -> str | None:
    """The ``results.json`` in rl_zoo3's format for a hub; None without evaluation."""
    final = record.get("final")
    if not final:
        return None
    told = {
        "mean_reward": final["mean_return"],
        "std_reward": final["std_return"],
        "is_deterministic": True,
        "n_eval_episodes": final["n_episodes"],
    }
    return json.dumps(told, indent=2) + "\n"
