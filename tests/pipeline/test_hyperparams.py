"""Files of hyperparameters: rl_zoo3's load unchanged, and every mistake is told in one line."""

import inspect
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import pytest
import stable_baselines3 as sb3
import yaml
from gymnasium.spaces import Box
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.type_aliases import Schedule

from agents import ALGORITHMS, load_algorithm
from pipeline.errors import UserError
from pipeline.settings.components import action_noise, build_algorithm_kwargs, check_action_noise
from pipeline.settings.hyperparams import (
    SPECIAL_KEYS,
    ComponentSpec,
    Hyperparams,
    NoEntryError,
    check_algorithm_kwargs,
    entry_names,
    override,
    read_hyperparams,
    seeds_tuned_on,
    split,
)
from pipeline.settings.values import (
    RANGES,
    DottedName,
    ScheduleSpec,
    algorithm_parameters,
    coerce,
    constructor_parameters,
    parse_schedule,
)
from pipeline.settings.yaml import parse_yaml, read_yaml
from tests.peers.peer_environment import peer_folder

ZOO = peer_folder("rl_zoo3") / "hyperparams"
# her.yml says of itself that it is no longer used: it is of an algorithm that there is no more.
ZOO_ALGORITHMS: Mapping[str, type[BaseAlgorithm]] = {
    path.stem: load_algorithm(path.stem) for path in sorted(ZOO.glob("*.yml")) if path.stem != "her"
}
ZOO_READ = {algo: yaml.safe_load((ZOO / f"{algo}.yml").read_text()) for algo in ZOO_ALGORITHMS}
ZOO_ENTRIES = [
    (algo, env_id)
    for algo in ZOO_ALGORITHMS
    for env_id in ZOO_READ[algo]
    # A slip that rl_zoo3 stumbles over itself; see below.
    if (algo, env_id) != ("ppo_lstm", "default")
]
PPO = constructor_parameters(sb3.PPO)
DQN = constructor_parameters(sb3.DQN)
TD3 = constructor_parameters(sb3.TD3)
TQC = algorithm_parameters(load_algorithm("tqc"))
QLEARNING = constructor_parameters(load_algorithm("qlearning"))


def refusal(read: Callable[[], object]) -> str | None:
    """The one line in which ``read`` refuses its input, or None; any other exception escapes."""
    try:
        read()
    except UserError as error:
        (line,) = str(error).splitlines()
        return line
    return None


def write(folder: Path, text: str | bytes) -> Path:
    path = folder / "ppo.yml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


# --- rl_zoo3's own files -------------------------------------------------------------------------


@pytest.mark.usefixtures("files_parsed_once")
@pytest.mark.parametrize(("algo", "env_id"), ZOO_ENTRIES)
def test_rl_zoo3_entries_load_unchanged(algo: str, env_id: str) -> None:
    raw = read_hyperparams(algo, env_id, ZOO / f"{algo}.yml")
    assert raw == ZOO_READ[algo][env_id]
    hyperparams = split(raw)
    assert hyperparams.n_timesteps == int(float(raw["n_timesteps"]))
    built = build_algorithm_kwargs(ZOO_ALGORITHMS[algo], hyperparams.algorithm, algo)
    # Nothing is left over, and nothing is lost.
    assert built.keys() == raw.keys() - set(SPECIAL_KEYS)
    noise = action_noise(hyperparams, Box(-1, 1, (3,)))
    assert noise.keys() == ({"action_noise"} if "noise_type" in raw else set())


def test_the_one_entry_that_rl_zoo3_cannot_use_is_refused_with_the_right_word() -> None:
    """RecurrentPPO of sb3-contrib knows no MlpPolicy."""
    raw = read_hyperparams("ppo_lstm", "NoOther-v0", ZOO / "ppo_lstm.yml")
    with pytest.raises(UserError, match="'MlpPolicy': did you mean 'MlpLstmPolicy'"):
        build_algorithm_kwargs(load_algorithm("ppo_lstm"), split(raw).algorithm, "here")


@pytest.mark.parametrize("path", sorted(ZOO.glob("*.yml")), ids=lambda path: path.stem)
def test_the_special_keys_of_every_rl_zoo3_file_are_understood(path: Path) -> None:
    for env_id, raw in read_yaml(path).items():
        assert split(raw, env_id).n_envs == raw.get("n_envs", 1)


@pytest.mark.parametrize("path", sorted(ZOO.glob("*.yml")), ids=lambda path: path.stem)
def test_the_names_of_entries_are_those_that_parsing_finds(path: Path) -> None:
    names = [name for name in read_yaml(path) if name not in {"default", "atari"}]
    assert entry_names(path.stem, path) == names
    assert names


