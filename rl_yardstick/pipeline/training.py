"""A training from its spec to a finished folder: `train`."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import set_random_seed

import rl_yardstick
from rl_yardstick.agents import load_algorithm
from rl_yardstick.agents.common.callbacks import BlockCallback, EpisodeBudget
from rl_yardstick.machine_code import WorkTime
from rl_yardstick.machine_code.compiling import compile_timer
from rl_yardstick.pipeline.callbacks import (
    EpisodeCheckpoint,
    EvaluationCallback,
    NumberWatch,
    PullRecorder,
    PullSummary,
    StateCallback,
    StepCheckpoint,
    evaluation_frequencies,
    summarise_pulls,
)
from rl_yardstick.pipeline.components import action_noise, build, constructor_arguments
from rl_yardstick.pipeline.environments import (
    first_seed,
    make_training_env,
    training_changes,
)
from rl_yardstick.pipeline.errors import Stopped, UserError, one_line
from rl_yardstick.pipeline.evaluation.advice import Advice, advice
from rl_yardstick.pipeline.evaluation.critics import recorder_of
from rl_yardstick.pipeline.evaluation.judge import Judge
from rl_yardstick.pipeline.evaluation.sampled import Evaluation
from rl_yardstick.pipeline.evaluation.value_maps import ValueMapRecorder
from rl_yardstick.pipeline.files import replacing
from rl_yardstick.pipeline.finite_numbers import check_model
from rl_yardstick.pipeline.models import REPLAY_BUFFER, begun_with, load_to_train
from rl_yardstick.pipeline.pictures import draw
from rl_yardstick.pipeline.progress import ProgressCallback
from rl_yardstick.pipeline.run import FAILED, FINISHED, INTERRUPTED, Run
from rl_yardstick.pipeline.spec import TrainSpec
from rl_yardstick.pipeline.watching import Watch, watch_of

# What libraries raise for settings that they cannot work with.
REFUSALS = (ValueError, TypeError, AssertionError, RuntimeError, MemoryError)  # of constructors
OF_LIBRARIES = (
    *(ArithmeticError, AssertionError, LookupError, RuntimeError, TypeError, ValueError),
)


@dataclass(frozen=True)
class Outcome:
    """What a run came to."""

    n_timesteps: int  #: environment steps done
    taken: WorkTime  #: the time of training and its evaluations, without compiling
    final: Evaluation | None  #: of the agent at the end; None if there are no evaluations
    best: float | None  #: mean return of the best evaluation during training
    best_timesteps: int  #: the step of that evaluation
    best_episodes: int  #: its episodes; 0 if it is exact
    evaluating: WorkTime  #: the time of all evaluations, including the last one
    evaluation_steps: int  #: environment steps of sampled evaluations
    engine: str | None  #: whether training was compiled, and if not, why; None if unknown
    pulls: PullSummary | None  #: of a training on a bandit
    watch: Watch | None  #: what a page plays of the training
    advice: Advice | None  #: on an agent that has failed
    can_be_explained: bool  #: whether its gap can be split into parts

    def figures(self) -> dict[str, Any]:
        """The figures for ``run.json``."""
        pulls = self.pulls
        return {
            "n_timesteps": self.n_timesteps,
            "final": None if self.final is None else self.final.summary(),
            "best_mean_return": self.best,
            "best_timesteps": self.best_timesteps,
            "best_episodes": self.best_episodes,
            "evaluation_steps": self.evaluation_steps,
            "engine": self.engine,
            **self.taken.as_data(),
            **({} if pulls is None else {"regret": pulls.regret, "pulls": asdict(pulls)}),
        }


def train(
    spec: TrainSpec,
    run: Run,
    resumes: bool = False,
    tell: Callable[[Parts], object] = lambda parts: None,
) -> Outcome:
    """Train an agent and leave a finished run folder.

    Args:
        spec: the training.
        run: its folder, held by the caller.
        resumes: whether to go on from the folder's state, if it has one.
        tell: is given the parts of the training before it begins.

    Raises:
        UserError: if something does not fit; a new run without a step leaves no folder.
        Stopped: after a signal; the state and the agent are saved.
    """
    if spec.n_threads > 0:
        th.set_num_threads(spec.n_threads)
    parts = Parts(begun_with(spec), run, resumes and run.state_path.exists())
    try:
        tell(parts)
        parts.learn()
        parts.save()
        outcome = parts.outcome()
        draw(run.path, parts)
    except Stopped as stopped:
        if run.has_begun:
            parts.save()
            parts.evaluation.write()
            figures = {"stopped_by": stopped.number, "n_timesteps": parts.agent.num_timesteps}
            run.record(parts.spec, INTERRUPTED, **figures)
        raise
    except BaseException as error:
        if run.has_begun or not run.is_new:
            run.record(parts.spec, FAILED, reason=one_line(error))
        raise
    finally:
        parts.close()
    facts = {} if parts.judge.refusal is None else {"model_refused": parts.judge.refusal}
    run.record(parts.spec, FINISHED, **outcome.figures(), **facts)
    run.state_path.unlink(missing_ok=True)
    return outcome


class Parts:
    """The parts of a training: the agent on its environments, its judge, and its callbacks."""

    def __init__(self, spec: TrainSpec, run: Run, resumes: bool) -> None:
        self.spec, self.run = spec, run
        self.agent = make_agent(spec, run.path, resumes)
        try:
            self._make_others(resumes)
        except BaseException:
            if self.agent.env is not None:
                self.agent.env.close()
            raise

    def _make_others(self, resumes: bool) -> None:
        spec, run = self.spec, self.run
        self.is_bandit = self.agent.env is not None and self.agent.env.has_attr("n_arms")
        self.judge = Judge(spec, self.agent, run.console)
        exact = self.judge.exact
        frequencies = evaluation_frequencies(spec, self.agent, self.is_bandit and exact is None)
        critics = None
        if spec.diagnose:
            is_evaluated = max(frequencies) > 0
            found = recorder_of(
                run.path / "diagnosis.csv", spec, self.agent, is_evaluated=is_evaluated
            )
            critics = found if not isinstance(found, str) else None
            if critics is None:
                run.console.print(f"no diagnosis: {found}", style="dim", markup=False)
        maps = None
        if exact is not None and (spec.watch_learning or exact.layout is not None):
            maps = ValueMapRecorder(run.path / "value_maps.npz", exact)
        evaluator, eval_env = self.judge.evaluator, self.judge.env
        self.evaluation = EvaluationCallback(run, eval_env, evaluator, frequencies, maps, critics)
        self.watch = watch_of(spec, self.agent, maps)
        self.pulls = self._pull_recorder()
        self.clock = Clock()
        self.progress = ProgressCallback(
            run.console, spec.total_timesteps, bool(training_changes(spec))
        )
        self.callback = self._callbacks(resumes)

    def _pull_recorder(self) -> PullRecorder | None:
        if not self.is_bandit:
            return None
        if getattr(self.agent, "engine", None) == "compiled":  # it does not stop at pulls
            note = "engine: compiled keeps no pulls, so regret is not known"
            self.run.console.print(note, style="dim")
            return None
        return PullRecorder(self.run.path)

    def _callbacks(self, resumes: bool) -> CallbackList:
        """All callbacks, in the order in which they act.

        Numbers are checked before anything keeps them, and a saved state is put back before any
        other callback acts.
        """
        spec, run = self.spec, self.run
        with_buffer = spec.save_replay_buffer
        others: list[BaseCallback | None] = [
            *(self._of_settings()),
            StepCheckpoint(run, spec.save_freq, with_buffer) if spec.save_freq > 0 else None,
            EpisodeCheckpoint(run, spec.save_every_n_episodes, with_buffer)
            if spec.save_every_n_episodes > 0
            else None,
            *(self.pulls, self.evaluation.critics, self.watch, self.evaluation),
            EpisodeBudget(spec.n_episodes) if spec.n_episodes is not None else None,
            *(self.clock, self.progress),
        ]
        saver = StateCallback(run, resumes, self.clock, self.judge)
        saver.others = [callback for callback in others if callback is not None]
        return CallbackList([NumberWatch(), saver, *saver.others])

    def _of_settings(self) -> list[BaseCallback]:
        spec, typed, folder = self.spec, self.spec.gym_packages, self.run.path
        schedules = [getattr(self.agent, name, None) for name in ("lr_schedule", "clip_range")]
        runs_by_steps = any(callable(s) and s(1.0) != s(0.0) for s in schedules)
        is_on_policy = isinstance(self.agent, OnPolicyAlgorithm)
        if spec.n_episodes is not None and is_on_policy and runs_by_steps:
            raise UserError(
                f"the schedules of {spec.algo} run by steps: give n_timesteps instead of "
                "n_episodes, or constant values"
            )
        return [build(one, BaseCallback, "callback", typed, folder) for one in spec.callback]

    def learn(self) -> None:
        """Let the agent learn.

        Raises:
            UserError: for a library's error about the settings; those of the user's own code go
                through as they are.
        """
        spec, agent = self.spec, self.agent
        kwargs: dict[str, Any] = {}
        if not (spec.tensorboard_log or spec.library_log):
            kwargs["log_interval"] = None  # nobody reads it
        elif spec.log_interval != -1:
            kwargs["log_interval"] = spec.log_interval if spec.log_interval > 0 else None
        try:
            with compile_timer() as time_compiling:
                self.clock.start(time_compiling)
                agent.learn(
                    spec.total_timesteps,
                    callback=self.callback,
                    tb_log_name=spec.algo,
                    reset_num_timesteps=spec.trained_agent is None,
                    **kwargs,
                )
                self.clock.stop()
        except OF_LIBRARIES as e:
            check_model(agent)  # PyTorch's error for nan in distributions is obscure
            if is_of_user(e):
                raise
            when = f"{spec.title}, at step {agent.num_timesteps:,}"
            raise UserError(f"{when}: {one_line(e)}") from e
        finally:
            self.progress.close()

    def save(self) -> None:
        """Save the agent at the end, and its replay buffer if that is asked for."""
        self.run.save(self.agent, self.run.model_path(self.spec))
        agent: Any = self.agent
        if self.spec.save_replay_buffer and getattr(agent, "replay_buffer", None) is not None:
            with replacing(self.run.path / REPLAY_BUFFER) as beside:
                agent.save_replay_buffer(beside)

    def outcome(self) -> Outcome:
        """Do missing evaluations and the final one."""
        evaluation, agent, final = self.evaluation, self.agent, None
        if evaluation.is_asked_for:
            if not evaluation.evaluations_timesteps:  # the run was shorter than their interval
                evaluation.init_callback(agent)
                evaluation.evaluate()
            evaluation.write()
            if evaluation.value_maps is not None:
                evaluation.value_maps.finish(agent)
            if evaluation.critics is not None:
                evaluation.critics.finish(agent.num_timesteps)
            evaluation.take_statistics()
            begun = WorkTime.now()
            final = self.judge.at_the_end(agent)
            evaluation.taken += WorkTime.now() - begun
        pulled = self.pulls is not None and self.pulls.n_calls > 0
        return Outcome(
            agent.num_timesteps,
            self.clock.taken,
            final,
            evaluation.best,
            evaluation.best_timesteps,
            evaluation.best_episodes,
            evaluation.taken,
            getattr(evaluation.evaluator, "n_steps", 0),
            getattr(agent, "engine_in_use", None),
            summarise_pulls(self.pulls.arrays()) if self.pulls is not None and pulled else None,
            self.watch or (evaluation.value_maps if self.spec.watch_learning else None),
            self._advice(final),
            self.judge.exact is not None,
        )

    def _advice(self, final: Evaluation | None) -> Advice | None:
        if final is None or self.run.console.quiet:
            return None
        agent = self.agent
        return advice(self.spec, agent, self.judge.evaluator, final, agent.num_timesteps)

    def close(self) -> None:
        """Close all environments."""
        self.progress.close()
        if self.agent.env is not None:
            self.agent.env.close()
        self.judge.env.close()
        if hasattr(self.agent, "_logger"):
            self.agent.logger.close()


class Clock(BlockCallback):
    """The time of a training over all its starts, without compiling."""

    excluded_from_states = ("_begun", "_compiling")

    def __init__(self) -> None:
        super().__init__()
        self.taken = WorkTime()

    def start(self, time_compiling: Any) -> None:
        """Begin to count."""
        self._begun, self._compiling = WorkTime.now() - time_compiling(), time_compiling

    def stop(self) -> None:
        """Add the time since the start, and go on counting from here."""
        now = WorkTime.now() - self._compiling()
        self.taken, self._begun = self.taken + (now - self._begun), now

    def _on_step(self) -> bool:
        return True


def make_agent(spec: TrainSpec, folder: Path | None, appending: bool = False) -> BaseAlgorithm:
    """The agent on its training environments, whose Monitors write into ``folder``.

    Raises:
        UserError: if the constructor refuses an argument.
    """
    algorithm: Any = load_algorithm(spec.algo)
    env = make_training_env(spec, folder, appending)
    try:
        is_dict = isinstance(env.observation_space, spaces.Dict)
        arguments = constructor_arguments(spec, algorithm, is_dict)
        log = spec.tensorboard_log
        common: dict[str, Any] = {
            "seed": spec.seed,
            "verbose": int(spec.library_log),
            "tensorboard_log": None if log is None else str(Path(log) / spec.env_name),
            **action_noise(spec, env.action_space),
        }
        if spec.trained_agent is not None:
            agent = load_to_train(spec, env, device=spec.device, **common, **arguments)
        else:
            agent = _constructed(algorithm, env, {"device": spec.device, **common}, arguments)
    except BaseException as error:
        env.close()
        if isinstance(error, UserError) or not isinstance(error, REFUSALS):
            raise
        raise UserError(f"{spec.algo} on {spec.place}: {one_line(error)}") from error
    if not (spec.tensorboard_log or spec.library_log):
        agent.set_logger(Logger(folder=None, output_formats=[]))
    elif appending and spec.tensorboard_log:
        logs = (Path(spec.tensorboard_log) / spec.env_name).glob(f"{spec.algo}_*")
        newest = max(logs, key=lambda path: path.stat().st_mtime, default=None)
        if newest is not None:  # the library would begin another log
            agent.set_logger(configure(str(newest), ["tensorboard"]))
    # The library seeds environment i with seed + i, so neighbouring seeds would share most.
    env.seed(first_seed(spec))
    return agent


def _constructed(
    algorithm: Any, env: Any, common: dict[str, Any], arguments: dict[str, Any]
) -> BaseAlgorithm:
    """A new agent; what its constructor does not take is set afterwards."""
    from rl_yardstick.pipeline.arguments import constructor_parameters

    taken = {key: common[key] for key in common if key in constructor_parameters(algorithm)}
    if "seed" not in taken:
        set_random_seed(common["seed"])
    agent: BaseAlgorithm = algorithm(env=env, **taken, **arguments)
    for name in common.keys() - taken.keys() - {"device"}:
        setattr(agent, name, common[name])
    if "seed" not in taken:
        agent.set_random_seed(common["seed"])
    return agent


def is_of_user(error: Exception) -> bool:
    """Whether an error comes from code outside the libraries; its traceback is shown as it is."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = "site-packages", str(Path(rl_yardstick.__file__).parent)
    return not any(place in frames[-1].filename for place in ours)
