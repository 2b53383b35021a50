"""The page that plays a training step by step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from concurrent.futures import wait
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl_yardstick.envs.known_models import observations_of_states
from rl_yardstick.envs.layout import GridLayout, action_names, grid_layout
from rl_yardstick.experiments.analysis import StudyAnalysis
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.pool import process_pool
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.components import import_modules
from rl_yardstick.pipeline.environments import make_single_env
from rl_yardstick.pipeline.errors import UserError, one_line
from rl_yardstick.pipeline.evaluation.value_maps import MAX_STATES, ValueMapRecorder
from rl_yardstick.pipeline.files import read_bytes, read_json, write_json, write_text
from rl_yardstick.pipeline.models import MAX_MODEL
from rl_yardstick.pipeline.run import RECORD, Run, Stop
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.pipeline.watching import TableRecorder, Watch
from rl_yardstick.report.page import frame
from rl_yardstick.report.page.frame import LearningPage, first_runs
from rl_yardstick.safe_files.files import read_members


def page_words(spec: TrainSpec, data: Mapping[str, Any]) -> dict[str, str]:
    """The template's variables whose words depend on the data."""
    if data["kind"] == "maps":
        n_shown, n_units = len({*data["moments"]["number"]}), data["n_units"]
        extent = f"{n_shown:,} of {_count(n_units, 'evaluation')}"
        return {"kind": "from evaluation to evaluation", "extent": extent, "note": ""}
    steps, note = data["steps"]["timesteps"], ""
    if data["is_cut"] and spec.watch_episodes:
        asked = _count(spec.watch_episodes, "episode")
        note = f"a page has room for {len(steps):,} steps, and ends before the first {asked} do"
    elif data["is_longer"] and not spec.watch_episodes:
        note = "the beginning of a longer training"
    extent = f"steps {steps[0]:,} to {steps[-1]:,} of {data['n_timesteps']:,}"
    extent += f", {_count(int(np.count_nonzero(data['moves']['end'])), 'whole episode')}"
    return {"kind": "step by step", "extent": extent, "note": note}


def _count(number: int, word: str) -> str:
    return f"{number:,} {word}{'' if number == 1 else 's'}"


def steps_data(recorder: TableRecorder, most_steps: int) -> dict[str, Any]:
    """The first ``most_steps`` recorded steps of a tabular agent."""
    rows = recorder.rows()
    steps, moves, changes = rows["steps"][:most_steps], rows["moves"], rows["changes"]
    return {
        "kind": "steps",
        "tables": [_table(name, table) for name, table in recorder.initial.items()],
        "steps": _columns(steps),
        "moves": _columns(moves[moves["step"] < most_steps]),
        "changes": _columns(changes[changes["step"] < most_steps]),
        "is_cut": recorder.is_cut or most_steps < len(recorder.steps),
        "n_timesteps": recorder.model.num_timesteps,
        "is_longer": recorder.model.num_timesteps > steps["timesteps"][-1],
    }


def _columns(rows: NDArray[np.void]) -> dict[str, Any]:
    return {name: rows[name] for name in rows.dtype.names or ()}


def _table(name: str, values: Floats) -> dict[str, Any]:
    """A table before the first step; its one number, if all are equal."""
    fill = values.reshape(-1)[0]
    is_even = bool((values == fill).all())
    initial = {"fill": float(fill)} if is_even else {"values": values.reshape(-1)}
    return {"name": name, "shape": values.shape, **initial}


def maps_data(recorder: ValueMapRecorder, stride: int) -> dict[str, Any]:
    """An agent's policy, and the policy's value in every state, in the course of training.

    Every ``stride``-th evaluation is shown, and the last in any case.
    """
    evaluator, last = recorder.evaluator, len(recorder.moments) - 1
    shown = [m for i, m in enumerate(recorder.moments) if m[0] % stride == 0 or i == last]
    numbers, timesteps, values, actions = map(np.array, zip(*shown, strict=True))
    reachable = evaluator.model.reachable
    optimal = evaluator.optimum[0][reachable]
    moments = {"number": numbers, "timesteps": timesteps, "actions": actions}
    moments["values"] = np.where(reachable, values, np.nan)
    moments["return"] = values @ evaluator.model.initial
    return {
        "kind": "maps",
        "n_units": recorder.n_units,
        "stride": stride,
        "moments": moments,
        "optimum": evaluator.yardstick.optimum,
        "optimal_range": [optimal.min(), optimal.max()],
    }


def place_data(spec: TrainSpec, recorder: Watch) -> dict[str, Any]:
    """The layout of the states, and the names of the actions."""
    layout: GridLayout | None = None
    n_states = n_actions = 0
    if isinstance(recorder, ValueMapRecorder):
        model, layout = recorder.evaluator.model, recorder.evaluator.layout
        n_states, n_actions = model.n_states, model.n_actions
    elif recorder.has_actions:
        *_, n_states, n_actions = next(iter(recorder.initial.values())).shape
    with closing(make_single_env(spec, training=True)) as env:
        layout = layout or _layout_of(env, n_states)
        names = action_names(env)
        n_arms = int(getattr(env.action_space, "n", n_actions))
    if len(names) < n_arms:
        names = tuple(f"action {action}" for action in range(n_arms))
    return {
        "n_states": n_states,
        "actions": names[:n_arms],
        "layout": None if layout is None else frame.layout_data(layout),
        "is_drawn": 1 < n_states <= MAX_STATES,
    }


