"""Modules of the user's: found where they lie, never taken for others, imported when typed."""

import dataclasses
import importlib
import importlib.metadata
import os
import shutil
import sys

import gymnasium as gym
import numpy as np
import pytest

from pipeline.environments import check_env_id, make_env
from pipeline.errors import UserError
from pipeline.user_modules import (
    UserModule,
    as_flag,
    check_recorded,
    import_again,
    import_typed,
    keep_copies,
)


@pytest.fixture
def write(own_folder):
    """Write files into the user's folder."""

    def put(**files):
        for name, text in files.items():
            path = own_folder / f"{name.replace('__in__', '/')}.py"
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        return own_folder

    return put


def complaint_of(call, *args):
    with pytest.raises(UserError) as caught:
        call(*args)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# --- finding -------------------------------------------------------------------------------------


def test_a_module_is_found_by_its_name_and_by_its_path(write, own_folder):
    write(my_first="x = 1", my_package__in____init__="from my_package.part import x")
    write(my_package__in__part="x = 2", my_space__in__part="x = 3", my_other="import my_first")
    words = ["my_first", "./my_other.py", "my_package/", "my_package/part.py", "my_space.part"]
    modules = import_typed(words)
    assert [module.typed for module in modules] == words
    assert [module.name for module in modules] == [
        "my_first",
        "my_other",
        "my_package",
        "my_package.part",
        "my_space.part",
    ]
    assert {module.search_folder for module in modules} == {str(own_folder)}
    assert sys.modules["my_package"].x == 2
    assert str(own_folder) not in sys.path


def test_a_path_is_found_from_elsewhere_and_in_the_home_folder(write, monkeypatch, tmp_path):
    folder = write(my_first="x = 1")
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    (module,) = import_typed([f"~/{folder.name}/my_first.py"])
    assert module == UserModule(f"~/{folder.name}/my_first.py", "my_first", f"{folder}/my_first.py")


def test_what_is_installed_has_no_path():
    assert import_typed(["gymnasium.wrappers"]) == (
        UserModule("gymnasium.wrappers", "gymnasium.wrappers"),
    )


def test_our_own_need_not_be_kept(own_folder):
    assert import_typed(["envs"], ["envs:Warehouse-v0", "CartPole-v1"]) == ()


def test_another_process_imports_from_anywhere(write, monkeypatch, tmp_path):
    folder = write(my_first="x = 1")
    modules = import_typed(["my_first"])
    del sys.modules["my_first"]
    sys.meta_path.pop()
    monkeypatch.chdir(tmp_path)
    import_again(modules)
    assert sys.modules["my_first"].__file__ == str(folder / "my_first.py")


# --- names that are taken ------------------------------------------------------------------------

OURS = ["envs", "agents", "mdp", "verdicts", "pipeline", "experiments", "tuning"]
OURS += ["report", "commands", "train", "enjoy", "compare", "tune"]


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("form", ["{}", "./{}.py"])
def test_a_module_with_the_name_of_ours_is_refused(write, name, form):
    folder = write(**{name: "raise SystemExit('it was imported')"})
    complaint = complaint_of(import_typed, [form.format(name)])
    assert f"{name} is the name of one of Yardstick's own modules: rename" in complaint
    assert f"{folder / name}.py, or put it into a package of another name" in complaint


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["agents"], "agents is the name of one of Yardstick's own modules: rename"),
        (["agents.mine"], "agents is the name of one of Yardstick's own modules: rename"),
        (["agents/mine.py"], "agents is the name of one of Yardstick's own modules: rename"),
        (["json"], "json is the name of one of Python's own modules: rename"),
        (["./json.py"], "json is the name of one of Python's own modules: rename"),
        (["numpy"], "Python finds another numpy first, at "),
        (["my_first", "agents/../below/my_first.py"], "Python finds another my_first first, at "),
        (["no_such"], "cannot import no_such: it is neither in "),
        (["my_first.no_such"], "cannot import my_first.no_such: it is neither in "),
        (["./no_such.py"], "there is no such file or folder"),
        (["./below"], "the folder is no package: it holds no __init__.py"),
        (["~no_such_user/x.py"], "ould not determine home directory"),
        (["./notes.txt"], "it is no Python file"),
        (["./my-agents.py"], "'my-agents' is no name of a module: rename it"),
        (["my-agents"], "it is neither the name of a module nor the path of one"),
        (["__main__"], "it is neither the name of a module nor the path of one"),
        (["a b; c"], "--gym-packages 'a b; c': "),
    ],
)
def test_what_cannot_be_imported(write, own_folder, words, complaint):
    poison = "raise SystemExit('it was imported')"
    write(agents__in____init__=poison, agents__in__mine=poison, json=poison, numpy=poison)
    write(my_first="x = 1", below__in__my_first=poison)
    (own_folder / "notes.txt").touch()
    (own_folder / "my-agents.py").touch()
    assert complaint in complaint_of(import_typed, words)


