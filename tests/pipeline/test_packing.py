"""Packs: what is in them and what is not, that they verify, play elsewhere, and are no code."""

import base64
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml
from rich.console import Console

from pipeline.digests import sealed
from pipeline.errors import UserError
from pipeline.model_card import fenced
from pipeline.models.choose import ModelRequest, choose_model
from pipeline.packs import check_pack, default_target, pack, unpacked
from pipeline.scrubbing import check_untold, without_places, zip_to_tell
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train

SMALL = {"n_steps": 32, "batch_size": 32, "policy_kwargs": {"net_arch": [8]}}
LEARNER = {"learning_starts": 20, "buffer_size": 100, "policy_kwargs": {"net_arch": [8]}}


def trained(folder, env_id, algo, settings=(), n_timesteps=100, **fields):
    entry = {"n_timesteps": n_timesteps, **dict(settings)}
    common = {"seed": 7, "verbose": 0, "log_folder": folder, "eval_episodes": 3}
    spec = TrainSpec(algo, env_id, split(entry), entry, **{**common, "final_episodes": 4, **fields})
    return train(spec, Console(quiet=True), {"log_folder": str(folder)}, "train.py --token x").run


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A table on a map; PPO that wrote a TensorBoard log; DQN on normalised observations."""
    folder = tmp_path_factory.mktemp("home") / "private"
    lake = {"is_slippery": False}
    table = trained(folder, "FrozenLake-v1", "qlearning", {"env_kwargs": lake}, 3000)
    (table.path / "route.gif").write_bytes(b"GIF89a")
    table.add_file(table.path / "route.gif")
    small = {**SMALL, "n_timesteps": 64}
    ppo = trained(folder, "FrozenLake-v1", "ppo", small, tensorboard_log=folder / "tb")
    dqn = trained(folder, "CartPole-v1", "dqn", {**LEARNER, "normalize": True})
    return {"table": table, "ppo": ppo, "dqn": dqn}


@pytest.fixture
def packed(runs, tmp_path):
    """A pack of one of the runs, as a zip where asked for."""

    def make(name, target="pack"):
        return pack(runs[name].path, tmp_path / target)

    return make


def front_matter(folder):
    text = (folder / "README.md").read_text(encoding="utf-8")
    return yaml.safe_load(text.split("---\n")[1]), text


def code_in(text, language):
    (block,) = re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)
    return block


def test_the_card_says_what_the_run_came_to(packed, runs):
    folder = packed("table")
    final = json.loads((runs["table"].path / "run.json").read_text())["final"]
    data, text = front_matter(folder)
    assert data["library_name"] == "stable-baselines3"
    assert data["tags"] == ["FrozenLake-v1", "reinforcement-learning", "stable-baselines3"]
    (result,) = data["model-index"][0]["results"]
    assert data["model-index"][0]["name"] == "qlearning"
    assert result["task"]["type"] == "reinforcement-learning"
    assert result["dataset"] == {"name": "FrozenLake-v1", "type": "FrozenLake-v1"}
    values = {metric["type"]: metric["value"] for metric in result["metrics"]}
    assert values.pop("mean_reward") == "1.00 +/- 0.00"
    names = ("mean_return", "optimum", "gap", "score", "success_rate")
    assert values == {name: final[name] for name in names}
    assert final["mean_return"] == 1.0
    assert "computed exactly" in text
    assert "seed 7" in text
    assert f"| best random or constant policy | {final['baseline']} |" in text
    assert "3,000 environment steps" in text
    assert yaml.safe_load(code_in(text, "yaml"))["env_kwargs"] == {"is_slippery": False}
    pictures = re.findall(r"!\[[^]]*\]\(([^)]*)\)", text)
    assert pictures == ["replay.gif", "value_map.png", "learning_curve.png"]
    assert all((folder / name).is_file() for name in pictures)


def test_sampled_figures_are_called_so(packed):
    data, text = front_matter(packed("dqn"))
    assert "mean of 4 sampled episodes" in text
    assert "deep-reinforcement-learning" in data["tags"]
    assert json.loads((packed("dqn", "other") / "results.json").read_text())["n_eval_episodes"] == 4
    (result,) = data["model-index"][0]["results"]
    assert {"mean_reward", "mean_return"} <= {metric["type"] for metric in result["metrics"]}


def test_a_bracket_is_called_so(packed, runs):
    final = json.loads((runs["dqn"].path / "run.json").read_text())["final"]
    data, text = front_matter(packed("dqn"))
    for name, label in (
        ("optimum_at_least", "optimum, bracketed: what a policy was shown to reach"),
        ("optimum", "optimum, bracketed: what no policy exceeds"),
        ("score", "score (1: the bracket's upper end, 0: best random or constant policy)"),
    ):
        assert f"| {label} | {final[name]} |" in text
        (result,) = data["model-index"][0]["results"]
        assert {"type": name, "value": final[name], "name": label, "verified": False} in (
            result["metrics"]
        )
    assert "| optimum |" not in text


@pytest.mark.parametrize("target", ["pack", "pack.zip"])
def test_a_pack_verifies_and_plays_elsewhere(packed, runs, target):
    path = packed("dqn", target)
    assert check_pack(path) == len(list_of(path))
    with unpacked(path) as (folder, _):
        chosen = choose_model(ModelRequest(path=folder))
        assert (chosen.spec.algo, chosen.spec.env_id) == ("dqn", "CartPole-v1")
        assert chosen.statistics is not None
        assert chosen.file.content == runs["dqn"].model_path.read_bytes()


def list_of(path):
    if path.is_dir():
        return [file for file in path.rglob("*") if file.is_file()]
    return zipfile.ZipFile(path).namelist()


def test_packs_of_a_run_are_the_same_bytes(packed):
    assert packed("table", "a.zip").read_bytes() == packed("table", "b.zip").read_bytes()


@pytest.mark.parametrize("name", ["table", "ppo", "dqn"])
def test_nothing_of_the_machine_is_in_it(packed, runs, name):
    folder = packed(name)
    home = str(runs[name].path.parents[2])
    for path in list_of(folder):
        content = path.read_bytes()
        members = [content]
        if path.suffix == ".zip":
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                members += [archive.read(member) for member in archive.namelist()]
        for place in (home, str(Path.home()), "private", "--token", "args.txt"):
            assert not any(place.encode() in member for member in members), (path, place)
    record = json.loads((folder / "run.json").read_text())
    assert "machine" not in record
    assert record["spec"]["log_folder"] == "logs"
    assert not (folder / record["env_name"] / "command.txt").exists()
    if name == "ppo":  # whose own zip names the folder of the log
        assert b"private" in zipfile.ZipFile(runs[name].model_path).read("data")


def test_a_zip_that_names_no_log_is_the_runs_own(runs):
    content = runs["table"].model_path.read_bytes()
    assert zip_to_tell(content) is content


def test_paths_among_settings_are_names():
    settings = {"log": "/data/ann/pulls.csv", "a": ["C:\\data\\b.csv", "~/c.csv"], "d": "lin_0.1"}
    assert without_places(settings) == {"log": "pulls.csv", "a": ["b.csv", "c.csv"], "d": "lin_0.1"}


def changed(run, tmp_path, change):
    """A copy of a run in which something else is recorded."""
    copy = tmp_path / "copy"
    shutil.copytree(run.path, copy)
    info = json.loads((copy / "run.json").read_text())
    change(info)
    (copy / "run.json").write_text(json.dumps(sealed(info)))
    return copy


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda info: info.update(state="interrupted"), "is interrupted, and a pack is of a fin"),
        (lambda info: info.pop("spec"), "does not say what was trained: it is no run of ours"),
        (
            lambda info: info["spec"]["hyperparams"].update(env_kwargs={"api_key": "x"}),
            r"hyperparams.env_kwargs.api_key looks like a secret",
        ),
        (
            lambda info: info["spec"]["hyperparams"].update(note=f"see {Path.home()}/notes"),
            "names .*, a place on this machine: nothing was packed",
        ),
        (lambda info: info.update(n_timesteps="many"), "cannot be packed: Cannot specify ','"),
        (lambda info: info["final"].pop("std_return"), "cannot be packed: 'std_return'"),
    ],
)
def test_what_is_not_packed(runs, tmp_path, change, complaint):
    with pytest.raises(UserError, match=complaint):
        pack(changed(runs["table"], tmp_path, change), tmp_path / "pack")
    assert not (tmp_path / "pack").exists()
    assert list(tmp_path.glob(".*.tmp")) == []


@pytest.mark.parametrize("form", ["plain", "pickled"])
def test_zips_are_looked_into(runs, form):
    """Deflated, as some pack them, and in what is pickled as text."""
    place = f"{Path.home()}/notes".encode()
    pickled = b'{":serialized:": "' + base64.b64encode(place) + b'"}'
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", (place if form == "plain" else pickled) + bytes(1000))
    assert place not in stream.getvalue()
    with pytest.raises(UserError, match=r"model\.zip names"):
        check_untold({"model.zip": stream.getvalue()}, runs["table"])


def test_a_damaged_run_is_not_packed(runs, tmp_path):
    copy = changed(runs["table"], tmp_path, lambda info: None)
    (copy / "FrozenLake-v1.zip").write_bytes(b"other")
    with pytest.raises(UserError, match="is not as the run left it"):
        pack(copy, tmp_path / "pack")


def test_where_something_lies_already(packed, runs, tmp_path):
    folder = packed("table")
    with pytest.raises(UserError, match="is there already: name another place"):
        pack(runs["table"].path, folder)
    with pytest.raises(UserError, match="there is no folder"):
        pack(runs["table"].path, tmp_path / "no" / "pack")
    again = packed("ppo", "pack.zip")
    pack(runs["table"].path, again)  # a file is replaced
    with unpacked(again) as (inside, _):
        assert choose_model(ModelRequest(path=inside)).spec.algo == "qlearning"
    assert default_target(runs["table"].path) == Path("qlearning-FrozenLake-v1-7")


def test_a_card_quotes_what_a_strangers_run_says(runs, tmp_path):
    said = "\x1b]0;x\x07\u202e<script>[a](b:c)`$(id)`\n# d; id"

    def change(info):
        info["spec"].update(env_id=said, seed=said, gym_packages=[said])
        info["versions"] |= {"numpy": said, said: "1"}
        info["final"]["baseline"] = said

    pack(changed(runs["ppo"], tmp_path, change), tmp_path / "pack")
    parts = (tmp_path / "pack" / "README.md").read_text(encoding="utf-8").split("---\n", 2)
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", "".join(parts))
    outside = re.sub(r"^(`{3,})\w+\n.*?\n\1\n", "", parts[2], flags=re.DOTALL | re.MULTILINE)
    assert not re.search(r"(?<!\\)(<script|\[a\]|`\$)|^# d", outside, re.MULTILINE)
    for block in re.findall(r"^```sh\n(.*?)\n```\n", parts[2], re.DOTALL | re.MULTILINE):
        assert r"\x1b]0;x" in block
        assert "id" not in shlex.split(block)


# --- packs of strangers ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["README.md", "FrozenLake-v1.zip", "FrozenLake-v1/config.yml"])
@pytest.mark.parametrize("target", ["pack", "pack.zip"])
def test_a_changed_file_is_found(packed, name, target):
    path = packed("table", target)
    rewritten(path, {name: b"other"})
    with pytest.raises(UserError, match=rf"not as it was packed: {re.escape(name)} is not as"):
        check_pack(path)
    rewritten(path, {name: None})
    with pytest.raises(UserError, match=f"not as it was packed: {re.escape(name)} is missing"):
        check_pack(path)


def rewritten(path, changes, **infos):
    """Change files of a pack, leave some out (None), or add some with attributes of their own."""
    if path.is_dir():
        for name, content in changes.items():
            (path / name).unlink() if content is None else (path / name).write_bytes(content)
        return
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    files |= changes
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            if content is not None:
                info = zipfile.ZipInfo(name)
                info.external_attr = infos.get("mode", 0) << 16 if name in changes else 0
                info.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(info, content)


@pytest.mark.parametrize(
    "name",
    ["../evil", "/evil", "a/../../evil", "a/b/evil", "C:\\evil", "a\\..\\evil", "con", "a//b"],
)
def test_nothing_is_written_elsewhere(packed, tmp_path, name):
    path = packed("table", "pack.zip")
    rewritten(path, {name: b"evil"})
    with pytest.raises(UserError, match=r"is no pack that may be opened: holds .* lie elsewhere"):
        check_pack(path)
    assert not list(tmp_path.rglob("*evil*"))


def test_links_twins_and_what_nobody_listed(packed):
    for change, mode, complaint in [
        ({"link": b"/etc/passwd"}, stat.S_IFLNK | 0o777, "'link', which is no regular file"),
        ({"pipe": b""}, stat.S_IFIFO | 0o600, "'pipe', which is no regular file"),
        ({"folder/": b""}, 0, "'folder/', which would lie elsewhere"),
        ({"": b""}, 0, "'', which would lie elsewhere"),
        ({"readme.md": b""}, 0, "two names that some systems take for one"),
        ({"README.md/a": b""}, 0, "a file that is a folder too"),
        ({"more.py": b"print()"}, 0, "'more.py' is not among the files that run.json lists"),
    ]:
        path = packed("table", "pack.zip")
        rewritten(path, change, mode=mode)
        with pytest.raises(UserError, match=re.escape(complaint)):
            check_pack(path)


def test_bombs_and_damage(packed, tmp_path):
    path = packed("table", "pack.zip")
    rewritten(path, {"zeros": bytes(80 << 20)})
    with pytest.raises(UserError, match="would take more memory than"):
        check_pack(path)
    path = packed("table", "pack.zip")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    with pytest.raises(UserError, match="is no pack that may be opened"):
        check_pack(path)
    path = packed("table", "pack.zip")
    rewritten(path, {f"n{number}": b"" for number in range(1001)})
    with pytest.raises(UserError, match="is no pack that may be opened"):
        check_pack(path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"is no pack: it holds no run\.json"):
        check_pack(tmp_path / "empty")


def test_a_forged_record_leads_nowhere_else(packed, tmp_path):
    """Its digests fit, as a forger's would: what is listed has to lie in the pack."""
    (tmp_path / "secret").write_bytes(b"secret")
    folder = packed("table")
    record = json.loads((folder / "run.json").read_text())
    record["files"]["../secret"] = hashlib.sha256(b"secret").hexdigest()
    (folder / "run.json").write_text(json.dumps(sealed(record)))
    with pytest.raises(UserError, match="which would lie elsewhere"):
        check_pack(folder)