def exactly(number: float) -> float | str | None:
    """A number for JSON with all its digits, as the agent has it; NaN is None, infinity a word."""
    if math.isnan(number):
        return None
    if math.isinf(number):
        return "Infinity" if number > 0 else "-Infinity"
    return int(number) if number.is_integer() and abs(number) < 2**53 else number


def _layout_of(env: Any, n_states: int) -> GridLayout | None:
    """The map, if the agent observes the number of the state; else None."""
    layout, seen = grid_layout(env), observations_of_states(env)
    if layout is None or layout.n_states != n_states or seen is None:
        return None
    return layout if np.array_equal(seen, np.arange(n_states)) else None


MOST_BYTES = 2_900_000
SCRIPTS = ("replay", "board", "readout", "curves", "steps", "maps", "player")


def write_learning_page(spec: TrainSpec, recorder: Watch, path: Path, title: str = "") -> str:
    """Write the page of a training; return what it shows, in words.

    The default title names the agent and the environment.
    """
    place = place_data(spec, recorder)
    page = frame.templates("learning").get_template("learning.html")
    scripts = [f"learning/learning_{name}.js" for name in SCRIPTS]
    around = frame.page_frame(scripts, ("page.css", "learning/learning.css"), is_plotted=False)
    around |= {"title": title or f"{spec.algo} on {spec.place}", "seed": str(spec.seed)}
    for data in _ever_less(recorder):
        words, packed = page_words(spec, data), frame.packed(frame.as_json(data | place, exactly))
        text = page.render(**around, **words, data=packed)
        if len(text.encode()) <= MOST_BYTES:
            break
    write_text(path, text)
    return f"{words['kind']}, {words['extent']}"


def _ever_less(recorder: Watch) -> Iterator[dict[str, Any]]:
    """The recorded data, then ever less: 3/4 of the steps, or half of the maps, and so on."""
    if isinstance(recorder, ValueMapRecorder):
        stride = recorder.stride
        while stride < 2 * max(recorder.n_units, recorder.stride):
            yield maps_data(recorder, stride)
            stride *= 2
        return
    n_steps = len(recorder.steps)
    while n_steps:
        yield steps_data(recorder, n_steps)
        n_steps = n_steps * 3 // 4


# The first training of each agent of a study, repeated to be recorded.

BATCH = "its runs were done as one batch, which saves no agent"


def write_first_pages(analysis: StudyAnalysis, n_workers: int, stop: Stop) -> list[LearningPage]:
    """Write a page for the first run of each agent, into ``learning``; newer pages stay.

    Repeats up to ``n_workers`` trainings at once, each in a process of its own, and ends them after
    a signal. Returns for each agent on each environment its page, or why there is none.
    """
    root, timeout = analysis.results.root, analysis.study.run_timeout
    runs = [run for of_place in first_runs(analysis) for run in of_place]
    pages = {run.labels: _page_of(root, run) for run in runs}
    to_do, pool = [run for run in runs if pages[run.labels] is None], process_pool(n_workers)
    try:
        again = {pool.submit(_train_again, timeout, root, run): run for run in to_do}
        while wait(again, timeout=0.2).not_done:
            stop.check()
    finally:
        pool.stop()  # type: ignore[no-untyped-call]
        pool.join()
    for future, run in again.items():
        error = future.exception()
        reason = "" if error is None else one_line(error)
        pages[run.labels] = _page_of(root, run) or LearningPage(*run.labels, run.seed, "", reason)
    batches = {run.labels for run in analysis.results.finished if run.is_batch}
    for one in analysis.environments:
        for labels in ((agent.agent, one.environment) for agent in one.agents):
            reason = BATCH if labels in batches else "no run of it has finished"
            pages.setdefault(labels, LearningPage(*labels, 0, "", reason))
    return [page for page in pages.values() if page is not None]


def _path_of(root: Path, run: PlannedRun) -> Path:
    return root / "learning" / run.path.parent.name / f"{run.path.name}.html"


def _page_of(root: Path, run: PlannedRun) -> LearningPage | None:
    """The page of a run, with its words from the file beside it; None if the run is newer."""
    path = _path_of(root, run)
    note = path.with_suffix(".json")
    if not note.exists() or note.stat().st_mtime < (run.path / RECORD).stat().st_mtime:
        return None
    place, words = path.relative_to(root).as_posix(), str(read_json(note)["words"])
    return LearningPage(*run.labels, run.seed, place, words, path.stat().st_size)


def _train_again(root: Path, planned: PlannedRun) -> None:
    """Train again in a temporary folder, compare the agents, and write the page."""
    from rl_yardstick.pipeline.training import train

    path = _path_of(root, planned)
    import_modules(planned.spec.gym_packages)
    spec = planned.spec.changed(tensorboard_log=None, watch_learning=str(path))
    with TemporaryDirectory(prefix="yardstick-learning-") as folder, Run(Path(folder)) as run:
        run.begin(spec, {}, "")
        watch = train(spec, run).watch
        if _tensors(run.model_path(spec)) != _tensors(planned.run.model_path(spec)):
            what = "the agent came out differently than in the run"
            raise UserError(f"{what}: another version or processor?")
    assert watch is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    words = write_learning_page(spec, watch, path, f"{planned.agent} on {planned.environment}")
    write_json(path.with_suffix(".json"), {"words": words})


def _tensors(model: Path) -> dict[str, bytes]:
    """The files of numbers in the zip of an agent."""
    members = read_members(read_bytes(model, MAX_MODEL))
    return {name: content for name, content in members.items() if name.endswith(".pth")}
