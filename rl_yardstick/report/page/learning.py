"""The page that plays a training step by step."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from rich.console import Console

from rl_yardstick.envs.known_models import observations_of_states
from rl_yardstick.envs.layout import GridLayout, action_names, grid_layout
from rl_yardstick.experiments.analysis import StudyAnalysis
from rl_yardstick.experiments.child_processes import TaskFailedError, local_executor, supervise
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.experiments.results import difference
from rl_yardstick.experiments.run_limits import RunLimits
from rl_yardstick.mdp.transition_model import Floats
from rl_yardstick.pipeline.environments import make_single_env, titled
from rl_yardstick.pipeline.errors import UserError
from rl_yardstick.pipeline.evaluation.value_maps import MAX_STATES
from rl_yardstick.pipeline.files import write_json, write_text
from rl_yardstick.pipeline.preparation import prepare
from rl_yardstick.pipeline.signs_of_life import Tell, tell_nobody
from rl_yardstick.pipeline.train_spec import TrainSpec, is_plain
from rl_yardstick.pipeline.training import carry_out
from rl_yardstick.pipeline.unfinished_runs import SaveInterval, StateKeeping
from rl_yardstick.pipeline.user_modules import import_again
from rl_yardstick.pipeline.watching import LOGGED, MapRecorder, TableRecorder
from rl_yardstick.report.page.frame import (
    LearningPage,
    as_json,
    first_runs,
    inline_script,
    layout_data,
    packed,
    script_hash,
    template_file,
    templates,
)
from rl_yardstick.safe_files.files import NO_LIMIT, UnsafeFileError, read_file


def page_words(spec: TrainSpec, data: Mapping[str, Any]) -> dict[str, str]:
    """The template's variables whose words depend on the data."""
    note = ""
    if data["kind"] == "maps":
        unit, stride = data["unit"], data["stride"]
        extent = _count(data["n_units"], unit)
        if stride > 1:
            extent += f", one in {stride:,} of which is shown"
        if unit == "update":
            note = "an update: all learning from one rollout, at its end"
        return {"kind": f"from {unit} to {unit}", "extent": extent, "note": note}
    n_steps = len(data["steps"]["timesteps"])
    n_episodes = int(np.count_nonzero(data["moves"]["end"]))
    if data["is_cut"] and spec.watch_episodes:
        asked = _count(spec.watch_episodes, "episode")
        note = f"a page has room for {n_steps:,} steps, and ends before the first {asked} do"
    elif data["begin"]:
        note = "these steps, as the return of the greedy policy rises in them"
    elif data["is_longer"] and not spec.watch_episodes:
        note = "the beginning of a longer training"
    extent = _count(n_steps, "step")
    if data["begin"] or data["is_longer"]:
        first, last = (int(data["steps"]["timesteps"][place]) for place in (0, -1))
        extent = f"steps {first:,} to {last:,} of {data['n_timesteps']:,}"
    extent += f", {_count(n_episodes, 'whole episode')}"
    return {"kind": "step by step", "extent": extent, "note": note}


def _count(number: int, word: str) -> str:
    return f"{number:,} {word}" if number == 1 else f"{number:,} {word}s"


# The page's data: the steps, the positions of states on a map, and the names of actions.
#
# Numbers keep all their digits, so the page shows what the agent computed.


def steps_data(recorder: TableRecorder, most_steps: int) -> dict[str, Any]:
    """At most ``most_steps`` steps of a tabular agent.

    They are the first ones if the first episodes were asked for, else the last: the return rises.
    """
    begin, end = recorder.window()
    if recorder.n_episodes:
        end = min(end, begin + most_steps)
    else:
        begin = max(begin, end - most_steps)
    steps = recorder.steps.rows[begin:end]
    # The tables before the first of the steps.
    tables = {name: recorder.initial[name].copy() for name in recorder.names}
    earlier = recorder.changes.rows[recorder.changes.rows["step"] < begin]
    for number, table in enumerate(tables.values()):
        moved = earlier[earlier["table"] == number]
        table.reshape(-1)[moved["entry"]] = moved["after"]  # the last change of an entry holds
    return {
        "kind": "steps",
        "tables": [_table(name, table) for name, table in tables.items()],
        "steps": _columns(steps),
        "moves": _columns(_between(recorder.moves.rows, begin, end)),
        "changes": _columns(_between(recorder.changes.rows, begin, end)),
        "begin": begin,
        "is_cut": recorder.is_cut or end - begin < len(recorder.steps),
        "n_timesteps": recorder.model.num_timesteps,
        "is_longer": recorder.model.num_timesteps > steps["timesteps"][-1],
    }


def _between(rows: NDArray[np.void], begin: int, end: int) -> NDArray[np.void]:
    """The rows of steps ``begin`` to ``end`` (exclusive), with steps numbered from 0."""
    chosen = rows[(rows["step"] >= begin) & (rows["step"] < end)].copy()
    chosen["step"] -= begin
    return chosen


def _columns(rows: NDArray[np.void]) -> dict[str, Any]:
    return {name: rows[name] for name in rows.dtype.names or ()}