def test_an_algorithm_without_a_file_has_no_entries() -> None:
    assert entry_names("no_such_agent") == []


def test_rl_zoo3_cartpole_word_for_word() -> None:
    raw = read_hyperparams("ppo", "CartPole-v1", ZOO / "ppo.yml")
    hyperparams = split(raw)
    assert (hyperparams.n_timesteps, hyperparams.n_envs) == (100_000, 8)
    assert check_algorithm_kwargs(hyperparams.algorithm, PPO, "ppo") == {
        "policy": "MlpPolicy",
        "n_steps": 32,
        "batch_size": 256,
        "gae_lambda": 0.8,
        "gamma": 0.98,
        "n_epochs": 20,
        "ent_coef": 0.0,
        "learning_rate": ScheduleSpec("linear", 0.001, 0.0),
        "clip_range": ScheduleSpec("linear", 0.2, 0.0),
    }


# --- finding the entry ---------------------------------------------------------------------------

ENTRIES = "default: {gamma: 0.1}\natari: {gamma: 0.2}\nCartPole-v1: {gamma: 0.3}\n"


@pytest.mark.parametrize(
    ("env_id", "gamma"),
    [
        ("CartPole-v1", 0.3),
        ("gymnasium:CartPole-v1", 0.3),
        ("Warehouse-v0", 0.1),
        ("envs:Warehouse-v0", 0.1),
        ("ALE/Pong-v5", 0.2),
        ("ale_py:ALE/Pong-v5", 0.2),
        ("PongNoFrameskip-v4", 0.2),
    ],
)
def test_which_entry_is_taken(tmp_path: Path, env_id: str, gamma: float) -> None:
    assert read_hyperparams("ppo", env_id, write(tmp_path, ENTRIES)) == {"gamma": gamma}


@pytest.mark.parametrize(
    ("env_id", "kwargs", "gamma"),
    [
        ("CliffWalking-v1", {"is_slippery": True}, 0.2),
        ("gymnasium:CliffWalking-v1", {"is_slippery": True}, 0.2),
        ("CliffWalking-v1", {"is_slippery": False}, 0.1),
        ("CliffWalking-v1", None, 0.1),
        ("CliffWalking-v1", {"is_slippery": True, "render_mode": None}, 0.1),
        ("FrozenLake-v1", {"map_name": "8x8"}, 0.3),  # FrozenLake8x8-v1 has another time limit
        ("Nowhere-v0", {"is_slippery": True}, 0.5),
    ],
)
def test_an_environment_has_its_entry_by_whichever_of_its_names(
    tmp_path: Path, env_id: str, kwargs: dict[str, Any] | None, gamma: float
) -> None:
    ids = ("CliffWalking-v1", "CliffWalkingSlippery-v1", "FrozenLake-v1", "FrozenLake8x8-v1")
    lines = [f"{name}: {{gamma: 0.{i}}}" for i, name in enumerate((*ids, "default"), start=1)]
    path = write(tmp_path, "\n".join(lines))
    assert read_hyperparams("sarsa", env_id, path, kwargs) == {"gamma": gamma}


def test_no_entry_names_the_nearest_ids_and_the_ways_out(tmp_path: Path) -> None:
    path = write(tmp_path, "CartPole-v1: {}\nCartPole-v0: {}\natari: {}\nTaxi-v4: {}\n")
    with pytest.raises(NoEntryError) as caught:
        read_hyperparams("ppo", "CartPol-v1", path)
    assert str(caught.value) == (
        f"{path}: no entry for 'CartPol-v1' (did you mean 'CartPole-v1' or 'CartPole-v0'?); "
        "give hyperparameters with -params, or another file with --conf-file"
    )


def test_the_usual_file_lies_beside_the_packages() -> None:
    assert read_hyperparams("ppo", "Warehouse-v0")["policy"] == "MlpPolicy"
    # An agent of the user's own has none there, and begins with its defaults.
    assert read_hyperparams("no_such_agent", "CartPole-v1") == {}


def test_merge_keys_and_anchors(tmp_path: Path) -> None:
    text = "A: &a\n  gamma: 0.5\n  n_envs: 2\nB: &b\n  <<: *a\n  gamma: 0.6\nC:\n  <<: *b\n"
    path = write(tmp_path, text)
    assert read_hyperparams("ppo", "B", path) == {"gamma": 0.6, "n_envs": 2}
    assert read_hyperparams("ppo", "C", path) == {"gamma": 0.6, "n_envs": 2}


