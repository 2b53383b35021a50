"""What commands leave behind: the figures of runs, studies and a search, without their words.

Files are read by their formats alone (``run.json``, ``evaluations.npz``, ``monitor.csv``, model
zips, a study's tables), so the same program looks at commits whose code is laid out differently.
"""

import csv
import gzip
import io
import json
import os
import runpy
import shlex
import subprocess
import sys
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from trained import Thing, digest

ASKED = yaml.safe_load(Path(__file__).with_name("commands.yml").read_text(encoding="utf-8"))
# Clocks, places, and what only tells which program wrote it.
VOLATILE = ("seconds", "path", "folder", "spent", "time", "date", "version", "speed", "machine")


class Checkout:
    """Types the commands of a checkout in a folder."""

    def __init__(self, root, folder):
        self.root, self.folder = root, folder

    def typed(self, line):
        """Type a command in a child of this process, libraries and all."""
        child = os.fork()
        if child == 0:
            code = 1
            try:
                program, *words = shlex.split(line)
                with (self.folder / "output").open("ab") as output:
                    os.dup2(output.fileno(), 1)
                    os.dup2(output.fileno(), 2)
                sys.argv = [program, *words]
                os.chdir(self.folder)
                runpy.run_path(str(self.root / program), run_name="__main__")
                code = 0
            except SystemExit as stop:
                code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
            finally:
                os._exit(code)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

    def started(self, line):
        """Type a command that starts processes itself: in a new one."""
        program, *words = shlex.split(line)
        with (self.folder / "output").open("ab") as output:
            command = [sys.executable, self.root / program, *words]
            return subprocess.run(
                command, cwd=self.folder, stdout=output, stderr=output, check=False
            ).returncode


def things(root, folder):
    """Everything that this file looks at; files that it needs are made in ``folder``."""
    checkout = Checkout(root, folder)
    for name, text in ASKED["files"].items():
        (folder / name).write_text(text)
    for name, flags in ASKED["runs"].items():
        needs = "run table" if "{" in flags else ""
        yield Thing(f"run {name}", "here", partial(run, checkout, name, flags), needs)
    for name, flags in ASKED["studies"].items():
        yield Thing(f"study {name}", "here", partial(study, checkout, name, flags))
    yield Thing("search", "here", partial(search, checkout))


def run(checkout, name, flags):
    """Train, and list the figures in the run folder."""
    place = name.replace(" ", "_")
    table = next((checkout.folder / "table").glob("*/*_1"), Path())
    flags = flags.format(table=next(table.glob("*-v*.zip"), ""))
    line = f"train.py {flags} --seed 0 -f {place} --verbose 0"
    return [f"exit {checkout.typed(line)}", *figures(next((checkout.folder / place).glob("*/*_1")))]


def figures(folder):
    """What a run folder says in numbers."""
    record = json.loads((folder / "run.json").read_text())
    for place, value in flattened(record["final"], "final"):
        yield f"{place} {value!r}"
    for key in ("state", "n_timesteps", "n_episodes", "engine"):
        yield f"{key} {record.get(key)!r}"
    for file in sorted(folder.glob("*.npz")):
        with np.load(file) as arrays:
            for key in sorted(arrays):
                yield f"{file.name} {key} {digest(arrays[key])}"
    for file in sorted(folder.glob("*.monitor.csv")):
        rows = [row.split(",") for row in file.read_text().splitlines()[1:]]
        kept = [i for i, key in enumerate(rows[0]) if key != "t"]
        columns = " ".join(rows[0][i] for i in kept)
        text = "\n".join(",".join(row[i] for i in kept) for row in rows)
        yield f"{file.name} {columns} {len(rows) - 1} {digest(np.frombuffer(text.encode(), 'u1'))}"
    for file in sorted(folder.glob("*.zip")):
        yield f"{file.name} {weights(file)}"


def flattened(value, place):
    """The leaves of a record, without clocks."""
    if isinstance(value, dict):
        for key in sorted(value):
            if not any(word in key for word in VOLATILE):
                yield from flattened(value[key], f"{place}.{key}")
    else:
        yield place, value


def weights(path):
    """A digest of the tensors in a model zip."""
    import torch as th

    with zipfile.ZipFile(path) as file, file.open("policy.pth") as member:
        tensors = th.load(io.BytesIO(member.read()), weights_only=True)
    return digest(*(tensors[name].numpy() for name in sorted(tensors)))


def study(checkout, name, flags):
    """Carry a study out, and digest the columns of its tables."""
    place = name.replace(" ", "_")
    code = checkout.started(f"compare.py {flags} --name {place} -f studies")
    folder = checkout.folder / "studies" / place
    lines = [f"exit {code}"]
    for file in ("summary.csv", "curves.csv.gz", "verdicts.csv"):
        lines += columns(folder / file)
    return lines


def columns(path):
    """A line for each column of a table that clocks and places do not touch."""
    if not path.is_file():
        yield f"{path.name} no such file"
        return
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "rt", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    yield f"{path.name} {len(rows)} rows"
    for key in rows[0] if rows else ():
        if not any(word in key for word in VOLATILE):
            text = "\n".join(row[key] for row in rows)
            shown = text.replace("\n", " ") if len(text) < 60 else digest(list(text.encode()))
            yield f"{path.name} {key} {shown}"


def search(checkout):
    """Search for hyperparameters, and list the trials."""
    import optuna
    from optuna.storages.journal import JournalFileBackend, JournalStorage

    code = checkout.started(ASKED["search"])
    storage = JournalStorage(JournalFileBackend(str(next(checkout.folder.rglob("trials.log")))))
    trials = optuna.load_study(storage=storage, study_name=None).trials
    told = [f"{trial.number} {trial.state.name} {trial.values} {trial.params}" for trial in trials]
    return [f"exit {code}", *told]