def test_a_folder_of_other_things_is_no_module(own_folder):
    """Such as one that holds virtual environments."""
    (own_folder / "envs" / "python3").mkdir(parents=True)
    assert import_typed(["envs"]) == ()


# --- modules that fail ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("x = 1\ndef f(:", "my_first.py:2: SyntaxError: "),
        ("x = 1\n\nimport no_such_library", "my_first.py:3: ModuleNotFoundError: No module named"),
        ("from math import no_such", "my_first.py:1: ImportError: cannot import name 'no_such'"),
        ("import json\njson.loads('{')", "my_first.py:2: JSONDecodeError: "),
        ("raise RuntimeError('two\\nlines')", "my_first.py:1: RuntimeError: two lines"),
        ("import sys\nsys.exit(3)", "my_first.py:2: SystemExit: 3"),
        ("import agents\nagents.register('ppo', 'a:B')", "my_first.py:2: ValueError: there is an"),
        ("import my_second", "my_second.py:2: KeyError: 'x'"),
    ],
)
def test_a_module_that_fails_is_told_with_its_line(write, text, complaint):
    folder = write(my_first=text, my_second="\n{}['x']")
    told = complaint_of(import_typed, ["my_first"])
    assert told.startswith(f"--gym-packages my_first: {folder}{os.sep}{complaint}")


# --- only what was typed -------------------------------------------------------------------------


def test_what_lies_beside_is_found_for_the_users_own_code_alone(write, own_folder, monkeypatch):
    """A library that looks for another one, or for plugins, does not find a stranger's."""
    write(my_first="def later():\n    import my_second\n", my_second="x = 1", not_mine="x = 2")
    (own_folder / "not_mine-1.dist-info").mkdir()
    (own_folder / "not_mine-1.dist-info" / "METADATA").write_text("Name: not_mine\nVersion: 1\n")
    plugin = "[torch.backends]\nnot_mine = not_mine:x\n"
    (own_folder / "not_mine-1.dist-info" / "entry_points.txt").write_text(plugin)
    write(installed__in__library="def later(): import not_mine")  # as in a virtual environment
    monkeypatch.syspath_prepend(str(own_folder / "installed"))
    import_typed(["my_first"])
    with pytest.raises(ModuleNotFoundError, match="not_mine"):
        importlib.import_module("library").later()
    assert "not_mine" not in importlib.metadata.entry_points(group="torch.backends").names
    sys.modules["my_first"].later()
    assert sys.modules["my_second"].x == 1


def test_an_id_imports_nothing(write):
    write(my_first="raise SystemExit('it was imported')")
    told = "'my_first:FrozenLake-v1': its module is not imported because a file asks: "
    assert complaint_of(check_env_id, "my_first:FrozenLake-v1") == (
        f"{told}add --gym-packages my_first"
    )
    make_env("my_first:FrozenLake-v1", {}).close()
    assert "my_first" not in sys.modules