# --- broken files --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", ": must map environment ids to hyperparameters"),
        ("- a\n- b\n", ": must map environment ids to hyperparameters"),
        ("1: {}\n", ": must map environment ids to hyperparameters"),
        ("A: 5\n", ": the entry A must map names to values"),
        ("A: {1: 2}\n", ": the entry A must map names to values"),
        ("A:\n  gamma: [0.9\n", ":3:1: expected ',' or ']'"),
        ("A:\n\tgamma: 0.9\n", ":2:1: found character"),
        ("A:\n  gamma: 1\n  gamma: 2\n", ":3:3: key 'gamma' appears twice, first on line 2"),
        ("A: {}\nB: {}\nA: {}\n", ":3:1: key 'A' appears twice, first on line 1"),
        ("A: {gamma: *nothing}\n", ":1:12: found undefined alias"),
        ("A: {}\n---\nB: {}\n", ":2:1: but found another document"),
        ("A: {x: !!python/name:os.system }\n", ":1:8: !!python/name:os.system is not allowed"),
        ("A: {x: !!python/object/apply:os.system ['x']}\n", "is not allowed here"),
        ("A: {x: !mine 5}\n", ":1:8: !mine is not allowed here"),
        ("A: {x: !!binary aGk=}\n", ":1:8: !!binary is not allowed here"),
        ("A: {x: !!set {a, b}}\n", "!!set is not allowed here"),
        ("A: {x: !!float word}\n", ":1:8: 'word' is no float"),
        ("A: {x: !!int ''}\n", ":1:8: '' is no int"),
        ("A: {x: !!bool maybe}\n", ":1:8: 'maybe' is no bool"),
        ("A: {[1]: 2}\n", ":1:5: found unhashable key"),
        ("A: &a [*a]\n", ":1:8: is nested too deeply, or too large"),
        ("A: " + "[" * 3000, ":1:53: is nested too deeply, or too large"),
        ("A: {b: " + "9" * 5000 + "}", "is too long for a number"),
        ("A: {b: 0x" + "f" * 5000 + "}", "is too long for a number"),
        ("A: {b: " + ":".join(["1"] * 5000) + "}", "is too long for a number"),
        (b"\x00\x01\x02", ": is not a text file"),
        (b"PK\x03\x04\xff\xfe", ": is not a text file"),
        (b"A: \xff", ": is not a text file"),
    ],
)
def test_a_broken_file_is_told_with_its_place(
    tmp_path: Path, text: str | bytes, complaint: str
) -> None:
    path = write(tmp_path, text)
    with pytest.raises(UserError) as caught:
        read_hyperparams("ppo", "A", path)
    assert str(caught.value).startswith(f"{path}:")
    assert complaint in str(caught.value)


def test_anchors_cannot_unfold_without_end() -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10)]
    with pytest.raises(UserError, match=r"^bomb:5:\d+: .*too large"):
        parse_yaml("\n".join(lines), "bomb")


def test_merge_keys_are_counted_before_they_are_merged() -> None:
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 9)]
    with pytest.raises(UserError, match=r"^bomb:5:\d+: .*too large"):
        parse_yaml("\n".join(lines), "bomb")


def test_what_is_shared_adds_to_the_depth_too() -> None:
    lines = ["a0: &a0 [x]", *(f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, 60))]
    with pytest.raises(UserError, match=r"^deep:49:\d+: is nested too deeply"):
        parse_yaml("\n".join(lines), "deep")
    assert parse_yaml("\n".join(lines[:40]), "deep")["a1"] == [["x"]]


def test_a_pipe_or_a_large_file_holds_no_settings(tmp_path: Path) -> None:
    pipe, large = tmp_path / "pipe.yml", tmp_path / "large.yml"
    os.mkfifo(pipe)
    large.write_text("# " + "x" * 600_000)
    with pytest.raises(UserError, match="is no regular file"):
        read_hyperparams("ppo", "A", pipe)
    for read in (read_hyperparams, entry_names):
        with pytest.raises(UserError, match="is larger than 262,144 bytes"):
            read("ppo", *(["A"] if read is read_hyperparams else []), large)


def test_what_is_no_readable_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"missing\.yml: cannot be read: No such file"):
        read_hyperparams("ppo", "A", tmp_path / "missing.yml")
    with pytest.raises(UserError, match="is no regular file"):
        read_hyperparams("ppo", "A", tmp_path)
    with pytest.raises(UserError, match="cannot be read: embedded null byte"):
        read_hyperparams("ppo", "A", "a\0b")
    with pytest.raises(UserError, match="Python files are not run"):
        read_hyperparams("ppo", "A", tmp_path / "config.py")


