"""``yardstick pack``, and ``enjoy.py`` with what it makes."""

import shlex
import shutil
import sys
import zipfile

import gymnasium
import pytest

pytestmark = pytest.mark.usefixtures("pictures")


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
    words = "--env my/Corridor-v0 --algos qlearning random --seeds 1 -n 200 --name mine --no-report"
    own = ("--gym-packages", "./my_corridor.py")
    code, _, err = type_in_own_folder("compare.py", *words.split(), *own)
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
    said = "if you trust them add"
    for place, ends in (
        (told[2], f"{said} --gym-packages ./modules/my_corridor.py\n"),
        (
            tmp_path / "mine.zip" / told[2],
            f"unzip it, read them, and {said}, there, --gym-packages modules/my_corridor.py\n",
        ),
    ):
        code, _, err = type_command("enjoy.py", place)
        assert (code, err.endswith(ends)) == (2, True)
    assert "my_corridor" not in sys.modules
    code, out, err = type_command("enjoy.py", *told[2:], "--n-episodes", "1", "--render", "none")
    assert (code, err) == (0, "")
    assert "my_cells" in sys.modules
