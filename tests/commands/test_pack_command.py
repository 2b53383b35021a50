"""``yardstick pack`` as a user types it, and ``enjoy.py`` with what it makes."""

import sys

import pytest

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


def test_a_package_that_drawing_lacks_is_one_line(type_command, lake, monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    type_command("pack", lake, "there.zip")
    film = ("enjoy.py", "there.zip", "--record", "film.gif", "--n-episodes", "1")
    code, _, err = type_command(*film)
    assert (code, len(err.splitlines())) == (2, 1)
    assert err.startswith("enjoy.py: error: FrozenLake-v1: pygame is not installed")
    code, _, err = type_command("pack", "there.zip", "other")
    assert (code, err) == (2, "pack: error: there.zip is a file: name the folder of a run\n")