@given(st.text() | st.binary())
def test_junk_files_are_read_or_refused_in_one_line(content: str | bytes) -> None:
    complaint = refusal(lambda: parse_yaml(content, "file"))
    assert complaint is None or complaint.startswith("file:")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-4", 1e-4),
        ("1e6", 1e6),
        ("-2.5E+3", -2500.0),
        ("'1e-4'", "1e-4"),
        ("lin_1e-3", "lin_1e-3"),
        ("2001-01-01", "2001-01-01"),
        ("0x1F", 31),
        ("1_000", 1000),
        (".inf", math.inf),
        ("yes", True),
        ("~", None),
    ],
)
def test_scalars(text: str, value: Any) -> None:
    assert parse_yaml(text, "file") == value
    assert type(parse_yaml(text, "file")) is type(value)


# --- special keys --------------------------------------------------------------------------------


def test_special_keys_are_told_from_the_algorithms_arguments() -> None:
    hyperparams = split(
        {
            "n_timesteps": "1e6",
            "n_envs": 4.0,
            "policy": "MlpPolicy",
            "gamma": "0.9",
            "normalize": "dict(norm_obs=True, norm_reward=False)",
            "env_wrapper": "envs.wrappers.OneHotObservation",
            "train_env_wrapper": [{"envs.wrappers.ScaleReward": {"scale": 0.01}}],
            "vec_env_wrapper": None,
            "env_kwargs": "dict(size=8)",
            "train_env_kwargs": {"random_start": True},
            "eval_env_kwargs": {"max_episode_steps": 200},
            "frame_stack": 4,
            "monitor_kwargs": {"info_keywords": ["is_success"]},
            "noise_type": "normal",
            "noise_std": "0.1",
        }
    )
    assert hyperparams == Hyperparams(
        n_timesteps=1_000_000,
        n_envs=4,
        normalize={"norm_obs": True, "norm_reward": False, "gamma": 0.9},
        env_wrapper=(ComponentSpec("envs.wrappers.OneHotObservation"),),
        train_env_wrapper=(ComponentSpec("envs.wrappers.ScaleReward", {"scale": 0.01}),),
        env_kwargs={"size": 8},
        train_env_kwargs={"random_start": True},
        eval_env_kwargs={"max_episode_steps": 200},
        frame_stack=4,
        monitor_kwargs={"info_keywords": ("is_success",)},
        noise_type="normal",
        noise_std=0.1,
        algorithm={"policy": "MlpPolicy", "gamma": "0.9"},
    )


@pytest.mark.parametrize(
    ("value", "normalize"),
    [
        (True, {}),
        (False, None),
        (None, None),
        ({"norm_obs": False}, {"norm_obs": False}),
        ("{'norm_obs': False, 'gamma': 0.5}", {"norm_obs": False, "gamma": 0.5}),
    ],
)
def test_normalize(value: Any, normalize: dict[str, Any] | None) -> None:
    assert split({"normalize": value}).normalize == normalize
    if normalize is not None:
        with_gamma = split({"normalize": value, "gamma": 0.9}).normalize
        assert with_gamma == {"gamma": 0.9} | normalize


def test_an_empty_entry_and_the_budget() -> None:
    assert split({}) == Hyperparams()
    assert split({"n_episodes": 5}).n_episodes == 5


