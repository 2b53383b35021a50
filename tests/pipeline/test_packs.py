"""Packs of runs and studies: what is in them, that they verify and play elsewhere, and no code."""

import base64
import csv
import gzip
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

from pipeline.digests import LOCK, sealed
from pipeline.errors import UserError
from pipeline.locks import mark
from pipeline.model_card import fenced
from pipeline.models.choose import ModelRequest, choose_model
from pipeline.packs import check_pack, default_target, is_study, pack, pack_study, unpacked
from pipeline.scrubbing import check_untold, without_places, zip_to_tell
from pipeline.settings.hyperparams import split
from pipeline.train_spec import TrainSpec
from pipeline.training import train
from safe_files.files import UnsafeFileError

HOME = str(Path.home())
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
    return lambda name, target="pack": pack(runs[name].path, tmp_path / target)


def front_matter(folder):
    text = (folder / "README.md").read_text(encoding="utf-8")
    return yaml.safe_load(text.split("---\n")[1]), text


def code_in(text, language):
    (block,) = re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)
    return block


def members(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


# --- the pack of a run ---------------------------------------------------------------------------


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
    for said in (
        *("computed exactly", "seed 7", "3,000 environment steps"),
        f"| best random or constant policy | {final['baseline']} |",
    ):
        assert said in text
    assert yaml.safe_load(code_in(text, "yaml"))["env_kwargs"] == {"is_slippery": False}
    pictures = re.findall(r"!\[[^]]*\]\(([^)]*)\)", text)
    assert pictures == ["replay.gif", "value_map.png", "learning_curve.png"]
    assert all((folder / name).is_file() for name in pictures)


def test_sampled_figures_and_brackets_are_called_so(packed, runs):
    folder = packed("dqn")
    final = json.loads((runs["dqn"].path / "run.json").read_text())["final"]
    data, text = front_matter(folder)
    assert "mean of 4 sampled episodes" in text
    assert "deep-reinforcement-learning" in data["tags"]
    assert json.loads((folder / "results.json").read_text())["n_eval_episodes"] == 4
    (result,) = data["model-index"][0]["results"]
    assert {"mean_reward", "mean_return"} <= {metric["type"] for metric in result["metrics"]}
    for name, label in (
        ("optimum_at_least", "optimum, bracketed: what a policy was shown to reach"),
        ("optimum", "optimum, bracketed: what no policy exceeds"),
        ("score", "score (1: the bracket's upper end, 0: best random or constant policy)"),
    ):
        assert f"| {label} | {final[name]} |" in text
        metric = {"type": name, "value": final[name], "name": label, "verified": False}
        assert metric in result["metrics"]
    assert "| optimum |" not in text


@pytest.mark.parametrize("target", ["pack", "pack.zip"])
def test_a_pack_verifies_and_plays_elsewhere(packed, runs, target):
    path = packed("dqn", target)
    names = [file for file in path.rglob("*") if file.is_file()] or members(path)
    assert check_pack(path) == len(names)
    with unpacked(path) as (folder, _):
        chosen = choose_model(ModelRequest(path=folder))
        assert (chosen.spec.algo, chosen.spec.env_id) == ("dqn", "CartPole-v1")
        assert chosen.statistics is not None
        assert chosen.file.content == runs["dqn"].model_path.read_bytes()


def test_packs_of_a_run_are_the_same_bytes(packed):
    assert packed("table", "a.zip").read_bytes() == packed("table", "b.zip").read_bytes()


@pytest.mark.parametrize("name", ["table", "ppo", "dqn"])
def test_nothing_of_the_machine_is_in_it(packed, runs, name):
    folder = packed(name)
    home = str(runs[name].path.parents[2])
    for path in filter(Path.is_file, folder.rglob("*")):
        inside = members(path).values() if path.suffix == ".zip" else ()
        for place in (home, HOME, "private", "--token", "args.txt"):
            for content in (path.read_bytes(), *inside):
                assert place.encode() not in content, (path, place)
    record = json.loads((folder / "run.json").read_text())
    assert "machine" not in record
    assert record["spec"]["log_folder"] == "logs"
    assert not (folder / record["env_name"] / "command.txt").exists()
    content = runs[name].model_path.read_bytes()
    if name == "ppo":  # whose own zip names the folder of the log
        assert b"private" in members(runs[name].model_path)["data"]
    elif name == "table":
        assert zip_to_tell(content) is content


def test_paths_among_settings_are_names():
    settings = {"log": "/data/ann/pulls.csv", "a": ["C:\\data\\b.csv", "~/c.csv"], "d": "lin_0.1"}
    assert without_places(settings) == {"log": "pulls.csv", "a": ["b.csv", "c.csv"], "d": "lin_0.1"}


@pytest.fixture
def changed(tmp_path):
    """Makes a copy of a run in which something else is recorded."""

    def make(run, change):
        copy = tmp_path / "copy"
        shutil.copytree(run.path, copy)
        info = json.loads((copy / "run.json").read_text())
        change(info)
        (copy / "run.json").write_text(json.dumps(sealed(info)))
        return copy

    return make


def settings_of(info):
    return info["spec"]["hyperparams"]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda info: info.update(state="interrupted"), "is interrupted, and a pack is of a fin"),
        (lambda info: info.pop("spec"), "does not say what was trained: it is no run of ours"),
        (
            lambda info: settings_of(info).update(env_kwargs={"api_key": "x"}),
            r"hyperparams.env_kwargs.api_key looks like a secret",
        ),
        (
            lambda info: settings_of(info).update(note=f"see {HOME}/notes"),
            "names .*, a place on this machine: nothing was packed",
        ),
        (lambda info: info.update(n_timesteps="many"), "cannot be packed: Cannot specify ','"),
        (lambda info: info["final"].pop("std_return"), "cannot be packed: 'std_return'"),
    ],
)
def test_what_is_not_packed(runs, changed, tmp_path, change, complaint):
    with pytest.raises(UserError, match=complaint):
        pack(changed(runs["table"], change), tmp_path / "pack")
    assert not (tmp_path / "pack").exists()
    assert list(tmp_path.glob(".*.tmp")) == []


