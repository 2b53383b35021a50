"""A training from its spec to a finished folder: `train`."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import EpisodeBudget
from rl_yardstick.envs import found_models
from rl_yardstick.envs.finite_spaces import describe
from rl_yardstick.machine_code.compiling import compile_timer
from rl_yardstick.pipeline import callbacks
from rl_yardstick.pipeline.components import action_noise, build, constructor_arguments
from rl_yardstick.pipeline.environment_trial import tried
from rl_yardstick.pipeline.environments import first_seed, make_training_env, training_changes
from rl_yardstick.pipeline.errors import PACKAGE, Stopped, UserError, one_line, own_calls
from rl_yardstick.pipeline.evaluation.critics import recorder_of
from rl_yardstick.pipeline.evaluation.judge import Judge
from rl_yardstick.pipeline.evaluation.value_maps import ValueMapRecorder
from rl_yardstick.pipeline.evaluation.yardstick import Evaluation
from rl_yardstick.pipeline.finite_numbers import NumberWatch, check_model
from rl_yardstick.pipeline.models import NONE, REPLAY_BUFFER, begun_with, load_to_train
from rl_yardstick.pipeline.pictures import draw
from rl_yardstick.pipeline.run import FAILED, FINISHED, INTERRUPTED, Run, save_agent
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.pipeline.watching import TableRecorder, Watch, watch_of

# What libraries raise for settings that they cannot work with.
REFUSALS = (ValueError, TypeError, AssertionError, RuntimeError, MemoryError)  # of constructors
OF_LIBRARIES = (*REFUSALS, ArithmeticError, LookupError)


def train(
    spec: TrainSpec,
    run: Run,
    resumes: bool = False,
    tell: Callable[[Training], object] = lambda training: None,
) -> Training:
    """Train an agent and leave a finished run folder, which is held by the caller.

    With ``resumes``, it goes on from the folder's state, if there is one. ``tell`` is given the
    training before it begins.

    Raises:
        UserError: if something does not fit; a new run without a step leaves no folder.
        Stopped: after a signal; the state and the agent are saved.
    """
    found_models.limit(spec.exact_model)
    if spec.n_threads > 0:
        th.set_num_threads(spec.n_threads)
    spec = spec if spec.trained_agent is None else begun_with(spec)
    asked = spec  # recorded without what the environment needs
    spec, notes = tried(spec)
    if spec.vec_normalize not in (None, NONE):
        notes = [f"normalised by the statistics in {spec.vec_normalize}", *notes]
    for note in notes:
        run.console.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)
    resumes = resumes and run.state_path.exists()
    agent = make_agent(spec, run.path, resumes)
    for line in numbered_spaces(agent):
        run.console.print(line, style="dim", markup=False, highlight=False, soft_wrap=True)
    try:
        training = Training(spec, run, agent, resumes)
        with closing(training.judge.env):
            tell(training)
            training.learn()
            training.save()
            training.judge_the_end()
            draw(run.path, training)
    except Stopped as stopped:
        if run.has_begun:
            training.save()
            training.evaluation.write()
            figures = {"stopped_by": stopped.number, "n_timesteps": agent.num_timesteps}
            run.record(asked, INTERRUPTED, **figures)
        raise
    except BaseException as error:
        if run.has_begun or not run.is_new:
            run.record(asked, FAILED, reason=one_line(error))
        raise
    finally:
        if agent.env is not None:
            agent.env.close()
        if hasattr(agent, "_logger"):
            agent.logger.close()
    run.record(asked, FINISHED, **training.figures(), **({"notes": notes} if notes else {}))
    run.state_path.unlink(missing_ok=True)
    return training


class Training:
    """The agent on its environments, its judge and its callbacks; at the end, the results too.

    With ``resumes``, the state in the run folder is put back before the first step.
    """

    final: Evaluation | None = None  #: of the agent at the end; None if there are no evaluations
    pulled: callbacks.PullSummary | None = None  #: of a training on a bandit
    engine: str | None = None  #: whether it was compiled, and if not, why; None if unknown
    evaluation_steps = 0  #: environment steps of sampled evaluations

    def __init__(self, spec: TrainSpec, run: Run, agent: BaseAlgorithm, resumes: bool) -> None:
        self.spec, self.run, self.agent = spec, run, agent
        is_bandit = agent.env is not None and agent.env.has_attr("n_arms")
        self.judge = judge = Judge(spec, agent, run.console)
        exact = judge.exact
        self.can_be_explained = exact is not None  # its gap can be split into parts
        frequencies = callbacks.evaluation_frequencies(spec, agent, is_bandit and exact is None)
        critics: Any = None
        if spec.diagnose:
            critics = "there are no evaluations during this training"
            if max(frequencies) > 0:
                critics = recorder_of(run.path / "diagnosis.csv", spec, agent)
        if isinstance(critics, str):
            run.console.print(f"no diagnosis: {critics}", style="dim", markup=False)
            critics = None
        maps = None
        if exact is not None and (spec.watch_learning or exact.layout is not None):
            maps = ValueMapRecorder(run.path / "value_maps.npz", exact)
        self.evaluation = callbacks.EvaluationCallback(run, judge, frequencies, maps, critics)
        recorder = watch_of(spec, agent, maps)
        self.watch: Watch | None = recorder or maps  # what a page plays of the training
        self.pulls = callbacks.PullRecorder(run.path) if is_bandit else None
        if is_bandit and getattr(agent, "engine", None) == "compiled":  # it stops at no pull
            self.pulls, note = None, "engine: compiled keeps no pulls, so regret is not known"
            run.console.print(note, style="dim")
        on_variant = bool(training_changes(spec))
        self.progress = callbacks.ProgressCallback(run.console, spec.total_timesteps, on_variant)
        self.callback = self._callbacks(resumes, recorder)

    def _callbacks(self, resumes: bool, recorder: TableRecorder | None) -> CallbackList:
        """All callbacks, in the order in which they act.

        Numbers are checked before anything keeps them, and a saved state is put back before any
        other callback acts.
        """
        spec, folder = self.spec, self.run.path
        schedules = [getattr(self.agent, name, None) for name in ("lr_schedule", "clip_range")]
        runs_by_steps = any(callable(s) and s(1.0) != s(0.0) for s in schedules)
        if spec.n_episodes and isinstance(self.agent, OnPolicyAlgorithm) and runs_by_steps:
            raise UserError(
                f"the schedules of {spec.algo} run by steps: give n_timesteps instead of "
                "n_episodes, or constant values"
            )
        every, every_episodes = spec.save_freq, spec.save_every_n_episodes
        where = str(folder), spec.save_replay_buffer
        given, typed = spec.callback, spec.gym_packages
        possible: list[BaseCallback | None] = [
            *(build(one, BaseCallback, "callback", typed, folder) for one in given),
            callbacks.Checkpoint(every, 0, *where) if every > 0 else None,
            callbacks.Checkpoint(None, every_episodes, *where) if every_episodes > 0 else None,
            *(self.pulls, self.evaluation.critics, recorder, self.evaluation),
            EpisodeBudget(spec.n_episodes) if spec.n_episodes is not None else None,
            self.progress,
        ]
        others = [callback for callback in possible if callback is not None]
        saver = callbacks.StateCallback(self.run, resumes, self.judge, others, self.progress)
        return CallbackList([NumberWatch(), saver, *others])

    def learn(self) -> None:
        """Let the agent learn; errors of the user's own code go through as they are."""
        spec, agent, interval = self.spec, self.agent, self.spec.log_interval
        is_read = spec.tensorboard_log or spec.library_log
        kwargs: dict[str, Any] = {"log_interval": interval if interval > 0 and is_read else None}
        try:
            with compile_timer() as time_compiling:
                self.progress.start_clock(time_compiling)
                agent.learn(
                    spec.total_timesteps,
                    callback=self.callback,
                    tb_log_name=spec.algo,
                    reset_num_timesteps=spec.trained_agent is None,
                    **({} if interval == -1 and is_read else kwargs),
                )
                self.progress.read_clock()
        except Exception as e:  # noqa: BLE001  # the user's own code may raise any
            if isinstance(e, OF_LIBRARIES):
                check_model(agent)  # PyTorch's error for nan in distributions is obscure
            raise told(e, f"{spec.title}, at step {agent.num_timesteps:,}")  # noqa: B904
        finally:
            self.progress.bar.stop()

    def save(self) -> None:
        """Save the agent at the end, and its replay buffer if that is asked for."""
        buffer = self.run.path / REPLAY_BUFFER if self.spec.save_replay_buffer else None
        save_agent(self.agent, self.run.model_path(self.spec), buffer)

    def judge_the_end(self) -> None:
        """Do the final evaluation, which may be the best one, or the only one."""
        evaluation, agent = self.evaluation, self.agent
        if evaluation.is_asked_for:
            self.final = evaluation.timed(evaluation.evaluator.at_the_end)
            evaluation.keep_if_best(self.final)
            if not evaluation.evaluations_timesteps:  # none was due, or affordable
                evaluation.evaluate(self.final)
            if evaluation.value_maps is not None:
                evaluation.value_maps.finish(agent)
            if evaluation.critics is not None:
                evaluation.critics.finish(agent.num_timesteps)
            self.evaluation_steps = getattr(evaluation.evaluator, "n_steps", 0)
        self.engine = getattr(agent, "engine_in_use", None)
        if self.pulls is not None and self.pulls.n_calls > 0:
            self.pulled = self.pulls.summary()

    def figures(self) -> dict[str, Any]:
        """The figures for ``run.json``."""
        evaluation, pulled, refusal = self.evaluation, self.pulled, self.judge.refusal
        return {
            "n_timesteps": self.agent.num_timesteps,
            "final": None if self.final is None else self.final.summary(),
            "best_mean_return": evaluation.best,
            "best_timesteps": evaluation.best_timesteps,
            "best_episodes": evaluation.best_episodes,
            "evaluation_steps": self.evaluation_steps,
            "engine": self.engine,
            **self.progress.taken.as_data(),
            **({} if pulled is None else {"regret": pulled.regret, "pulls": asdict(pulled)}),
            **({} if refusal is None else {"model_refused": refusal}),
        }