def test_splitting_leaves_the_entry_alone() -> None:
    entry = {"normalize": {"norm_obs": False}, "gamma": 0.9}
    split(entry)
    assert entry == {"normalize": {"norm_obs": False}, "gamma": 0.9}


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        ({"n_timesteps": 0}, "n_timesteps must be at least 1, not 0"),
        ({"n_timesteps": 1.5}, "n_timesteps must be a whole number or null, not 1.5"),
        ({"n_timesteps": "many"}, "n_timesteps must be a whole number or null, not 'many'"),
        ({"n_timesteps": math.inf}, "n_timesteps must be a whole number or null, not inf"),
        ({"n_timesteps": True}, "n_timesteps must be a whole number or null, not True"),
        ({"n_timesteps": 1, "n_episodes": 1}, "give n_timesteps or n_episodes, not both"),
        ({"n_episodes": -1}, "n_episodes must be at least 1, not -1"),
        ({"n_envs": 0}, "n_envs must be at least 1, not 0"),
        ({"n_envs": [1]}, "n_envs must be a whole number, not [1]"),
        ({"frame_stack": 0}, "frame_stack must be at least 1, not 0"),
        ({"normalize": 1}, "normalize must be a mapping of names to values or null, not 1"),
        ({"normalize": {"norm_ob": True}}, "unknown argument 'norm_ob': did you mean 'norm_obs'?"),
        ({"normalize": {"norm_obs": "yes"}}, "norm_obs must be true or false, not 'yes'"),
        ({"normalize": "dict(norm_obs="}, "column"),
        ({"env_kwargs": [1]}, "env_kwargs must be a mapping of names to values, not [1]"),
        ({"env_kwargs": {1: 2}}, "env_kwargs must be a mapping of names to values, not {1: 2}"),
        ({"env_kwargs": "dict(a=nn.Tanh)"}, "env_kwargs takes plain values, not names"),
        ({"monitor_kwargs": {"info_keywords": [1]}}, "info_keywords[0] must be a text, not 1"),
        ({"noise_type": "norml"}, "not 'norml': did you mean 'normal'?"),
        ({"noise_type": "normal", "noise_std": -1}, "noise_std must be at least 0, not -1"),
        ({"noise_type": "normal"}, "noise_type needs noise_std, the standard deviation"),
        ({"noise_type": "normal", "noise_std": None}, "noise_type needs noise_std"),
        ({"env_wrapper": 5}, "env_wrapper must be the dotted name of a class"),
        ({"env_wrapper": [{"a.B": {}, "a.C": {}}]}, "must be the dotted name of a class"),
        ({"callback": [{"a.B": [1]}]}, "callback must be the dotted name of a class"),
        ({"callback": [{"a.B": {1: 2}}]}, "callback must be the dotted name of a class"),
    ],
)
def test_a_wrong_special_key_is_told(entry: dict[str, Any], complaint: str) -> None:
    with pytest.raises(UserError) as caught:
        split(entry, "ppo.yml")
    assert str(caught.value).startswith("ppo.yml: ")
    assert complaint in str(caught.value)


def test_one_budget_replaces_the_other() -> None:
    entry = {"n_timesteps": 100, "gamma": 0.9}
    assert override(entry, {"n_episodes": 5}) == {"gamma": 0.9, "n_episodes": 5}
    assert override(entry, {"gamma": 0.8}) == {"n_timesteps": 100, "gamma": 0.8}
    assert entry == {"n_timesteps": 100, "gamma": 0.9}


# --- action noise --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "noise"),
    [("normal", NormalActionNoise), ("ornstein-uhlenbeck", OrnsteinUhlenbeckActionNoise)],
)
def test_action_noise_has_the_shape_of_an_action(kind: str, noise: type) -> None:
    hyperparams = split({"noise_type": kind, "noise_std": "0.5"})
    assert hyperparams.algorithm == {}
    built = action_noise(hyperparams, Box(-2, 2, (3,)))["action_noise"]
    assert type(built) is noise
    assert built._mu.tolist() == [0, 0, 0]
    assert built._sigma.tolist() == [0.5, 0.5, 0.5]
    assert built().shape == (3,)


def test_noise_on_actions_is_for_agents_that_take_it() -> None:
    noisy = split({"noise_type": "normal", "noise_std": 0.1})
    check_action_noise(noisy, sb3.TD3, "td3")
    check_action_noise(split({}), sb3.PPO, "ppo")
    with pytest.raises(UserError, match=r"^ppo: noise_type is for agents that add noise to"):
        check_action_noise(noisy, sb3.PPO, "ppo")


def test_an_agents_own_noise_is_its_own() -> None:
    """Gaussian noise on the values of a table, which no key of the file format may swallow."""
    hyperparams = split({"exploration": "gaussian_noise", "noise_std": 0.25})
    assert hyperparams.noise_std is None
    kwargs = build_algorithm_kwargs(load_algorithm("qlearning"), hyperparams.algorithm, "here")
    assert kwargs["noise_std"] == 0.25


