"""From the arguments of ``compare.py`` to a study."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from agents import ALGORITHMS
from commands.flag_values import LONGEST_FOLDER_NAME
from commands.parsing import check_tensorboard
from experiments.study import (
    AS_IT_COMES,
    METRICS,
    AgentSpec,
    EnvironmentSpec,
    StudySpec,
    file_name,
    find_study,
    layered,
    read_study,
)
from pipeline.agent_checks import with_engine
from pipeline.environments import check_env_id
from pipeline.errors import UserError, unknown
from pipeline.runs import environment_name
from pipeline.settings.values import parse_assignments
from pipeline.user_modules import import_typed


def study_spec(args: argparse.Namespace) -> StudySpec:
    """The study that the arguments mean, with what they change in it.

    Raises:
        UserError: if it is not clear what to compare, or on what.
    """
    _check_output(args)
    modules = import_typed(args.gym_packages, args.env)
    study = _study_of_file(args) if args.study else _study_of_flags(args)
    # A flag that has the name of a field goes there as it is, where it is given.
    named = {key.name: getattr(args, key.name) for key in fields(StudySpec) if key.name in args}
    names = tuple(module.name for module in modules)
    changes = {**named, "n_seeds": args.seeds, "gym_packages": names, "user_modules": modules}
    changes = {key: value for key, value in changes.items() if value is not None}
    study = replace(_with_settings(study, args), **changes)
    return study.quickened() if args.is_quick else study


def _check_output(args: argparse.Namespace) -> None:
    if args.max_seeds is not None and not args.until_decided:
        raise UserError("--max-seeds belongs to --until-decided: give both, or --seeds")
    for flag in ("quick", "replace"):
        if args.until_decided and getattr(args, "is_quick" if flag == "quick" else flag):
            raise UserError(f"--until-decided and --{flag} do not go together: give one of them")
    if args.learning_pages and args.no_report:
        raise UserError("--watch-learning is a section of the page: leave out --no-report")
    if args.metric is not None and args.metric not in METRICS:
        raise unknown("--metric: unknown metric", args.metric, METRICS)
    check_tensorboard(args.tensorboard)


def _study_of_file(args: argparse.Namespace) -> StudySpec:
    if args.env or args.algos:
        raise UserError("give a study file, or --env and --algos, not both")
    return read_study(find_study(args.study))


def _study_of_flags(args: argparse.Namespace) -> StudySpec:
    if not (args.env and args.algos):
        raise UserError("what to compare? give --env and --algos, or a study file")
    for algo in args.algos:
        if algo not in ALGORITHMS:
            raise unknown("unknown agent", algo, ALGORITHMS)
    for env_id in args.env:
        check_env_id(env_id)
    for flag, names in (("--env", args.env), ("--algos", args.algos)):
        if len(set(names)) < len(names):
            raise UserError(f"{flag} names one of them twice")
    agents, environments = ", ".join(args.algos), ", ".join(args.env)
    folders = "-".join(map(environment_name, args.env))
    return StudySpec(
        name=file_name(f"{folders}_{'-'.join(args.algos)}", LONGEST_FOLDER_NAME),
        title=f"{agents} on {environments}",
        agents=tuple(AgentSpec(algo, algo) for algo in args.algos),
        environments=tuple(EnvironmentSpec(env_id, env_id) for env_id in args.env),
    )


def _conf_files(study: StudySpec, words: Sequence[str]) -> dict[str, Path]:
    """The files of ``--conf-file``, by the agents' names in the table of agents.

    Raises:
        UserError: if it is not clear whose a file is, or there is none.
    """
    algos = list(dict.fromkeys(agent.algo for agent in study.agents))
    files: dict[str, Path] = {}
    for word in words:
        algo, colon, name = word.partition(":")
        if not (colon and algo in algos):
            if len(algos) > 1:
                example = f"{algos[0]}:{word}"
                raise UserError(
                    f"--conf-file {word}: whose hyperparameters? a file has those of one "
                    f"agent ({', '.join(algos)}): {example}"
                )
            algo, name = algos[0], word
        if algo in files:
            raise UserError(f"--conf-file names two files for {algo}")
        files[algo] = Path(name)
        if not files[algo].is_file():
            raise UserError(f"--conf-file: there is no file {files[algo]}")
    return files


def _with_settings(study: StudySpec, args: argparse.Namespace) -> StudySpec:
    """The study with the settings of the command line in every agent."""
    files = _conf_files(study, args.conf_file)
    changes: dict[str, Any] = parse_assignments(args.hyperparams, "--hyperparams")
    if args.env_kwargs:
        named = {"env_kwargs": parse_assignments(args.env_kwargs, "--env-kwargs")}
        changes = layered(changes, named)
    if args.as_it_comes:
        changes = {**AS_IT_COMES, **changes}
    for key in ("n_timesteps", "n_episodes"):
        if getattr(args, key) is not None:
            changes[key] = getattr(args, key)
    agents = tuple(
        replace(
            agent,
            settings=layered(agent.settings, with_engine(agent.algo, changes, args.engine)),
            conf_file=files.get(agent.algo, agent.conf_file),
        )
        for agent in study.agents
    )
    return replace(study, agents=agents)
