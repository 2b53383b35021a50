"""What becomes of a run whose files are damaged: one line that names the file, or right figures.

    python benchmarks/damaged_files.py                   # a tenth of the flips, a minute
    python benchmarks/damaged_files.py --flips 300       # all: some minutes

Every file of a tabular run, a run of PPO, and of runs on bandits is damaged in turn: cut off at
each per cent of its length, with a bit turned over, and, where it is a zip, with a bit of a member
turned over and the checksum mended. Then the run is read as `compare.py` and `enjoy.py` do, its
agents loaded. Counted are four ends: refused in one line; the figures that were there before; taken
for another run, which only one that recorded no digests can be; and all else, of which there must
be none. The same again for runs that recorded no digests, as those of earlier versions, and for
their zips lying alone: there a wrong figure can pass, and is counted as such.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import tempfile
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.base_class import BaseAlgorithm

from experiments.plan import PlannedRun, plan
from experiments.results import joined, read_run
from experiments.run_folders import draft_path
from experiments.run_in_child import do_run
from experiments.study import AgentSpec, EnvironmentSpec, StudySpec
from pipeline.errors import UserError
from pipeline.models.choose import ChosenModel, ModelRequest, agent_to_continue, choose_model
from pipeline.models.load import load_model
from safe_files.known_objects import tensors_in

REFUSED, RIGHT, WRONG, ANOTHER, BROKEN = "refused", "right", "wrong", "another run", "broken"
UNNAMED = "refused, and the file not named"
SMALL_NETWORK = {"policy_kwargs": {"net_arch": [4]}, "n_steps": 64, "batch_size": 64}
STEPS = {"n_timesteps": 128}
RUNS = (
    (AgentSpec("table", "qlearning"), EnvironmentSpec("grid", "Warehouse-v0", STEPS)),
    (
        AgentSpec("ppo", "ppo", {**SMALL_NETWORK, "normalize": True}),
        EnvironmentSpec("pole", "CartPole-v1", STEPS),
    ),
    (AgentSpec("ucb", "ucb"), EnvironmentSpec("arms", "BernoulliBandit-v0", STEPS)),
    # More steps than an episode has are no batch: the run leaves an agent.
    (AgentSpec("ucb", "ucb"), EnvironmentSpec("long", "BernoulliBandit-v0", {"n_timesteps": 1100})),
    (
        AgentSpec("ppo", "ppo", {**SMALL_NETWORK, "policy": "MlpPolicy"}, tuned=False),
        EnvironmentSpec("arms", "BernoulliBandit-v0", STEPS),
    ),
)


def finished_runs(root: Path) -> list[tuple[StudySpec, PlannedRun]]:
    """Each of `RUNS`, trained below a folder."""
    done = []
    for place, (agent, environment) in enumerate(RUNS):
        study = StudySpec("s", "S", (agent,), (environment,), n_seeds=1, eval_freq=64)
        folder = root / str(place)
        (planned,) = plan(study, folder)
        do_run(planned, draft_path(folder, planned), "damaged_files.py")
        done.append((study, planned))
    return done


def forget_digests(planned: PlannedRun) -> None:
    """Make the run one of an earlier version."""
    path = planned.run.info_path
    info = json.loads(path.read_text(encoding="utf-8"))
    del info["files"], info["record_version"]
    path.write_text(json.dumps(info, indent=2), encoding="utf-8")


def as_compared(study: StudySpec, planned: PlannedRun) -> str | None:
    """The figures that a comparison takes from a run; None where it is another run."""
    found = read_run(study, planned)
    if found is None:
        return None
    curves = [joined([curve]).to_csv() for curve in found.curves]
    return repr(found.rows) + "".join(curves)


def as_played(study: StudySpec, planned: PlannedRun) -> str | None:
    """Which model would be played and gone on with, on which environments."""
    if planned.is_batch:
        return ""  # it leaves no agent
    request = ModelRequest(path=planned.path, log_folder=planned.path.parents[1])
    return _described(choose_model(request)) + str(agent_to_continue(planned.path))


def as_played_at_its_best(study: StudySpec, planned: PlannedRun) -> str | None:
    """The same for the model that evaluated best."""
    if planned.is_batch:
        return ""
    request = ModelRequest(path=planned.path, log_folder=planned.path.parents[1], which="best")
    return _described(choose_model(request))


def _described(chosen: ChosenModel) -> str:
    model = load_model(chosen.spec.algo, chosen.file, device="cpu")
    statistics = None if chosen.statistics is None else vars(chosen.statistics)
    parts = {name: getattr(part, "__dict__", part) for name, part in (statistics or {}).items()}
    return repr((chosen.path, chosen.spec, chosen.run, parts)) + _agent(model)


def _agent(model: BaseAlgorithm) -> str:
    """The numbers in an agent."""
    plain = {name: value for name, value in vars(model).items() if isinstance(value, int | float)}
    weights = [tensor.tolist() for _, tensor in tensors_in(model.get_parameters())]
    return repr((sorted(plain.items()), weights))


def as_zips_alone(study: StudySpec, planned: PlannedRun) -> str | None:
    """The agents in the zips, as if these lay somewhere by themselves."""
    with tempfile.TemporaryDirectory() as folder:
        found = ""
        for path in sorted(planned.path.glob("*.zip")):
            alone = Path(folder) / path.name
            alone.write_bytes(path.read_bytes())
            try:
                found += _agent(load_model(planned.spec.algo, alone, device="cpu"))
            except UserError as error:
                # Named is the copy; the reader of the outcome looks for the run.
                raise UserError(str(error).replace(folder, str(planned.path))) from error
        return found


def outcome(
    read: Callable[[StudySpec, PlannedRun], str | None],
    study: StudySpec,
    planned: PlannedRun,
    expected: str | None,
) -> str:
    """How reading a damaged run ends."""
    try:
        found = read(study, planned)
    except UserError as error:
        return REFUSED if str(planned.path) in str(error) else f"{UNNAMED}: {error}"
    except Exception as error:  # noqa: BLE001  # that there is none is what is measured
        return f"{BROKEN}: {type(error).__name__}: {error}"
    if found is None:
        return ANOTHER
    return RIGHT if found == expected else WRONG


def damaged(content: bytes, flips: int, rng: np.random.Generator) -> Iterator[bytes]:
    """The content, damaged in all ways: ``flips`` of them random, a third of that mended."""
    for percent in range(100):
        yield content[: len(content) * percent // 100]
    for _ in range(flips if content else 0):
        yield flipped(content, rng)
    if content.startswith(b"PK"):
        for _ in range(flips // 3):
            yield mended(content, rng)


def flipped(content: bytes, rng: np.random.Generator) -> bytes:
    """With one bit turned over."""
    changed = bytearray(content)
    changed[rng.integers(len(changed))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def mended(content: bytes, rng: np.random.Generator) -> bytes:
    """The zip with one bit of a member turned over, and checksums that fit."""
    target = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(target, "w") as copy:
        members = {info: source.read(info) for info in source.infolist()}
        filled = [info for info, inner in members.items() if inner]
        chosen = filled[rng.integers(len(filled))]
        for info, inner in members.items():
            copy.writestr(info, flipped(inner, rng) if info is chosen else inner)
    return target.getvalue()


def campaign(
    study: StudySpec, planned: PlannedRun, flips: int, seed: int = 0, stride: int = 1
) -> dict[tuple[str, str], Counter[str]]:
    """Damage every file of a run in turn, and count how reading it ends.

    Args:
        study: the study that the run is of.
        planned: the run, whole.
        flips: how many bits to turn over, one at a time.
        seed: of which.
        stride: take every so many-th of the damages alone.

    Returns:
        Counts by reader ("compared", "played", "best", and of a run without digests "alone") and
        file.
    """
    readers = {"compared": as_compared, "played": as_played, "best": as_played_at_its_best}
    if planned.run.files.digests is None:
        readers["alone"] = as_zips_alone
    expected = {name: read(study, planned) for name, read in readers.items()}
    rng = np.random.default_rng(seed)
    counts: dict[tuple[str, str], Counter[str]] = {}
    for path in sorted(path for path in planned.path.rglob("*") if path.is_file()):
        whole = path.read_bytes()
        name = path.relative_to(planned.path).as_posix()
        readers_of = {
            reader: read for reader, read in readers.items() if reader != "alone" or _is_zip(path)
        }
        counts |= {(reader, name): Counter[str]() for reader in readers_of}
        for place, content in enumerate(damaged(whole, flips, rng)):
            if place % stride:
                continue
            path.write_bytes(content)
            for reader, read in readers_of.items():
                counts[reader, name][outcome(read, study, planned, expected[reader])] += 1
        path.write_bytes(whole)
    return counts


def _is_zip(path: Path) -> bool:
    return path.suffix == ".zip"


def _print(console: Console, title: str, counts: Any) -> Counter[str]:
    total: Counter[str] = Counter()
    table = Table("reader", "file", REFUSED, RIGHT, WRONG, ANOTHER, BROKEN, title=title)
    for (reader, name), ends in counts.items():
        total += ends
        if set(ends) == {RIGHT}:
            continue  # a file that is not read
        known = [ends[end] for end in (REFUSED, RIGHT, WRONG, ANOTHER)]
        table.add_row(reader, name, *map(str, [*known, ends.total() - sum(known)]))
    console.print(table)
    for end in sorted(total):
        if end.startswith((BROKEN, UNNAMED)):
            console.print(end, markup=False, soft_wrap=True)
    return total


def main() -> int:
    """Run the campaigns; the exit code is 1 where something ended as it must not."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--flips", type=int, default=30, help="bits turned over in each file")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    console, is_right = Console(width=120), True
    with tempfile.TemporaryDirectory() as folder:
        for study, planned in finished_runs(Path(folder)):
            name = f"{planned.agent} on {planned.environment}"
            total = _print(console, name, campaign(study, planned, args.flips, args.seed))
            is_right &= set(total) <= {REFUSED, RIGHT}
            forget_digests(planned)
            title = f"{name}, no digests recorded"
            total = _print(console, title, campaign(study, planned, args.flips, args.seed))
            is_right &= not any(end.startswith(BROKEN) for end in total)
    console.print("as promised" if is_right else "NOT as promised")
    return 0 if is_right else 1


if __name__ == "__main__":
    sys.exit(main())
