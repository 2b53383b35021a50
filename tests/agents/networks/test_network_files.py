"""What is saved during and after compiled training opens with the library alone, and trains on."""

import io
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env

import envs  # noqa: F401  # registers the environments
from agents import load_algorithm

Q = {"learning_starts": 50, "buffer_size": 400, "target_update_interval": 20}
AGENTS = {
    "dqn": ("DQN", Q),
    "double_dqn": ("DQN", Q),
    "deep_qlearning": ("DQN", {**Q, "n_steps": 3}),
    "ppo": ("PPO", {"n_steps": 64}),
    "a2c": ("A2C", {}),
}
# Wherever the project is installed, its packages are out of reach here.
ELSEWHERE = """
import sys

OURS = {"agents", "envs", "machine_code", "mdp", "pipeline", "safe_files"}

class Nothing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in OURS:
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Nothing())
import gymnasium, stable_baselines3, torch
for line in sys.stdin.read().splitlines():
    kind, path, env = line.split("|")
    model = getattr(stable_baselines3, kind).load(path, env=gymnasium.make(env), device="cpu")
    steps = {float(s["step"]) for s in model.policy.optimizer.state.values()}
    before = torch.cat([p.detach().flatten() for p in model.policy.parameters()])
    model.learn(200, reset_num_timesteps=False)
    after = torch.cat([p.detach().flatten() for p in model.policy.parameters()])
    print(path, steps, bool((before != after).any()), bool(after.isfinite().all()), sep="|")
assert not {"agents", "envs"} & sys.modules.keys()
"""


def make(name, env, engine="compiled", **kwargs):
    vec_env = make_vec_env(env, seed=0)
    return load_algorithm(name)(
        "MlpPolicy", vec_env, seed=0, engine=engine, **{**AGENTS[name][1], **kwargs}
    )


def weights(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def optimizer_steps(model):
    return {float(kept["step"]) for kept in model.policy.optimizer.state.values()}


def test_files_open_where_this_project_is_not(tmp_path):
    lines, expected = [], []
    for name, (kind, _) in AGENTS.items():
        for env in ("FrozenLake-v1", "CartPole-v1")[name in {"double_dqn", "a2c"} :]:
            folder = tmp_path / f"{name} {env}"
            model = make(name, env)
            model.learn(300, callback=CheckpointCallback(200, folder))
            model.save(folder / "after")
            for path in (folder / "rl_model_200_steps.zip", folder / "after.zip"):
                lines.append(f"{kind}|{path}|{env}")
                steps = {float(s["step"]) for s in optimizer_states(path).values()}
                expected.append(f"{path}|{steps}|True|True")
            assert steps == optimizer_steps(model)
    done = subprocess.run(
        [sys.executable, "-P", "-c", ELSEWHERE],
        input="\n".join(lines),
        cwd=tmp_path,
        env={"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == expected


def tensors(path, member):
    with zipfile.ZipFile(path) as archive:
        return th.load(io.BytesIO(archive.read(member)), weights_only=True)


def optimizer_states(path):
    return tensors(path, "policy.optimizer.pth")["state"]


def shapes(path):
    """What the tensors of a file are like, and that each has its own memory."""
    found, kept = {}, []

    def look(name, value):
        if isinstance(value, dict):
            for key, part in value.items():
                look(f"{name}.{key}", part)
        elif isinstance(value, th.Tensor):
            assert value.is_contiguous(), name
            assert value.untyped_storage().nbytes() == value.nbytes, name
            kept.append(value)
            found[name] = value.shape, value.dtype
        else:
            found[name] = type(value)

    for member in ("policy.pth", "policy.optimizer.pth"):
        look(member, tensors(path, member))
    assert len({tensor.untyped_storage().data_ptr() for tensor in kept}) == len(kept)
    return found


@pytest.mark.parametrize(
    ("name", "callback"), [*((name, False) for name in AGENTS), ("dqn", True), ("ppo", True)]
)
def test_files_are_like_the_librarys(name, callback, tmp_path):
    sizes = []
    for engine in ("library", "compiled"):
        model = make(name, "CartPole-v1", engine)
        checkpoints = CheckpointCallback(100, tmp_path / engine)
        asked = [checkpoints, *[plain()] * callback]
        model.learn(300, callback=asked).save(tmp_path / engine / "after")
        assert model.engine_in_use.startswith(engine)
        sizes.append([path.stat().st_size for path in sorted((tmp_path / engine).glob("*.zip"))])
    assert len(sizes[0]) == 4
    np.testing.assert_allclose(sizes[1], sizes[0], rtol=0.02)
    for path in (tmp_path / "library").glob("*.zip"):
        assert shapes(tmp_path / "compiled" / path.name) == shapes(path)


def plain():
    from stable_baselines3.common.callbacks import ConvertCallback

    return ConvertCallback(lambda locals_, globals_: True)


@pytest.mark.filterwarnings("ignore:`n_steps=3` is ignored")  # the library's, of its own choice
@pytest.mark.parametrize("name", AGENTS)
def test_a_file_goes_on_in_either_engine(name, tmp_path):
    model = make(name, "CartPole-v1").learn(300)
    model.save(tmp_path / "model")
    for engine in ("library", "compiled"):
        loaded = load_algorithm(name).load(tmp_path / "model", make_vec_env("CartPole-v1", seed=1))
        assert all(map(th.equal, weights(loaded).values(), weights(model).values()))
        assert optimizer_steps(loaded) == optimizer_steps(model)
        loaded.engine = engine
        loaded.learn(200, reset_num_timesteps=False)
        assert loaded.num_timesteps >= 500
        (steps,) = optimizer_steps(loaded)
        assert steps > max(optimizer_steps(model))


@pytest.mark.parametrize("name", AGENTS)
def test_tensors_have_memory_of_their_own_afterwards(name):
    model = make(name, "CartPole-v1").learn(300)
    everything = [*model.policy.parameters()]
    for kept in model.policy.optimizer.state.values():
        everything += [value for value in kept.values() if isinstance(value, th.Tensor)]
    for tensor in everything:
        assert tensor.is_contiguous()
        assert tensor.untyped_storage().nbytes() == tensor.nbytes


def test_an_optimizer_that_has_done_nothing_remembers_nothing():
    model = make("dqn", "CartPole-v1", learning_starts=1000).learn(100)
    assert model.engine_in_use == "compiled"
    assert not model.policy.optimizer.state