def test_a_pack_imports_nothing(packed, tmp_path, monkeypatch):
    folder = packed("table")
    record = json.loads((folder / "run.json").read_text())
    record["spec"]["gym_packages"] = ["evil_module"]
    (folder / "run.json").write_text(json.dumps(sealed(record)))
    (tmp_path / "evil_module.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserError, match="no module is imported because a file asks"):
        choose_model(ModelRequest(path=folder))
    assert "evil_module" not in sys.modules


def test_a_model_file_is_no_pack(runs):
    with unpacked(runs["table"].model_path) as (path, _):
        assert path == runs["table"].model_path


def test_a_fence_is_longer_than_what_stands_inside():
    assert fenced("yaml", "a: ```\n") == "````yaml\na: ```\n````\n"


# --- the script of the card -----------------------------------------------------------------------


def test_scripts_play_without_this_project(packed, tmp_path):
    """Both in one process, which takes its time to import; from the folders, as a reader would."""
    lines = ["import os, sys"]
    for name in ("ppo", "dqn"):
        folder = packed(name, name)
        script = code_in((folder / "README.md").read_text(encoding="utf-8"), "python")
        assert len(script.splitlines()) <= 11
        lines += [f"os.chdir({str(folder)!r})", script]
    lines.append("assert not {'agents', 'envs', 'pipeline', 'safe_files'} & sys.modules.keys()")
    program = tmp_path / "both.py"
    program.write_text("\n".join(lines))
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-I", str(program)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    returns = [float(line.split()[1]) for line in done.stdout.splitlines()]
    assert len(returns) == 2
    assert 0 <= returns[0] <= 1
    assert 8 <= returns[1] <= 500


def test_the_script_of_a_table(packed, monkeypatch, capsys):
    folder = packed("table")
    script = code_in((folder / "README.md").read_text(encoding="utf-8"), "python")
    monkeypatch.chdir(folder)
    exec(compile(script, "card", "exec"), {})  # noqa: S102  # our own, from the card
    assert capsys.readouterr().out == "return 1.00 +/- 0.00\n"


def test_where_a_script_would_not_do_there_is_none(runs, tmp_path):
    def wrap(info):
        info["spec"]["hyperparams"]["env_wrapper"] = "envs.wrappers.ScaleReward"

    folder = pack(changed(runs["ppo"], tmp_path, wrap), tmp_path / "pack")
    text = (folder / "README.md").read_text(encoding="utf-8")
    assert "```python" not in text
    assert "yardstick enjoy" in text