def test_a_damaged_run_is_not_packed(runs, changed, tmp_path):
    copy = changed(runs["table"], lambda info: None)
    (copy / "FrozenLake-v1.zip").write_bytes(b"other")
    with pytest.raises(UserError, match="is not as the run left it"):
        pack(copy, tmp_path / "pack")


@pytest.mark.parametrize("form", ["plain", "pickled"])
def test_zips_are_looked_into(runs, form):
    """Deflated, as some pack them, and in what is pickled as text."""
    place = f"{HOME}/notes".encode()
    pickled = b'{":serialized:": "' + base64.b64encode(place) + b'"}'
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data", (place if form == "plain" else pickled) + bytes(1000))
    assert place not in stream.getvalue()
    with pytest.raises(UserError, match=r"model\.zip names"):
        check_untold({"model.zip": stream.getvalue()}, runs["table"])


def test_where_something_lies_already(packed, runs, tmp_path):
    table = runs["table"].path
    with pytest.raises(UserError, match="is there already: name another place"):
        pack(table, packed("table"))
    with pytest.raises(UserError, match="there is no folder"):
        pack(table, tmp_path / "no" / "pack")
    again = packed("ppo", "pack.zip")
    pack(table, again)  # a file is replaced
    with unpacked(again) as (inside, _):
        assert choose_model(ModelRequest(path=inside)).spec.algo == "qlearning"
    assert default_target(table) == Path("qlearning-FrozenLake-v1-7")


def test_a_card_quotes_what_a_strangers_run_says(runs, changed, tmp_path):
    said = "\x1b]0;x\x07\u202e<script>[a](b:c)`$(id)`\n# d; id"

    def change(info):
        info["spec"].update(env_id=said, seed=said, gym_packages=[said])
        info["versions"] |= {"numpy": said, said: "1"}
        info["final"]["baseline"] = said

    pack(changed(runs["ppo"], change), tmp_path / "pack")
    parts = (tmp_path / "pack" / "README.md").read_text(encoding="utf-8").split("---\n", 2)
    assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", "".join(parts))
    outside = re.sub(r"^(`{3,})\w+\n.*?\n\1\n", "", parts[2], flags=re.DOTALL | re.MULTILINE)
    assert not re.search(r"(?<!\\)(<script|\[a\]|`\$)|^# d", outside, re.MULTILINE)
    for block in re.findall(r"^```sh\n(.*?)\n```\n", parts[2], re.DOTALL | re.MULTILINE):
        assert r"\x1b]0;x" in block
        assert "id" not in shlex.split(block)
    assert fenced("yaml", "a: ```\n") == "````yaml\na: ```\n````\n"