def _table(name: str, values: Floats) -> dict[str, Any]:
    fill = values.reshape(-1)[0]
    is_even = bool((values == fill).all())
    initial = {"fill": float(fill)} if is_even else {"values": values.reshape(-1)}
    return {"name": name, "shape": values.shape, **initial}


def maps_data(recorder: MapRecorder, stride: int) -> dict[str, Any]:
    """An agent's policy, and the policy's value in every state, in the course of training.

    Every ``stride``-th update or evaluation is shown, and the last in any case.
    """
    evaluator, rows = recorder.evaluator, recorder.moments.rows
    is_shown = rows["number"] % stride == 0
    is_shown[-1] = True
    shown = rows[is_shown]
    optimal = evaluator.optimum[0][evaluator.model.reachable]
    return {
        "kind": "maps",
        "unit": recorder.unit,
        "n_units": recorder.n_units,
        "stride": stride,
        "moments": {
            **_columns(shown),
            "values": np.where(evaluator.model.reachable, shown["values"], np.nan),
            "return": shown["values"] @ evaluator.model.initial,
        },
        "logged": LOGGED,
        "optimum": evaluator.yardstick.optimum,
        "optimal_range": [optimal.min(), optimal.max()],
    }


def place_data(spec: TrainSpec, recorder: TableRecorder | MapRecorder) -> dict[str, Any]:
    """The layout of the states, and the names of the actions."""
    layout, n_states, n_actions = None, 0, 0
    if isinstance(recorder, MapRecorder):
        model, layout = recorder.evaluator.model, recorder.evaluator.layout
        n_states, n_actions = model.n_states, model.n_actions
    elif recorder.has_actions:
        *_, n_states, n_actions = recorder.initial[recorder.names[0]].shape
    env = make_single_env(spec, training=True)
    try:
        layout = layout or _layout_of(env, n_states)
        names = action_names(env)
        n_arms = int(getattr(env.action_space, "n", n_actions))
    finally:
        env.close()
    if len(names) < n_arms:
        names = tuple(f"action {action}" for action in range(n_arms))
    return {
        "n_states": n_states,
        "actions": names[:n_arms],
        "layout": None if layout is None else layout_data(layout),
        "is_drawn": 1 < n_states <= MAX_STATES,
    }


def exactly(number: float) -> float | str | None:
    """A number for JSON with all its digits; None for NaN, a word for infinity."""
    if math.isnan(number):
        return None
    if math.isinf(number):
        return "Infinity" if number > 0 else "-Infinity"
    return int(number) if number.is_integer() and abs(number) < 2**53 else number


def _layout_of(env: Any, n_states: int) -> GridLayout | None:
    """The map, if the agent observes the number of the state; else None."""
    layout = grid_layout(env)
    if layout is None or layout.n_states != n_states:
        return None
    seen = observations_of_states(env)
    is_number = seen is not None and np.array_equal(seen, np.arange(n_states))
    return layout if is_number else None


# The page as one file: it needs nothing else and no network.

MOST_BYTES = 2_900_000
SCRIPTS = ("replay", "board", "readout", "curves", "steps", "maps", "player")


def write_learning_page(
    spec: TrainSpec, recorder: TableRecorder | MapRecorder, path: Path, title: str = ""
) -> str:
    """Write the page of a training; return what it shows, in words.

    The default title names the agent and the environment.
    """
    place = place_data(spec, recorder)
    title = title or f"{spec.algo} on {titled(spec.env_id, spec.map_name)}"
    for data in _ever_less(recorder):
        words = page_words(spec, data)
        text = _render({"title": title, "seed": spec.seed, **words}, {**data, **place})
        if len(text.encode()) <= MOST_BYTES:
            break
    write_text(path, text)
    return f"{words['kind']}, {words['extent']}"


@cache
def page_version() -> str:
    """A digest of a page without its data: template, scripts and styles."""
    words = {"title": "", "seed": 0, "kind": "", "extent": "", "note": ""}
    return sha256(_render(words, {}).encode()).hexdigest()


def _ever_less(recorder: TableRecorder | MapRecorder) -> Iterator[dict[str, Any]]:
    """The recorded data, then ever less: 3/4 of the steps, or half of the maps, and so on."""
    if isinstance(recorder, MapRecorder):
        recorder.finish()
        stride = recorder.stride
        while stride < 2 * max(recorder.n_units, recorder.stride):
            yield maps_data(recorder, stride)
            stride *= 2
        return
    begin, end = recorder.window()
    n_steps = end - begin
    while n_steps:
        yield steps_data(recorder, n_steps)
        n_steps = n_steps * 3 // 4


def _render(words: Mapping[str, Any], data: Mapping[str, Any]) -> str:
    early = template_file("theme.js")
    own = "\n".join(template_file(f"learning/learning_{name}.js") for name in SCRIPTS)
    style = f"{template_file('page.css')}\n{template_file('learning/learning.css')}"
    template = templates("learning").get_template("learning.html")
    return template.render(
        **words,
        data=packed(as_json(data, exactly)),
        style=Markup(style),  # noqa: S704  # our own
        early=inline_script(early),
        own=inline_script(own),
        policy=" ".join(map(script_hash, [early, own])),
    )