def test_the_module_of_an_id_that_was_typed_is_imported(write):
    env = "gymnasium.register('my/Lake-v0', 'gymnasium.envs.toy_text:FrozenLakeEnv')"
    write(my_first=f"import gymnasium\n{env}")
    (module,) = import_typed([], ["my_first:my/Lake-v0"])
    check_env_id("my_first:my/Lake-v0")
    assert as_flag([module], "my_first:my/Lake-v0") == ""
    assert as_flag([module], "my/Lake-v0") == " --gym-packages my_first"
    assert as_flag([UserModule("./my file.py", "my", None)]) == " --gym-packages './my file.py'"
    assert gym.spec("my/Lake-v0").namespace == "my"


def test_a_run_names_what_to_type(write, tmp_path):
    folder = write(
        my_first="import my_beside", my_package__in____init__="", my_beside="import json"
    )
    write(json="x = 1", my_other="x = 1", my_package__in__part="'my_named:Class'", my_named="")
    modules = import_typed(["my_first", "my_package"])
    run = tmp_path / "run"
    run.mkdir()
    keep_copies(modules, run)
    copies = [path.relative_to(run / "modules").as_posix() for path in run.rglob("*.py")]
    package = ["my_package/__init__.py", "my_package/part.py"]
    assert sorted(copies) == ["my_beside.py", "my_first.py", "my_named.py", *package]
    recorded = {
        "gym_packages": [module.name for module in modules],
        "user_modules": [vars(module) for module in modules],
    }
    check_recorded(recorded, run)
    for name in ("my_first", "my_package"):
        del sys.modules[name]
    told = complaint_of(check_recorded, recorded, run)
    assert told.endswith("add --gym-packages ./my_first.py ./my_package")
    shutil.rmtree(folder / "my_package")
    (folder / "my_first.py").unlink()
    told = complaint_of(check_recorded, recorded, run)
    assert told.endswith(f"add --gym-packages {run}/modules/my_first.py {run}/modules/my_package")
    packed = tmp_path / "study" / "runs" / "q" / "run.zip"
    told = complaint_of(check_recorded, recorded, run, packed)
    words = "modules/my_first.py modules/my_package"
    assert told.endswith(
        f"unzip it, read them, and if you trust them add, there, --gym-packages {words}"
    )
    shutil.copytree(run / "modules", tmp_path / "study" / "modules")
    told = complaint_of(check_recorded, recorded, run, packed)
    assert "read them, and if you trust them add --gym-packages" in told
    assert told.endswith(
        f"{tmp_path}/study/modules/my_first.py {tmp_path}/study/modules/my_package"
    )


def test_a_run_that_lies_is_quoted(tmp_path):
    recorded = {"gym_packages": ["../x", "a\x1b[2Jb", 3], "user_modules": ["x", {"name": "../x"}]}
    told = complaint_of(check_recorded, recorded, tmp_path)
    assert told.endswith(r"add --gym-packages ../x 'a\x1b[2Jb'")
    assert "\x1b" not in told


def test_worker_processes_of_a_training_know_the_modules(write):
    """Each environment lives in a process of its own, which begins without the user's modules."""
    from pipeline.environments import make_training_env
    from pipeline.settings.hyperparams import split
    from pipeline.train_spec import TrainSpec

    env = "gymnasium.register('my/Lake-v0', 'gymnasium.envs.toy_text:FrozenLakeEnv')"
    wrapper = "class Plain(gymnasium.Wrapper):\n    pass"
    write(my_first=f"import gymnasium\n{env}\n{wrapper}")
    raw = {"n_envs": 1, "env_wrapper": "my_first.Plain"}
    spec = TrainSpec("ppo", "my/Lake-v0", split(raw), raw, 0, vec_env="subproc")
    modules = import_typed(["my_first"])
    spec = dataclasses.replace(spec, user_modules=modules, gym_packages=("my_first",))
    env = make_training_env(spec, None)
    assert np.array_equal(env.reset(), [0])
    assert env.env_is_wrapped(sys.modules["my_first"].Plain) == [True]
    env.close()