def test_scripts_play_without_this_project(packed, tmp_path):
    """All in one process, which takes its time to import; from the folders, as a reader would."""
    lines = ["import os, sys"]
    for name in ("ppo", "dqn", "table"):
        folder = packed(name, name)
        script = code_in((folder / "README.md").read_text(encoding="utf-8"), "python")
        assert len(script.splitlines()) <= (99 if name == "table" else 11)
        if name == "table":  # whose agent is of this project
            lines.append("assert not {'agents', 'envs', 'pipeline', 'safe_files'} & {*sys.modules}")
        lines += [f"os.chdir({str(folder)!r})", script]
    program = tmp_path / "all.py"
    program.write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, "-I", str(program)],
        capture_output=True,
        text=True,
        env={name: text for name, text in os.environ.items() if name != "PYTHONPATH"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lake, pole, table = done.stdout.splitlines()
    assert 0 <= float(lake.split()[1]) <= 1
    assert 8 <= float(pole.split()[1]) <= 500
    assert table == "return 1.00 +/- 0.00"


def test_where_a_script_would_not_do_there_is_none(runs, changed, tmp_path):
    def wrap(info):
        settings_of(info)["env_wrapper"] = "envs.wrappers.ScaleReward"

    _, text = front_matter(pack(changed(runs["ppo"], wrap), tmp_path / "pack"))
    assert "```python" not in text
    assert "yardstick enjoy" in text


# --- the pack of a study -------------------------------------------------------------------------

RUN, SARSA = "runs/qlearning/FrozenLake-v1_2.zip", "runs/sarsa/FrozenLake-v1_1"


@pytest.fixture
def study(runs, tmp_path):
    """The folder of a study, as compare.py leaves it, by a command that was typed at home."""
    root = tmp_path / "a study"
    for place in (
        "qlearning/FrozenLake-v1_1",
        "qlearning/FrozenLake-v1_2",
        "sarsa/FrozenLake-v1_1",
    ):
        shutil.copytree(runs["table"].path, root / "runs" / place)
    shutil.copytree(runs["table"].path, root / "runs/sarsa/FrozenLake-v1_1.damaged-1")
    command = f"python {HOME}/code/compare.py --env-kwargs desc:{HOME}/map.txt"
    data = gzip.compress(json.dumps({"command": command}).encode(), mtime=0)
    script = f"<script id='x'>{base64.b64encode(data).decode()}</script>"
    page = f"<p>{command}</p><script>let a = '/home'</script>{script}"
    (root / "report.html").write_text(page)
    (root / "summary.csv").write_text(f"agent,path\nq,{HOME}/a/runs/qlearning/FrozenLake-v1_1\n")
    (root / "study.yml").write_text("agents: [qlearning]\n")
    taken, left = ("figures/a.png", "learning/a/b.html"), ("figures/notes.txt", "failures/a.txt")
    for name in (*taken, *left, "mine.html", "looks.json"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")
    return root


@pytest.fixture
def packed_study(study, tmp_path):
    pack_study(study, tmp_path / "study.zip", print)
    return tmp_path / "study.zip"


def test_a_study_holds_what_others_need_and_nothing_of_this_machine(study, packed_study, tmp_path):
    files = members(packed_study)
    runs = [RUN, RUN.replace("_2", "_1"), "runs/sarsa/FrozenLake-v1_1.zip"]
    names = "README.md report.html summary.csv study.yml figures/a.png learning/a/b.html study.json"
    assert files.keys() == {*runs, *names.split()}
    page = files["report.html"].decode()
    told = "python compare.py --env-kwargs desc:map.txt"
    assert re.findall("<p>(.*?)</p><script>(.*?)</script>", page) == [(told, "let a = '/home'")]
    data = re.search("<script id='x'>(.*)</script>", page)[1]
    assert json.loads(gzip.decompress(base64.b64decode(data))) == {"command": told}
    rows = list(csv.DictReader(io.StringIO(files["summary.csv"].decode())))
    assert [row["path"] for row in rows] == ["runs/qlearning/FrozenLake-v1_1.zip"]
    card = files["README.md"].decode()
    assert "3 runs" in card
    assert "| qlearning | FrozenLake-v1 | 2 | runs/qlearning/FrozenLake-v1_1.zip |" in card
    assert check_pack(packed_study) == len(files)
    before = packed_study.read_bytes()
    pack_study(study, packed_study, print)
    assert packed_study.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a study", "study.zip"]
    assert not (study / LOCK).exists()


@pytest.mark.parametrize("inside", [RUN, RUN.removesuffix(".zip")])
def test_a_run_in_a_study_is_played(packed_study, inside):
    with unpacked(packed_study / inside) as (folder, zipped_in):
        chosen = choose_model(ModelRequest(path=folder, zipped_in=zipped_in))
        assert (chosen.spec.algo, chosen.spec.env_id) == ("qlearning", "FrozenLake-v1")
        assert zipped_in == packed_study
    assert not folder.exists()
    for path in (packed_study, packed_study / "runs" / "x"):
        with pytest.raises(UserError, match=r"such as .*study\.zip/runs/qlearning/FrozenLake-v1_1"):
            unpacked(path).__enter__()


def outside(path, secret):
    path.unlink()
    path.symlink_to(secret)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda root, _: shutil.rmtree(root / "runs"), "holds no finished run"),
        (lambda root, secret: outside(root / "report.html", secret), r"html .* link"),
        (lambda root, secret: outside(root / "figures/a.png", secret), r"png .* link"),
        (lambda root, secret: outside(root / SARSA / "run.json", secret), r"json .* link"),
        (lambda root, _: os.mkfifo(root / "verdicts.md"), "is no regular file"),
        (lambda root, _: (root / SARSA / "FrozenLake-v1.zip").write_bytes(b""), "is not as the ru"),
        (lambda root, _: (root / "summary.csv").write_text("a,b\n"), "summary.csv is damaged"),
        (
            lambda root, _: (root / "curves.csv.gz").write_bytes(gzip.compress(HOME.encode())),
            r"curves\.csv\.gz names .* nothing was packed",
        ),
        (
            lambda root, _: (root / "figures/a.png").write_text(f"{HOME}/x"),
            r"figures/a\.png names .* nothing was packed",
        ),
        (
            lambda root, _: (root / LOCK).write_text(json.dumps({**mark(), "token": "x"})),
            "is at work on it",
        ),
    ],
)
def test_what_is_not_packed_of_a_study(study, tmp_path, change, complaint):
    (tmp_path / "secret").write_text("secret")
    change(study, tmp_path / "secret")
    with pytest.raises((UserError, UnsafeFileError), match=complaint):
        pack_study(study, tmp_path / "study.zip", print)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a study", "secret"]


