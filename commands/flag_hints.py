"""Flags that are not here: what is here instead, and what was probably meant."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence

from agents import ALGORITHMS, load_algorithm
from pipeline.errors import OTHER_NAMES, did_you_mean
from pipeline.settings.hyperparams import SPECIAL_KEYS
from pipeline.settings.values import RANGES

_SEARCH = "hyperparameters are not searched for here, but by the command tune: see tune --help"
_NO_WANDB = "Weights & Biases is not supported; -tb DIR writes TensorBoard logs"

# Flags of rl_zoo3's train and enjoy that are not here, and why.
INSTEAD: Mapping[str, str] = {
    **dict.fromkeys(
        (
            "-optimize",
            "--optimize-hyperparameters",
            "--n-trials",
            "--no-optim-plots",
            "--n-jobs",
            "--sampler",
            "--pruner",
            "--n-startup-trials",
            "--optimization-log-path",
            "--storage",
            "--study-name",
            "--max-total-trials",
        ),
        _SEARCH,
    ),
    "--n-evaluations": "they are not counted here: give the steps between them, --eval-freq",
    "--trial-id": "trials are not read here: tune writes a file for --conf-file, winner.yml",
    **dict.fromkeys(
        (
            "--track",
            "--wandb-project-name",
            "--wandb-entity",
            "--wandb-group",
            "-tags",
            "--wandb-tags",
        ),
        _NO_WANDB,
    ),
    "--trust": "it is not needed: every file is read as data, and nothing in it is run",
    "--truncate-last-trajectory": "it cannot be changed: it is always true, the library's default",
}

# Arguments of constructors that are flags.
SET_BY_FLAGS = {"env", "seed", "device", "verbose", "tensorboard_log", "_init_setup_model"}

# Hyperparameters of some agent: for these alone is it worth seconds to import the one meant.
HYPERPARAMETERS = {
    *SPECIAL_KEYS,
    *RANGES,
    *(name for names in OTHER_NAMES.values() for name in names),
    *("alpha", "c", "likelihood", "mixing", "policy", "prior_failures", "prior_mean", "prior_std"),
    *("prior_successes", "baseline", "engine", "exploration", "ignore_context", "initial_q_std"),
    *("skip_terminal_update", "tie_breaking", "variant", "reward_std", "ridge", "use_rms_prop"),
    *("normalize_advantage", "optimize_memory_usage", "replay_buffer_class", "use_sde"),
    *("replay_buffer_kwargs", "rollout_buffer_class", "rollout_buffer_kwargs", "target_entropy"),
    *("action_noise", "policy_delay", "target_policy_noise", "target_noise_clip", "zero_policy"),
    *("use_sde_at_warmup", "top_quantiles_to_drop_per_net", "n_critic_updates", "cg_max_steps"),
    *("cg_damping", "line_search_shrinking_factor", "line_search_max_iter", "sub_sampling_factor"),
    *("trace_decay", "trace_type", "longest_episode", "every_visit", "target_policy", "n_steps"),
    *("planning_steps", "outcomes_kept", "kappa", "threshold", "known_after", "value_bound"),
    *("tolerance", "horizon", "bonus_scale", "n_tilings", "n_tiles", "low", "high"),
    *("value_step_size", "initial_preferences", "gamma_power"),
    *("mask_actions", "n_delta", "n_top", "delta_std", "alive_bonus_offset", "n_eval_episodes"),
}

# What people type for flags of ours; the first of the flags that the command has is named.
_OTHER_FLAGS: Mapping[str, Sequence[str]] = {
    **dict.fromkeys(("algorithm", "agent", "model"), ("--algo", "--algos")),
    **dict.fromkeys(("agents", "algorithms"), ("--algos", "--algo")),
    **dict.fromkeys(("environment", "env-id", "env-name", "game", "envs"), ("--env",)),
    **dict.fromkeys(
        ("timesteps", "total-timesteps", "steps", "num-timesteps", "max-steps", "n-steps"),
        ("--n-timesteps",),
    ),
    **dict.fromkeys(("episodes", "num-episodes"), ("--n-episodes",)),
    **dict.fromkeys(("render-mode", "mode"), ("--render",)),
    **dict.fromkeys(("video", "gif", "film", "record-video", "save-video"), ("--record",)),
    **dict.fromkeys(("gpu", "cuda", "cpu"), ("--device",)),
    **dict.fromkeys(("quiet", "silent"), ("--verbose",)),
    **dict.fromkeys(
        ("logdir", "log-dir", "output", "out", "save-dir"), ("--log-folder", "--folder")
    ),
    "log-folder": ("--folder",),
    "folder": ("--log-folder",),
    **dict.fromkeys(("continue", "load", "pretrained"), ("--trained-agent",)),
    **dict.fromkeys(("workers", "n-jobs", "num-workers", "parallel"), ("--jobs",)),
    **dict.fromkeys(("seed", "n-seeds", "num-seeds"), ("--seeds",)),
    **dict.fromkeys(("config", "conf", "yaml", "yaml-file"), ("--conf-file",)),
    **dict.fromkeys(("params", "hyperparameters", "kwargs"), ("--hyperparams",)),
    **dict.fromkeys(("best",), ("--load-best",)),
    **dict.fromkeys(("checkpoint",), ("--load-checkpoint",)),
}


def hint(words: Sequence[str], flags: Iterable[str], algos: Sequence[str]) -> str:
    """What to do about a flag that there is not.

    Args:
        words: what the parser could not place, the flag first; no word for an empty one.
        flags: the flags that there are.
        algos: the agents that the command line names; empty where they are named elsewhere.

    Returns:
        One sentence; where nothing is near, an empty one.
    """
    flags = list(flags)
    flag, _, value = "".join(words[:1]).partition("=")
    name = flag.lstrip("-").replace("_", "-").lower()
    setting = _hyperparameter(name.replace("-", "_"), algos)
    ours = next((known for known in _OTHER_FLAGS.get(name, ()) if known in flags), None)
    if ours is not None and setting != name.replace("-", "_"):
        return f"did you mean {ours!r}?"
    if flag in INSTEAD:
        return INSTEAD[flag]
    if setting:
        value = value or next(iter(words[1:2]), "")
        return _as_setting(setting, value, is_here="--hyperparams" in flags)
    return did_you_mean(flag, flags)


def _hyperparameter(name: str, algos: Sequence[str]) -> str:
    """The hyperparameter that ``name`` is, or is another name of; empty for none."""
    meant = [other for other in (name, *OTHER_NAMES.get(name, ())) if other in HYPERPARAMETERS]
    if not meant or not algos:
        return "".join(meant[:1])
    known = set(SPECIAL_KEYS)
    for algo in algos:
        if algo in ALGORITHMS and ALGORITHMS[algo].is_installed:
            known |= set(inspect.signature(load_algorithm(algo)).parameters)
    return next((other for other in meant if other in known), "")


def _as_setting(name: str, value: str, is_here: bool) -> str:
    given = value if value and not value.startswith("-") else "VALUE"
    if name == "policy_kwargs":
        given = '"dict(net_arch=[64, 64])"'
    if is_here:
        return f"hyperparameters go behind -params: -params {name}:{given}"
    return f"hyperparameters are a matter of training: train with -params {name}:{given}"