def told(error: Exception, where: str) -> Exception:
    """An error of the user's own code with a note of where it was, one of a library in a line."""
    *_, raised_in = traceback.extract_tb(error.__traceback__)
    if own_calls(error) and not raised_in.filename.startswith(PACKAGE):
        error.add_note(where)
    elif isinstance(error, OF_LIBRARIES):
        return UserError(f"{where}: {one_line(error)}")
    return error


def numbered_spaces(agent: Any) -> Iterator[str]:
    """A line for each space whose members the agent numbers."""
    original = getattr(agent, "original_spaces", None) or ()
    own = agent.observation_space, agent.action_space
    roles = ("observations", "rows"), ("actions", "columns")
    for space, numbers, (role, unit) in zip(original, own, roles, strict=False):
        if space != numbers:
            yield f"{role}: {describe(space)} as {numbers.n:,} {unit}"


def make_agent(spec: TrainSpec, folder: Path | None, appending: bool = False) -> BaseAlgorithm:
    """The agent on its training environments, whose Monitors write into ``folder``."""
    algorithm: Any = load_algorithm(spec.algo)
    env = make_training_env(spec, folder, appending)
    log = None if spec.tensorboard_log is None else Path(spec.tensorboard_log) / spec.env_name
    try:
        is_dict = isinstance(env.observation_space, spaces.Dict)
        arguments = constructor_arguments(spec, algorithm, is_dict)
        arguments |= {
            "seed": spec.seed,
            "device": spec.device,
            "verbose": int(spec.library_log),
            "tensorboard_log": None if log is None else str(log),
            **action_noise(spec, env.action_space),
        }
        made = algorithm if spec.trained_agent is None else partial(load_to_train, spec)
        agent: BaseAlgorithm = made(env=env, **arguments)
    except (UserError, *REFUSALS) as error:
        env.close()
        raise told(error, f"{spec.algo} on {spec.place}")  # noqa: B904
    if log is None and not spec.library_log:
        agent.set_logger(Logger(folder=None, output_formats=[]))
    elif log is not None and appending:
        newest = max(log.glob(f"{spec.algo}_*"), key=lambda p: p.stat().st_mtime, default=None)
        if newest is not None:  # the library would begin another log
            agent.set_logger(configure(str(newest), ["tensorboard"]))
    # The library seeds environment i with seed + i, so neighbouring seeds would share most.
    env.seed(first_seed(spec))
    return agent
