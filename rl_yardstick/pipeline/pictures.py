"""The pictures of a run: pulls, learning curve, the map of its policy, the diagnosis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rl_yardstick.pipeline.curve_pictures import draw_diagnosis, draw_learning_curve, draw_pulls
from rl_yardstick.pipeline.environments import training_changes
from rl_yardstick.pipeline.evaluation.value_maps import value_map
from rl_yardstick.pipeline.map_pictures import draw_value_map


def draw(folder: Path, parts: Any) -> None:
    """Draw what a training has left, with ``pictures`` in its spec.

    Args:
        folder: the run folder.
        parts: the `Training`, at its end.
    """
    spec, evaluation, agent = parts.spec, parts.evaluation, parts.agent
    if not spec.pictures:
        return
    with parts.run.console.status("drawing the pictures"):
        has_pulls = parts.pulls is not None and parts.pulls.n_calls > 0
        if has_pulls:
            draw_pulls(folder / "pulls.png", spec.title, parts.pulls.arrays())
        if not has_pulls or evaluation.evaluations_timesteps:
            first_step, scale = agent._num_timesteps_at_start, parts.judge.yardstick
            changed = bool(training_changes(spec))
            draw_learning_curve(folder, spec.title, first_step, scale, on_variant=changed)
        if evaluation.value_maps is not None and evaluation.is_asked_for:
            found = value_map(evaluation.value_maps.evaluator, agent)
            if found is not None:
                draw_value_map(folder / "value_map.png", spec.title, found)
        if evaluation.critics is not None:
            draw_diagnosis(folder, spec.title)
