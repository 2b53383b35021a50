"""What is done with a training that has come to its end: saved, judged, drawn."""

from __future__ import annotations

from pipeline.evaluation.sampled import Evaluation, SampledEvaluator
from pipeline.evaluation.value_maps import value_map
from pipeline.library_loading import loading_libraries
from pipeline.models.find import final_replay_buffer_path
from pipeline.models.load import save_model, save_normalization, save_replay_buffer
from pipeline.pictures.learning_curve import draw_learning_curve
from pipeline.pictures.pull_curve import draw_pulls
from pipeline.pictures.value_map import draw_value_map
from pipeline.preparation import Training
from pipeline.pull_recording import PullSummary, summarise_pulls
from pipeline.runs import FINISHED, INTERRUPTED
from pipeline.stopping import current


def save(training: Training, state: str) -> PullSummary | None:
    """Save what was learnt, and what was pulled; the figures on the latter."""
    run, model, recorder = training.run, training.model, training.pulls
    save_model(model, run.model_path)
    save_normalization(model, run.vecnormalize_path)
    if training.spec.save_replay_buffer and not current().is_urgent:
        save_replay_buffer(model, final_replay_buffer_path(run.path))
    if recorder is None or not recorder.n_calls:
        return None
    if state == INTERRUPTED:
        recorder.write()  # as it does by itself where the training was not interrupted
    return summarise_pulls(recorder.arrays())


def judge(training: Training, state: str) -> Evaluation | None:
    """Evaluate what is not evaluated yet; the final evaluation, where the training was not cut off.

    It is exact, or by episodes that were used for nothing else.
    """
    evaluation, model = training.evaluation, training.model
    if not evaluation.is_asked_for:
        return None
    if not evaluation.evaluations_timesteps:
        # The run was shorter than the time to its first evaluation, or called no callback.
        evaluation.init_callback(model)
        evaluation.evaluate_now()
    evaluation.write()
    if evaluation.value_maps is not None:
        evaluation.value_maps.finish(model, model.num_timesteps)
    return _final_evaluation(training) if state == FINISHED else None


def draw(training: Training, final: Evaluation | None) -> None:
    """Draw the pulls, the learning curve and the map of the final policy, where there are such."""
    if training.spec.pictures:
        with loading_libraries():  # Matplotlib
            _draw(training, final)


def _draw(training: Training, final: Evaluation | None) -> None:
    run, spec, recorder = training.run, training.spec, training.pulls
    title = f"{spec.algo} on {run.env_name}, seed {spec.seed}"
    has_pulls = recorder is not None and recorder.n_calls > 0
    if recorder is not None and has_pulls:
        draw_pulls(run.pulls_picture_path, title, recorder.arrays())
    if not has_pulls or training.evaluation.evaluations_timesteps:
        yardstick = None if final is None else final.yardstick
        first_step, on_variant = training.model._num_timesteps_at_start, training.display.on_variant
        draw_learning_curve(run, title, first_step, yardstick, on_variant=on_variant)
    maps = training.evaluation.value_maps
    if maps is not None and training.evaluation.is_asked_for:
        found = value_map(maps.evaluator, training.model)
        if found is not None:
            draw_value_map(run.value_map_path, title, found)


def _final_evaluation(training: Training) -> Evaluation:
    evaluation, model = training.evaluation, training.model
    evaluation.take_statistics()
    with evaluation.timed():
        if isinstance(evaluation.evaluator, SampledEvaluator):
            return evaluation.evaluator.at_the_end(model)
        return evaluation.evaluator(model)