# --- an algorithm's arguments --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "name", "value", "read"),
    [
        (PPO, "learning_rate", "1e-4", 1e-4),
        (PPO, "learning_rate", 1, 1.0),
        (PPO, "learning_rate", "lin_1e-3", ScheduleSpec("linear", 1e-3, 0.0)),
        # Whose annotation does not say what the function takes.
        (TQC, "learning_rate", "lin_1e-3", ScheduleSpec("linear", 1e-3, 0.0)),
        (TQC, "learning_rate", 1, 1.0),
        (PPO, "clip_range_vf", None, None),
        (PPO, "n_steps", 1e3, 1000),
        (PPO, "n_steps", "1e3", 1000),
        (PPO, "batch_size", "1234567890123456789", 1234567890123456789),
        (PPO, "max_grad_norm", math.inf, math.inf),
        (PPO, "policy_kwargs", "dict(net_arch=[64])", {"net_arch": [64]}),
        (PPO, "policy_kwargs", {"net_arch": [64]}, {"net_arch": [64]}),
        (PPO, "rollout_buffer_class", "a.b.C", DottedName("a.b.C")),
        (PPO, "policy", "MlpPolicy", "MlpPolicy"),
        (PPO, "policy", "agents.mine.Policy", DottedName("agents.mine.Policy")),
        (DQN, "replay_buffer_class", "HerReplayBuffer", DottedName("HerReplayBuffer")),
        (DQN, "train_freq", 4, 4),
        (DQN, "train_freq", [1, "episode"], (1, "episode")),
        (DQN, "train_freq", "(2.0, 'step')", (2, "step")),
        (QLEARNING, "learning_rate", "sample_average", "sample_average"),
        (QLEARNING, "learning_rate", "exp_0.5_0.1", ScheduleSpec("exponential", 0.5, 0.1)),
        (QLEARNING, "temperature", "lin_1_0.1", ScheduleSpec("linear", 1.0, 0.1)),
        (QLEARNING, "tie_breaking", "first", "first"),
        (QLEARNING, "skip_terminal_update", True, True),
    ],
)
def test_arguments_are_read_as_their_annotations_ask(
    parameters: Mapping[str, inspect.Parameter], name: str, value: Any, read: Any
) -> None:
    (result,) = check_algorithm_kwargs({name: value}, parameters, "here").values()
    assert result == read
    assert type(result) is type(read)


@pytest.mark.parametrize(
    ("parameters", "kwargs", "complaint"),
    [
        (PPO, {"gama": 0.9}, "unknown hyperparameter 'gama': did you mean 'gamma'?"),
        (PPO, {"n_env": 2}, "unknown hyperparameter 'n_env': did you mean 'n_envs'?"),
        (PPO, {"frobnicate": 2}, "unknown hyperparameter 'frobnicate'"),
        (PPO, {"self": 2}, "unknown hyperparameter 'self'"),
        (PPO, {"_init_setup_model": False}, "unknown hyperparameter '_init_setup_model'"),
        (PPO, {"seed": 1}, "seed is set by --seed, not here"),
        (PPO, {"env": "CartPole-v1"}, "env is set by --env, not here"),
        (PPO, {"noise_std": 0.1}, "noise_std needs noise_type: normal or ornstein-uhlenbeck"),
        (TD3, {"action_noise": 0.1}, "action_noise is set by noise_type and noise_std, not here"),
        (PPO, {"gamma": 1.5}, "gamma must be between 0 and 1, not 1.5"),
        (PPO, {"gamma": "much"}, "gamma must be a number, not 'much'"),
        (PPO, {"gamma": True}, "gamma must be a number, not True"),
        (PPO, {"gamma": None}, "gamma must be a number, not None"),
        (PPO, {"gamma": math.nan}, "gamma must be a number, not nan"),
        (PPO, {"gamma": 10**400}, "gamma must be a number, not 1000"),
        (PPO, {"learning_rate": -1}, "learning_rate must be between 0 and 1e+37, not -1"),
        (PPO, {"learning_rate": 1e38}, "learning_rate must be between 0 and 1e+37, not 1e+38"),
        (PPO, {"learning_rate": math.inf}, "learning_rate must be between 0 and 1e+37, not inf"),
        (PPO, {"n_epochs": 2**63}, "n_epochs must be at most 9,223,372,036,854,775,807, not 92"),
        (PPO, {"learning_rate": "lin_-1"}, "learning_rate must be between 0 and 1e+37, not -1.0"),
        (PPO, {"learning_rate": "fast"}, "a number or a schedule such as lin_0.001, not 'fast'"),
        (PPO, {"learning_rate": "cos_0.1"}, "unknown schedule 'cos_0.1': there are lin_START"),
        (PPO, {"learning_rate": "lin_0.1_x"}, "unknown schedule 'lin_0.1_x'"),
        (PPO, {"learning_rate": "exp_0.1"}, "'exp_0.1' needs a start and an end above 0"),
        (PPO, {"clip_range": "exp_1_0"}, "'exp_1_0' needs a start and an end above 0"),
        (PPO, {"batch_size": 0}, "batch_size must be at least 1, not 0"),
        (PPO, {"batch_size": 1.5}, "batch_size must be a whole number, not 1.5"),
        (PPO, {"batch_size": "big"}, "batch_size must be a whole number, not 'big'"),
        (PPO, {"use_sde": 1}, "use_sde must be true or false, not 1"),
        (PPO, {"policy": 5}, "policy must be a text or the name of a class, not 5"),
        (PPO, {"policy_kwargs": [1]}, "a mapping of names to values or null, not [1]"),
        (PPO, {"policy_kwargs": "dict(net_arch=["}, "policy_kwargs: 'dict(net_arch=[', column 15:"),
        (PPO, {"policy_kwargs": "__import__('os').system('x')"}, "nothing is run"),
        (PPO, {"rollout_buffer_class": "f(x)"}, "the name of a class or null, not 'f(x)'"),
        (DQN, {"train_freq": [1]}, "a whole number or a list of a whole number and a text"),
        (DQN, {"train_freq": ["a", "b"]}, "train_freq[0] must be a whole number, not 'a'"),
        (DQN, {"train_freq": [0, "step"]}, "train_freq must be at least 1, not 0"),
        (DQN, {"gradient_steps": -2}, "gradient_steps must be at least -1, not -2"),
        (QLEARNING, {"tie_breaking": "frist"}, "not 'frist': did you mean 'first'?"),
        (QLEARNING, {"tie_breaking": 0}, "tie_breaking must be one of 'random', 'first', not 0"),
        (QLEARNING, {"learning_rate": "sample_avrage"}, "did you mean 'sample_average'?"),
        (QLEARNING, {"batch_size": 5}, "unknown hyperparameter 'batch_size'"),
    ],
)
def test_a_wrong_argument_is_told(
    parameters: Mapping[str, inspect.Parameter], kwargs: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(UserError) as caught:
        check_algorithm_kwargs(kwargs, parameters, "here")
    assert str(caught.value).startswith("here: ")
    assert complaint in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("algorithm", [load_algorithm(name) for name in ALGORITHMS])
def test_an_algorithms_own_defaults_pass(algorithm: type[BaseAlgorithm]) -> None:
    parameters = constructor_parameters(algorithm)
    defaults = {
        name: parameter.default
        for name, parameter in parameters.items()
        if name
        not in {"policy", "env", "seed", "device", "verbose", "tensorboard_log", "action_noise"}
        and not name.startswith("_")
    }
    assert check_algorithm_kwargs(defaults, parameters, "here") == defaults


def test_every_range_is_that_of_some_known_name() -> None:
    known = set(Hyperparams.__dataclass_fields__)
    for algorithm in map(load_algorithm, ALGORITHMS):
        known |= constructor_parameters(algorithm).keys()
    assert RANGES.keys() <= known


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)