def test_a_folder_is_no_place_for_a_study(study, tmp_path):
    with pytest.raises(UserError, match=r"name it there\.zip"):
        pack_study(study, tmp_path / "there", print)
    with pytest.raises(UserError, match="there is no folder"):
        pack_study(study, tmp_path / "no" / "there.zip", print)
    assert is_study(study)
    assert not is_study(study / "runs/qlearning/FrozenLake-v1_1")


# --- packs of strangers --------------------------------------------------------------------------


def rewritten(path, changes, mode=0):
    """Change files of a pack, leave some out (None), or add some with attributes of their own."""
    if path.is_dir():
        for name, content in changes.items():
            (path / name).unlink() if content is None else (path / name).write_bytes(content)
        return
    files = {**members(path), **changes}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            if content is not None:
                info = zipfile.ZipInfo(name)
                info.external_attr = mode << 16 if name in changes else 0
                archive.writestr(info, content, zipfile.ZIP_DEFLATED)


def forged(path, changes, mode=0):
    """Change a study's pack, with digests that fit, as a forger's would."""
    files = {**members(path), **changes}
    digests = {n: hashlib.sha256(c).hexdigest() for n, c in files.items() if n != "study.json"}
    rewritten(path, {**changes, "study.json": json.dumps({"files": digests}).encode()}, mode)


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


@pytest.mark.parametrize(
    "changes",
    [{"report.html": b"other"}, {"more.py": b""}, {"study.json": b"[]"}, {"study.json": b"{"}],
)
def test_what_was_changed_in_a_study_is_found(packed_study, changes):
    rewritten(packed_study, changes)
    with pytest.raises(UserError, match="is not as it was packed"):
        check_pack(packed_study)


