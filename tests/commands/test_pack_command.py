"""``yardstick pack`` as a user types it, and ``enjoy.py`` with what it makes."""

import re
import shlex
import shutil
import sys
import zipfile

import gymnasium
import pytest

from commands import compare
from commands.compare import study_spec

pytestmark = pytest.mark.usefixtures("pictures")


@pytest.fixture
def lake(type_command):
    words = ("--algo", "qlearning", "--env", "FrozenLake-v1", "-n", "2000", "--seed", "3")
    assert type_command("train.py", *words, "--verbose", "0") == (0, "", "")
    return "logs/qlearning/FrozenLake-v1_1"


@pytest.mark.parametrize("target", ["there", "there.zip", None])
def test_a_run_is_packed_and_played(type_command, lake, tmp_path, target):
    code, out, err = type_command("pack", lake, *filter(None, [target]))
    named = target or "qlearning-FrozenLake-v1-3"
    assert (code, err) == (0, "")
    assert out.splitlines()[0] == f"pack  {named}"
    assert out.splitlines()[1].endswith(f" {named}")
    _, out, err = type_command("pack", named, "--check")
    assert (out, err) == (f"{named}: 8 files, each as it was packed\n", "")
    (tmp_path / "logs").rename(tmp_path / "elsewhere")
    code, out, err = type_command("enjoy.py", named, "--render", "none", "--n-episodes", "2")
    assert (code, err) == (0, "")
    assert out.startswith("qlearning on FrozenLake-v1: ")
    assert "(exact)" in out


def test_a_zip_is_found_without_its_suffix_and_a_folder_before_it(type_command, lake, tmp_path):
    type_command("pack", lake, "there.zip")
    play = ("enjoy.py", "there", "--render", "none", "--n-episodes", "1")
    assert type_command(*play)[1].startswith("qlearning on FrozenLake-v1: there\n")
    type_command("pack", lake, "there")
    folder = tmp_path / "there" / "FrozenLake-v1.zip"
    assert type_command(*play)[1].startswith(f"qlearning on FrozenLake-v1: {folder}\n")


def test_mistakes_end_in_one_line(type_command, lake, tmp_path):
    for words, complaint in [
        (("nothing",), "nothing: there is no such run folder or pack"),
        ((lake, "no/there"), "there is no folder no to write the pack in"),
        ((lake, lake), "is there already: name another place for the pack"),
        ((lake, "there", "--check"), "--check writes nothing: leave out there"),
        (("logs",), "it is no run of ours"),
    ]:
        code, out, err = type_command("pack", *words)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert complaint in err
    (tmp_path / "there.zip").write_bytes(b"PK\x05\x06" + bytes(18))
    code, _, err = type_command("pack", "there.zip", "--check")
    assert (code, err.count("\n")) == (2, 1)


CORRIDOR = """
import gymnasium
from my_cells import LENGTH

gymnasium.register("my/Corridor-v0", "my_corridor:Corridor", max_episode_steps=30)


class Corridor(gymnasium.Env):
    def __init__(self, render_mode=None):
        self.observation_space = gymnasium.spaces.Discrete(LENGTH)
        self.action_space, self.cell = gymnasium.spaces.Discrete(2), 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cell = 0
        return self.cell, {}

    def step(self, action):
        self.cell = max(self.cell + 2 * int(action) - 1, 0)
        return self.cell, -1.0, self.cell == LENGTH - 1, False, {}
"""


def test_a_study_with_a_module_of_ones_own_is_played_elsewhere(
    own_folder, type_in_own_folder, type_command, tmp_path, monkeypatch
):
    monkeypatch.chdir(own_folder)
    (own_folder / "my_corridor.py").write_text(CORRIDOR)
    (own_folder / "my_cells.py").write_text("LENGTH = 5\n")
    words = [
        "--env",
        "my/Corridor-v0",
        "--algos",
        "qlearning",
        "random",
        "--seeds",
        "1",
        "-n",
        "200",
    ]
    words += ["--gym-packages", "./my_corridor.py", "--name", "mine", "--no-report"]
    code, _, err = type_in_own_folder("compare.py", *words)
    assert (code, err) == (0, "")
    code, out, err = type_command("pack", "logs/studies/mine", "mine.zip")
    assert (code, err) == (0, "")
    assert "code of yours is in it: modules/my_cells.py modules/my_corridor.py\n" in out
    told = shlex.split(out.partition("in its folder: ")[2])
    elsewhere = tmp_path / "elsewhere"
    with zipfile.ZipFile("mine.zip") as archive:
        archive.extractall(elsewhere)
    (own_folder / "mine.zip").rename(tmp_path / "mine.zip")
    shutil.rmtree(own_folder)
    for name in ("my_corridor", "my_cells"):
        sys.modules.pop(name, None)
    gymnasium.registry.pop("my/Corridor-v0", None)
    monkeypatch.setattr(sys, "meta_path", [f for f in sys.meta_path if not hasattr(f, "names")])
    monkeypatch.chdir(elsewhere)
    assert told[:2] == ["yardstick", "enjoy"]
    play = (*told[2:], "--n-episodes", "1", "--render", "none")
    code, _, err = type_command("enjoy.py", *told[2:3])
    assert code == 2
    assert err.endswith("if you trust them add --gym-packages ./modules/my_corridor.py\n")
    code, _, err = type_command("enjoy.py", tmp_path / "mine.zip" / told[2])
    assert err.endswith(
        "unzip it, read them, and if you trust them add, there, --gym-packages "
        "modules/my_corridor.py\n"
    )
    assert "my_corridor" not in sys.modules
    code, out, err = type_command("enjoy.py", *play)
    assert (code, err) == (0, "")
    assert "my_cells" in sys.modules
    command = re.search("yardstick compare (.*)", (elsewhere / "README.md").read_text())[1]
    args = compare.build_parser().parse_args(shlex.split(command))
    study = study_spec(args)
    assert [agent.settings["n_timesteps"] for agent in study.agents] == [200, 200]


def test_a_package_that_drawing_lacks_is_one_line(type_command, lake, monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    type_command("pack", lake, "there.zip")
    film = ("enjoy.py", "there.zip", "--record", "film.gif", "--n-episodes", "1")
    code, _, err = type_command(*film)
    assert (code, len(err.splitlines())) == (2, 1)
    assert err.startswith("enjoy.py: error: FrozenLake-v1: pygame is not installed")
    code, _, err = type_command("pack", "there.zip", "other")
    assert (code, err) == (2, "pack: error: there.zip is a file: name the folder of a run\n")