@given(st.sampled_from(sorted(DQN)), JUNK)
def test_any_value_is_read_or_refused(name: str, value: Any) -> None:
    complaint = refusal(lambda: check_algorithm_kwargs({name: value}, DQN, "here"))
    assert complaint is None or complaint.startswith("here: ")


@given(st.sampled_from(sorted(Hyperparams.__dataclass_fields__)), JUNK)
def test_any_entry_is_split_or_refused(name: str, value: Any) -> None:
    complaint = refusal(lambda: split({name: value}))
    assert complaint is None or complaint.startswith("hyperparameters: ")


# --- annotations and schedules -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "annotation", "read"),
    [
        (1, float | int, 1),
        ("5", float | str, 5.0),
        ("five", float | str, "five"),
        ("true", str, "true"),
        (1, Literal[1, 2], 1),
        ([1, 2], list[float], [1.0, 2.0]),
        ((1, 2), list[int], [1, 2]),
        ([1, 2.0], tuple[int, ...], (1, 2)),
        ({"pi": [64.0]}, list[int] | dict[str, list[int]] | None, {"pi": [64]}),
        ("lin_0.5", Schedule, ScheduleSpec("linear", 0.5, 0.0)),
        ({"a": 1}, dict, {"a": 1}),
        ("as it is", "float | NotImported", "as it is"),
        ({1: [2]}, inspect.Parameter.empty, {1: [2]}),
        (5, Any, 5),
        ("1e-4", float | Path | None, 1e-4),
        ("far", float | Path | None, "far"),
    ],
)
def test_annotations(value: Any, annotation: Any, read: Any) -> None:
    assert coerce(value, annotation, "here") == read
    assert type(coerce(value, annotation, "here")) is type(read)


@pytest.mark.parametrize(
    ("value", "annotation"),
    [
        (True, Literal[1, 2]),
        (1, Literal[True]),
        ("ab", list[str]),
        ([1, 2], tuple[int, int, int]),
        ("inf", int),
        (2, bool),
        (0, str | None),
        ([1], tuple[int | str, Path]),
    ],
)
def test_what_does_not_fit_its_annotation(value: Any, annotation: Any) -> None:
    with pytest.raises(UserError, match=r"^here must be "):
        coerce(value, annotation, "here")