ELSEWHERE = ["../evil", "/evil", "a/../../evil", "a/b/evil", "C:\\evil", "a\\..\\evil", "con"]
ODD = [
    *(({name: b"evil"}, 0, f"{name!r}, which would lie elsewhere") for name in ELSEWHERE),
    *(({name: b""}, 0, f"{name!r}, which would lie elsewhere") for name in ("folder/", "", "a//b")),
    ({"link": b"/etc/passwd"}, stat.S_IFLNK | 0o777, "'link', which is no regular file"),
    ({"pipe": b""}, stat.S_IFIFO | 0o600, "'pipe', which is no regular file"),
    ({"readme.md": b""}, 0, "two names that some systems take for one"),
    ({"README.md/a": b""}, 0, "a file that is a folder too"),
    ({"more.py": b"print()"}, 0, "'more.py' is not among the files that run.json lists"),
    ({"zeros": bytes(80 << 20)}, 0, "would take more memory than"),
    ({f"n{number}": b"" for number in range(1001)}, 0, "is no pack that may be opened"),
]


def test_nothing_is_written_elsewhere_and_nothing_odd_is_opened(packed, tmp_path):
    for changes, mode, complaint in ODD:
        path = packed("table", "pack.zip")
        rewritten(path, changes, mode)
        with pytest.raises(UserError, match=re.escape(complaint)):
            check_pack(path)
        assert not list(tmp_path.rglob("*evil*"))
    path = packed("table", "pack.zip")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    with pytest.raises(UserError, match="is no pack that may be opened"):
        check_pack(path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"is no pack: it holds no run\.json"):
        check_pack(tmp_path / "empty")


@pytest.mark.parametrize(
    ("changes", "mode", "complaint"),
    [
        ({"../odd": b""}, 0, "'../odd', which would lie elsewhere"),
        ({"/odd": b""}, 0, "'/odd', which would lie elsewhere"),
        ({"runs/a/b/odd": b""}, 0, "'runs/a/b/odd', which would lie elsewhere"),
        ({"runs/odd": b"/etc/passwd"}, stat.S_IFLNK | 0o777, "which is no regular file"),
        ({"readme.md": b""}, 0, "two names that some systems take for one"),
        ({RUN: bytes(90 << 20)}, 0, "would take more memory than"),
        ({RUN: b"PK"}, 0, "is no pack that may be opened"),
    ],
)
def test_hostile_packs_of_studies_are_refused(packed_study, tmp_path, changes, mode, complaint):
    forged(packed_study, changes, mode)
    if changes != {RUN: b"PK"}:
        with pytest.raises(UserError, match=complaint):
            check_pack(packed_study)
    with pytest.raises(UserError, match=complaint):
        unpacked(packed_study / RUN).__enter__()
    assert not list(tmp_path.rglob("*odd*"))


def test_what_a_zip_says_of_its_size_is_not_believed(packed_study):
    """A member that says of itself that it takes a gigabyte before it is unpacked, too."""
    forged(packed_study, {RUN: bytes(90 << 20)})
    content = bytearray(packed_study.read_bytes())
    place = content.rindex(RUN.encode(), 0, content.rindex(b"PK\5\6")) - 46
    assert content[place : place + 4] == b"PK\1\2"
    content[place + 20 : place + 24] = (1 << 30).to_bytes(4, "little")
    packed_study.write_bytes(content)
    with pytest.raises(UserError, match="would take more memory than"):
        unpacked(packed_study / RUN).__enter__()


def test_a_forged_record_leads_nowhere_else_and_imports_nothing(packed, tmp_path, monkeypatch):
    """Its digests fit, as a forger's would: what is listed has to lie in the pack."""
    (tmp_path / "secret").write_bytes(b"secret")
    (tmp_path / "evil_module.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    folder = packed("table")
    record = json.loads((folder / "run.json").read_text())
    record["spec"]["gym_packages"] = ["evil_module"]
    (folder / "run.json").write_text(json.dumps(sealed(record)))
    with pytest.raises(UserError, match="no module is imported because a file asks"):
        choose_model(ModelRequest(path=folder))
    assert "evil_module" not in sys.modules
    record["files"]["../secret"] = hashlib.sha256(b"secret").hexdigest()
    (folder / "run.json").write_text(json.dumps(sealed(record)))
    with pytest.raises(UserError, match="which would lie elsewhere"):
        check_pack(folder)


def test_a_model_file_is_no_pack(runs):
    with unpacked(runs["table"].model_path) as (path, _):
        assert path == runs["table"].model_path
