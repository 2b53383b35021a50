"""Packs of runs and studies: what is in them, that they verify and play elsewhere, and no code."""

import base64
import csv
import gzip
import hashlib
import io
import json
import re
import shlex
import shutil
import stat
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

from rl_yardstick.pipeline.digests import LOCK, sealed
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.model_card import fenced
from rl_yardstick.pipeline.models.choose import ModelRequest
from rl_yardstick.pipeline.packs import check_pack, is_study, pack, pack_study, unpacked
from tests.pipeline.short_runs import CART, LAKE, choose_model, trained

HOME = str(Path.home())
SMALL = {"n_steps": 32, "batch_size": 32, "policy_kwargs": {"net_arch": [8]}}
LEARNER = {"learning_starts": 20, "buffer_size": 100, "policy_kwargs": {"net_arch": [8]}}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A table on a map; PPO that wrote a TensorBoard log; DQN on normalised observations."""
    folder = tmp_path_factory.mktemp("home") / "private"
    common = {"seed": 7, "log_folder": folder, "eval_episodes": 3, "final_episodes": 4}
    common |= {"command": "train.py --token x"}
    dry = {"env_kwargs": {"is_slippery": False}}
    table = trained("qlearning", LAKE, dry, n_timesteps=3000, pictures=True, **common).run
    (table.path / "route.gif").write_bytes(b"GIF89a")
    table.add_file(table.path / "route.gif")
    ppo = trained("ppo", LAKE, SMALL, n_timesteps=64, tensorboard_log=folder / "tb", **common).run
    dqn = trained("dqn", CART, {**LEARNER, "normalize": True}, n_timesteps=100, **common).run
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
    (index,) = data["model-index"]
    (result,) = index["results"]
    values = {metric["type"]: metric["value"] for metric in result["metrics"]}
    assert (data["library_name"], index["name"]) == ("stable-baselines3", "qlearning")
    assert data["tags"] == ["FrozenLake-v1", "reinforcement-learning", "stable-baselines3"]
    assert result["task"]["type"] == "reinforcement-learning"
    assert result["dataset"] == {"name": "FrozenLake-v1", "type": "FrozenLake-v1"}
    assert values.pop("mean_reward") == "1.00 +/- 0.00"
    assert values == {
        name: final[name] for name in ("mean_return", "optimum", "gap", "score", "success_rate")
    }
    row = f"| best random or constant policy | {final['baseline']} |"
    assert all(said in text for said in ("computed exactly", "seed 7", "3,000 environment ", row))
    assert yaml.safe_load(code_in(text, "yaml"))["env_kwargs"] == {"is_slippery": False}
    pictures = re.findall(r"!\[[^]]*\]\(([^)]*)\)", text)
    assert pictures == ["replay.gif", "value_map.png", "learning_curve.png"]
    assert all((folder / name).is_file() for name in pictures)


def test_a_pack_verifies_and_plays_elsewhere_and_has_the_same_bytes_each_time(packed, runs):
    path = packed("dqn", "pack.zip")
    assert check_pack(path) == len(members(path))
    with unpacked(path) as (folder, _):
        chosen = choose_model(ModelRequest(path=folder))
        assert (chosen.spec.algo, chosen.spec.env_id) == ("dqn", "CartPole-v1")
        assert chosen.statistics is not None
        assert chosen.file.content == runs["dqn"].model_path.read_bytes()
    assert packed("dqn", "again.zip").read_bytes() == path.read_bytes()
    pack(runs["table"].path, path)  # a file is replaced
    with unpacked(path) as (folder, _):
        assert choose_model(ModelRequest(path=folder)).spec.algo == "qlearning"
    with unpacked(runs["table"].model_path) as (path, _):  # which is no pack
        assert path == runs["table"].model_path


def test_nothing_of_the_machine_is_in_it(packed, runs):
    folder, run = packed("ppo"), runs["ppo"]
    assert b"private" in members(run.model_path)["data"]  # the folder of its log
    home = str(run.path.parents[2])
    for path in filter(Path.is_file, folder.rglob("*")):
        inside = members(path).values() if path.suffix == ".zip" else ()
        for place in (home, HOME, "private", "--token", "args.txt"):
            for content in (path.read_bytes(), *inside):
                assert place.encode() not in content, (path, place)
    record = json.loads((folder / "run.json").read_text())
    assert "machine" not in record
    assert record["spec"]["log_folder"] == "logs"


@pytest.fixture
def changed(tmp_path):
    """Makes a copy of a run in which something else is recorded."""

    def make(run, change):
        copy = tmp_path / "copy"
        shutil.copytree(run.path, copy)
        info = json.loads((copy / "run.json").read_text())
        change(info, info["spec"]["hyperparams"])
        (copy / "run.json").write_text(json.dumps(sealed(info)))
        return copy

    return make


WRONG_DIGEST = {"FrozenLake-v1.zip": "0" * 64}
NOT_PACKED = {
    "is interrupted: only finished runs can": lambda info, _: info.update(state="interrupted"),
    "kwargs.api_key looks like a secret": lambda _, set_: set_.update(env_kwargs={"api_key": "x"}),
    "names .*, a place on this machine": lambda _, set_: set_.update(note=f"see {HOME}/notes"),
    "cannot be packed: 'std_return'": lambda info, _: info["final"].pop("std_return"),
    "has changed since the run wrote it": lambda info, _: info["files"].update(WRONG_DIGEST),
}


@pytest.mark.parametrize("complaint", NOT_PACKED)
def test_what_is_not_packed(runs, changed, tmp_path, complaint):
    with pytest.raises(UserError, match=complaint):
        pack(changed(runs["table"], NOT_PACKED[complaint]), tmp_path / "pack")
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_a_card_quotes_what_a_strangers_run_says(runs, changed, tmp_path):
    said = "\x1b]0;x\x07\u202e<script>[a](b:c)`$(id)`\n# d; id"

    def change(info, _):
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


@pytest.mark.parametrize(("name", "least", "is_ours"), [("dqn", 8, False), ("table", 1, True)])
def test_scripts_play_and_name_this_project_only_where_the_agent_is_of_it(
    packed, monkeypatch, capsys, name, least, is_ours
):
    """From the folder, as a reader would."""
    monkeypatch.chdir(packed(name))
    script = code_in(Path("README.md").read_text(encoding="utf-8"), "python")
    exec(script, {"__name__": "__main__"})  # noqa: S102  # of a pack of ours
    assert least <= float(capsys.readouterr().out.split()[1]) <= 500
    assert ("agents" in script) == is_ours
    assert not re.search("envs |pipeline|safe_files", script)


# --- the pack of a study -------------------------------------------------------------------------

RUN, SARSA = "runs/qlearning/FrozenLake-v1_2.zip", "runs/sarsa/FrozenLake-v1_1"


@pytest.fixture
def study(runs, tmp_path):
    """The folder of a study, as compare.py leaves it, by a command that was typed at home."""
    root = tmp_path / "a study"
    places = [RUN.replace("_2.zip", "_1"), RUN.removesuffix(".zip"), SARSA, f"{SARSA}.damaged-1"]
    for place in places:
        shutil.copytree(runs["table"].path, root / place)
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
    assert [is_study(study), is_study(study / "runs/qlearning/FrozenLake-v1_1")] == [True, False]


def test_a_run_in_a_study_is_played(packed_study):
    for inside in (RUN, RUN.removesuffix(".zip")):
        with unpacked(packed_study / inside) as (folder, zipped_in):
            chosen = choose_model(ModelRequest(path=folder, zipped_in=zipped_in))
            assert (chosen.spec.algo, chosen.spec.env_id) == ("qlearning", "FrozenLake-v1")
            assert zipped_in == packed_study
        assert not folder.exists()
    with pytest.raises(UserError, match=r"such as .*study\.zip/runs/qlearning/FrozenLake-v1_1"):
        unpacked(packed_study).__enter__()


def test_runs_of_one_pack_were_trained_with_the_same_modules(study, tmp_path):
    folders = study / RUN.removesuffix(".zip"), study / SARSA

    def put(folder, text):
        (folder / "modules").mkdir(exist_ok=True)
        (folder / "modules" / "own.py").write_text(text)
        info = json.loads((folder / "run.json").read_text())
        info["files"]["modules/own.py"] = hashlib.sha256(text.encode()).hexdigest()
        (folder / "run.json").write_text(json.dumps(sealed(info)))

    for folder in folders:
        put(folder, "a = 1")
    pack_study(study, tmp_path / "study.zip", print)
    assert members(tmp_path / "study.zip")["modules/own.py"] == b"a = 1"
    put(folders[1], "a = 2")
    with pytest.raises(UserError, match=r"was trained with another modules/own\.py than"):
        pack_study(study, tmp_path / "study.zip", print)


def test_what_is_not_packed_of_a_study(study, tmp_path):
    (study / "figures/a.png").write_text(f"{HOME}/x")
    with pytest.raises(UserError, match=r"a\.png names .* nothing was"):
        pack_study(study, tmp_path / "study.zip", print)
    shutil.rmtree(study / "runs")
    with pytest.raises(UserError, match="holds no finished run"):
        pack_study(study, tmp_path / "study.zip", print)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a study"]


# --- packs of strangers --------------------------------------------------------------------------


def rewritten(path, changes, mode=0):
    """Change files of a pack, leave some out (None), or add some with attributes of their own."""
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


def test_a_changed_file_is_found(packed):
    path, folder = packed("table", "pack.zip"), packed("table", "folder")
    rewritten(path, {"README.md": b"other"})
    (folder / "README.md").unlink()
    for changed, said in ((path, "has changed"), (folder, "is missing")):
        with pytest.raises(UserError, match=rf"not as it was packed: README\.md {said}"):
            check_pack(changed)


# Other files, their attributes, and the complaint: of both kinds of packs, of runs, of studies.
ATTACKS = [
    *(
        ({name: b"evil"}, 0, f"{name!r}, which would lie elsewhere")
        for name in ("../evil", "C:\\evil", "runs/a/b/evil")
    ),
    ({"link": b"/etc/passwd"}, stat.S_IFLNK | 0o777, ", which is no regular file"),
    ({"readme.md": b""}, 0, "two names that some systems take for one"),
    ({"README.md/a": b""}, 0, "a file that is a folder too"),
]
ON_A_RUN = [
    ({"a/b/evil": b"evil"}, 0, "'a/b/evil', which would lie elsewhere"),
    ({"more.py": b"print()"}, 0, "'more.py' is not among the files that run.json lists"),
    ({"zeros": bytes(80 << 20)}, 0, "would take more memory than"),
]
ON_A_STUDY = [*ATTACKS, ({RUN: bytes(90 << 20)}, 0, "would take more memory than")]


def refuse_all(opened, path, attacks, change):
    """Each attack is refused, and nothing is written elsewhere."""
    genuine = path.read_bytes()
    for changes, mode, complaint in attacks:
        path.write_bytes(genuine)
        change(path, changes, mode)
        with pytest.raises(UserError, match=re.escape(complaint)):
            opened(path)
        assert not list(path.parent.rglob("*evil*"))
    path.write_bytes(genuine)


def test_hostile_packs_of_runs_are_refused(packed):
    path = packed("table", "pack.zip")
    refuse_all(check_pack, path, [*ATTACKS, *ON_A_RUN], rewritten)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    with pytest.raises(UserError, match="is no pack that may be opened"):
        check_pack(path)


def test_hostile_packs_of_studies_are_refused(packed_study):
    refuse_all(check_pack, packed_study, ON_A_STUDY, forged)
    changed = [({"report.html": b"x"}, 0), ({"more.py": b""}, 0), ({"study.json": b"{"}, 0)]
    attacks = [(*change, "is not as it was packed") for change in changed]
    refuse_all(check_pack, packed_study, attacks, rewritten)
    forged(packed_study, {RUN: b"PK"})
    with pytest.raises(UserError, match="is no pack that may be opened"):
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