@pytest.mark.parametrize(
    ("text", "schedule"),
    [
        ("lin_1e-3", ScheduleSpec("linear", 1e-3, 0.0)),
        ("lin_.5", ScheduleSpec("linear", 0.5, 0.0)),
        ("lin_1e-3_1e-5", ScheduleSpec("linear", 1e-3, 1e-5)),
        ("exp_1_0.01", ScheduleSpec("exponential", 1.0, 0.01)),
    ],
)
def test_schedules(text: str, schedule: ScheduleSpec) -> None:
    assert parse_schedule(text, "here") == schedule


@given(st.text() | st.from_regex(r"(lin|exp|x)_[-0-9.e]{0,4}(_[-0-9.e]{0,4})?", fullmatch=True))
def test_any_text_is_a_schedule_or_refused(text: str) -> None:
    complaint = refusal(lambda: parse_schedule(text, "here"))
    if complaint is None:
        schedule = parse_schedule(text, "here")
        assert math.isfinite(schedule.start)
        assert math.isfinite(schedule.end)
    else:
        assert complaint.startswith("here: ")


TEXT = """\
tuned_on:
  Lake-v0: {first: 0, count: 10}
  Cliff-v0: [{first: 0, count: 1}, {first: 100, count: 2}]

default: {n_timesteps: 5}
Lake-v0: {n_timesteps: 6}
Cliff-v0: {n_timesteps: 7}
"""


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "mine.yml"
        path.write_text(text)
        return path

    return write


def test_each_entry_has_its_seeds_and_an_entry_that_is_not_named_has_none(file):
    path = file(TEXT)
    assert seeds_tuned_on("dqn", "Lake-v0", path) == (range(10),)
    assert seeds_tuned_on("dqn", "module:Cliff-v0", path) == (range(1), range(100, 102))
    assert seeds_tuned_on("dqn", "Elsewhere-v0", path) == ()


def test_the_seeds_are_no_hyperparameter_and_no_environment(file):
    path = file(TEXT)
    assert read_hyperparams("dqn", "Lake-v0", path) == {"n_timesteps": 6}
    assert read_hyperparams("dqn", "tuned_on", path) == {"n_timesteps": 5}
    assert entry_names("dqn", path) == ["Lake-v0", "Cliff-v0"]
    without_default = file(TEXT.replace("default:", "Taxi-v4:"))
    with pytest.raises(NoEntryError, match="no entry for 'tuned_on'") as error:
        read_hyperparams("dqn", "tuned_on", without_default)
    assert "did you mean" not in str(error.value)


def test_who_does_not_say_is_not_known(file):
    assert seeds_tuned_on("dqn", "Lake-v0", file("default: {n_timesteps: 5}\n")) is None
    assert seeds_tuned_on("an agent of the user's", "Lake-v0") is None


def test_entries_of_the_shipped_files():
    assert seeds_tuned_on("dqn", "Taxi-v4") == (range(10),)
    assert seeds_tuned_on("ppo", "Pendulum-v1") == (range(100, 101),)
    assert seeds_tuned_on("dqn", "Acrobot-v1") == ()
    assert all(seeds_tuned_on(algo, "BipedalWalker-v3") == () for algo in ALGORITHMS)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ("0-9", "tuned_on must map entries to seeds, not be '0-9'"),
        ("{Lake-v0: 10}", "tuned_on: Lake-v0 must be like {first: 0, count: 10}, not 10"),
        ("{Lake-v0: {first: 0}}", "tuned_on: Lake-v0 must be like"),
        ("{Lake-v0: {first: 0, count: -1}}", "tuned_on: Lake-v0 must be like"),
        ("{Lake-v0: {first: 0, count: yes}}", "tuned_on: Lake-v0 must be like"),
        ("{Lake-v0: [{first: 0, count: 1.5}]}", "tuned_on: Lake-v0 must be like"),
        ("{Lake: {first: 0, count: 1}}", "tuned_on names 'Lake', which has no entry there"),
        ("{tuned_on: {first: 0, count: 1}}", "tuned_on names 'tuned_on', which has no entry"),
    ],
)
def test_mistakes_in_it_end_in_one_line(file, said, message):
    path = file(f"tuned_on: {said}\nLake-v0: {{n_timesteps: 6}}\n")
    for read in (seeds_tuned_on, read_hyperparams):
        with pytest.raises(UserError) as error:
            read("dqn", "Lake-v0", path)
        assert message in str(error.value)
        assert "\n" not in str(error.value)