# Learning pages in the folder of a study, each with a note of digests of its inputs.

FOLDER = "learning"
LONGEST_WORDS = 300
_MOST_NOTED = 10_000  # bytes


def page_path(root: Path, run: PlannedRun) -> Path:
    """Where the page of a run is written."""
    return root / FOLDER / run.path.parent.name / f"{run.path.name}.html"


def kept_page(root: Path, run: PlannedRun) -> LearningPage | None:
    """The cached page of a run; None if it is missing, or was made from other inputs."""
    path = page_path(root, run)
    try:
        content = read_file(path, 2 * MOST_BYTES)
        note = json.loads(read_file(path.with_suffix(".json"), _MOST_NOTED))
    except (OSError, ValueError, RecursionError, UnsafeFileError):
        return None
    words = note.pop("words", None) if isinstance(note, dict) else None
    if not isinstance(words, str) or len(words) > LONGEST_WORDS:
        return None
    made_from = _made_from(run, content)
    is_whole = made_from["agent"] and note == made_from
    return _page(root, run, words, content) if is_whole else None


def _made_from(run: PlannedRun, content: bytes) -> dict[str, str]:
    """The digests that a cached page must match; the agent's is empty if its run recorded none."""
    digests = run.run.files.digests or {}
    return {
        "agent": digests.get(run.run.model_path.name, ""),
        "page": sha256(content).hexdigest(),
        "version": page_version(),
    }


def _page(root: Path, run: PlannedRun, words: str, content: bytes) -> LearningPage:
    place = page_path(root, run).relative_to(root).as_posix()
    return LearningPage(run.agent, run.environment, run.seed, place, words, len(content))


# The first training of each agent of a study, repeated to be recorded.

BATCH = "its runs were done as one batch, which saves no agent"
WITHOUT_STATES = StateKeeping(SaveInterval(is_off=True))


def write_first_pages(
    analysis: StudyAnalysis, n_workers: int, tell: Tell = tell_nobody
) -> list[LearningPage]:
    """Write a page for the first run of each agent, into ``learning``; valid cached pages stay.

    ``n_workers`` trainings run at once, each in a child process. For an agent that cannot be
    shown, the returned page has the reason.
    """
    root, study = analysis.results.root, analysis.study
    runs = [run for group in first_runs(analysis) for run in group]
    kept = {run.path: kept_page(root, run) for run in runs}
    to_do = [run for run in runs if kept[run.path] is None]
    if to_do:
        limits = RunLimits(study.run_timeout, study.run_memory)
        with local_executor(n_workers) as executor:
            futures = [executor.submit(_watched, root, run, limits) for run in to_do]
            for n, (run, future) in enumerate(zip(to_do, futures, strict=True), start=1):
                what = f"{run.agent} on {run.environment}"
                tell(f"training again to be watched, {n} of {len(to_do)}: {what}")
                kept[run.path] = future.result()
    pages = [page for page in kept.values() if page is not None]
    there = {(page.agent, page.environment) for page in pages}
    batches = {(run.agent, run.environment) for run in analysis.results.finished if run.is_batch}
    names = [(each.agent, one.environment) for one in analysis.environments for each in one.agents]
    for agent, environment in names:
        if (agent, environment) not in there:
            is_batch = (agent, environment) in batches
            reason = BATCH if is_batch else "no run of it has finished"
            pages.append(LearningPage(agent, environment, 0, "", reason))
    return pages


def _watched(root: Path, run: PlannedRun, limits: RunLimits) -> LearningPage:
    """The page of a run, written by a child process."""
    path = page_path(root, run)
    with TemporaryDirectory(prefix="yardstick-learning-", ignore_cleanup_errors=True) as folder:
        try:
            words = supervise(
                _train_again,
                run,
                path,
                Path(folder),
                clean_up=partial(shutil.rmtree, folder, ignore_errors=True),
                limits=limits,
                shares_process=is_plain(run.spec),
            )
        except TaskFailedError as error:
            path.unlink(missing_ok=True)
            reason = str(error)[:LONGEST_WORDS]
            return LearningPage(run.agent, run.environment, run.seed, "", reason)
    content = read_file(path, NO_LIMIT)
    write_json(path.with_suffix(".json"), {"words": words, **_made_from(run, content)})
    return _page(root, run, words, content)


def _train_again(planned: PlannedRun, path: Path, folder: Path) -> str:
    """Train again in ``folder``, compare with the run, write the page; return what it shows."""
    import_again(planned.spec.user_modules)
    spec = replace(planned.spec, log_folder=folder, tensorboard_log=None, watch_learning=path)
    training = prepare(spec, Console(quiet=True), {}, "", keeping=WITHOUT_STATES)
    carry_out(training)
    what = difference(planned.run, training.run)
    if what:
        raise UserError(
            f"{what} came out differently than in the run: another version or processor?"
        )
    assert training.watch is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    title = f"{planned.agent} on {planned.environment}"
    return write_learning_page(spec, training.watch, path, title)
