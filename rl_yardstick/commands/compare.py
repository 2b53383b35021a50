"""``compare.py``: its flags, the steps of a study, and its output."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rl_yardstick.commands.cli import (
    COUNT,
    OneLineParser,
    add_shared,
    called_as,
    check_tensorboard,
    command_line,
    folder_name,
    whole_number,
    with_engine,
)
from rl_yardstick.pipeline.errors import UserError, shown, unknown

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console

    from rl_yardstick.experiments.analysis import StudyAnalysis
    from rl_yardstick.experiments.plan import PlannedRun, StudyRecord
    from rl_yardstick.experiments.pool import Workers
    from rl_yardstick.experiments.results import StudyResults
    from rl_yardstick.experiments.study import AgentSpec, StudySpec
    from rl_yardstick.pipeline.run import Stop
    from rl_yardstick.verdicts import Study

# --- flags ----------------------------------------------------------------------------------------

SEEDS = whole_number(1, 1_000_000)

EPILOG = """\
examples:
  python compare.py --env FrozenLake-v1 --algos qlearning sarsa dqn ppo --seeds 10
  python compare.py --env Warehouse-v0 MineMaze-v0 --algos qlearning ppo --engine auto
  python compare.py studies/warehouse-learning-rate.yml
  python compare.py studies/warehouse-learning-rate.yml --quick
  python compare.py studies/warehouse-learning-rate.yml --until-decided
  python compare.py --resume logs/studies/warehouse-learning-rate
  python compare.py --logged log.csv --policy logs/linucb/ReplayBandit-v0_1

The same command again does the missing runs, and no others.
"""


def build_parser() -> argparse.ArgumentParser:
    """The flags; those of single runs have the same meaning as in train."""
    parser = OneLineParser(
        description="Compare agents on environments over seeds: tables, figures, and a page.",
        epilog=EPILOG,
    )
    add = parser.add_argument
    add("study", nargs="?", metavar="STUDY.yml", help="a study file, or the name of a shipped one")
    add("--env", nargs="+", default=[], metavar="ID", help="environments")
    add("--algos", nargs="+", default=[], metavar="AGENT", help="agents (train --list has them)")
    add("--seeds", type=SEEDS, metavar="N", help="how many seeds (default: the study's, or 10)")
    first = "the first of these seeds (default: the study's, or 0)"
    add("--first-seed", type=whole_number(0, 2**31), metavar="N", help=first)
    decided = "give agents in undecided pairs more seeds, at looks that are fixed beforehand"
    add("--until-decided", action="store_true", help=decided)
    add("--max-seeds", type=SEEDS, metavar="N", help="the most seeds for that (default: 80)")
    add_shared(parser, "--n-timesteps", "--n-episodes")
    add_shared(parser, "--hyperparams", help="hyperparameters to change in every agent")
    add_shared(parser, "--engine")
    files = "hyperparameters from another file; with several agents, for which: dqn:mine.yml"
    add("-conf", "--conf-file", nargs="+", default=[], metavar="[AGENT:]YAML", help=files)
    add_shared(parser, "--env-kwargs")
    unmodified = "train every agent on the unmodified environment, without the changes that "
    unmodified += "settings make in training only (train_env_kwargs, train_env_wrapper)"
    add("--as-it-comes", action="store_true", help=unmodified)
    add_shared(parser, "--gym-packages")
    quick = "few seeds and a small budget, for a first look"
    add("--quick", action="store_true", dest="is_quick", help=quick)

    group = parser.add_argument_group("runs")
    add_shared(group, "--jobs", "--cluster", "--run-timeout")
    add = group.add_argument
    replaced = "do finished runs with other settings again; the old folders are kept"
    add("--replace", action="store_true", help=replaced)
    resumed = "do what is left of the study in this folder, as it was asked for"
    add("--resume", type=Path, metavar="STUDY", help=resumed)

    _add_output_flags(parser.add_argument_group("judgement and output"))

    add = parser.add_argument_group("off-policy evaluation, instead of a study").add_argument
    add("--logged", type=Path, metavar="LOG.csv", help="judge trained agents on logged pulls")
    add("--policy", nargs="+", default=[], type=Path, metavar="RUN", help="run folders or zips")
    named = "the log's own names of columns, e.g. arm=item_id reward=click"
    add("--columns", nargs="+", default=[], metavar="NAME=COLUMN", help=named)
    return parser


def _add_output_flags(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--metric", help="the figure that verdicts compare: final, best, area, regret, ...")
    tied = "difference of the means within which agents are tied"
    add("--margin", type=_margin, help=tied)
    add("--episodes-table", type=COUNT, metavar="N", help="average, min, max of every N episodes")
    filmed = "film one episode after every N episodes"
    add("--render-every", type=whole_number(0), default=0, metavar="N", help=filmed)
    add("--name", type=folder_name, help="name of the study's folder (default: from the study)")
    add_shared(group, "--log-folder", default="logs/studies", help="folder of all studies")
    add("-tb", "--tensorboard", action="store_true", help="write a TensorBoard log of each run")
    compared = "compare values, advantages and gradients with the exact ones at each evaluation"
    add("--diagnose", action="store_true", default=None, help=compared)
    watched = "train the first run of each agent again, and link pages that play how it learns"
    add("--watch-learning", action="store_true", dest="learning_pages", help=watched)
    formats = "formats of the figures: png, svg, pdf (default: png svg)"
    kinds = ("png", "svg", "pdf")
    add("--figures", nargs="+", choices=kinds, metavar="FORMAT", help=formats)
    add("--no-report", action="store_true", help="only tables: no figures and no page")


def _margin(text: str) -> float:
    with suppress(ValueError):
        if 0 <= (number := float(text)) < float("inf"):
            return number
    raise argparse.ArgumentTypeError(f"must be a number of at least 0, not {text!r}")


# --- the steps of a study -------------------------------------------------------------------------


def main() -> int:
    """Do a study, or judge policies on a log; return the exit code."""
    args = build_parser().parse_args()
    from rl_yardstick.pipeline.components import check_typed, import_modules, split_id
    from rl_yardstick.pipeline.run import Stop

    stop = Stop().listen()
    ids = [split_id(env_id) for env_id in args.env]
    args.gym_packages = [*args.gym_packages, *(module for module, _ in ids if module)]
    args.env = [env_id for _, env_id in ids]
    import_modules(args.gym_packages)
    if args.logged or args.policy:
        from rl_yardstick.commands.logged import compare_on_log

        return compare_on_log(args)
    from rl_yardstick.commands.terminal import table_console
    from rl_yardstick.experiments.plan import StudyRecord, specs_of

    if args.resume is not None:
        check_alone(args)
        root, record = args.resume, StudyRecord.read(args.resume)
        check_typed(record.study.gym_packages, args.gym_packages, str(root))
    else:
        study = study_spec(args)
        root, record = Path(args.log_folder) / study.name, StudyRecord(study, specs_of(study))
    workers = workers_of(args, root, record.study.run_timeout)
    job = Job(root, command_line(), table_console(), stop, workers, not args.no_report)
    job.console.print(record.study.title, style="bold")
    with held(root), workers:
        if args.until_decided:
            from rl_yardstick.experiments.plan import plan_of_looks

            looks = plan_of_looks(record.study, root, args.max_seeds)
            record = replace(record, looks=looks)
        return carry_out(job, record, args.replace)


@dataclass(frozen=True)
class Job:
    """What the steps of a study share: its folder, the command, and who does the runs."""

    root: Path  #: the folder of the study
    command: str  #: recorded in run folders
    console: Console
    stop: Stop
    workers: Workers
    with_page: bool = True  #: draw the figures and write the page, beside the tables


@contextmanager
def held(root: Path) -> Iterator[None]:
    """Hold a study's folder; it is removed again if nothing comes of it."""
    from rl_yardstick.pipeline.run import LOCK, Run

    root.mkdir(parents=True, exist_ok=True)
    with Run(root):  # with the lock of a run's folder
        try:
            yield
        finally:
            if [path.name for path in root.iterdir()] == [LOCK]:
                (root / LOCK).unlink()
                with suppress(OSError):  # of folders above that are not empty
                    for folder in (root, *list(root.parents)[:2]):
                        folder.rmdir()


def workers_of(args: argparse.Namespace, root: Path, timeout: float | None) -> Workers:
    """The workers that the flags ask for."""
    from rl_yardstick.experiments.pool import Workers, available_cores

    jobs = max(args.jobs, 0)
    if args.cluster is None:
        return Workers(jobs or available_cores(), timeout)
    try:
        from rl_yardstick.experiments.cluster import ClusterWorkers

        return ClusterWorkers(args.cluster, jobs, root, timeout)
    except ImportError:
        raise UserError("--cluster needs Dask: pip install 'rl-yardstick[cluster]'") from None


def carry_out(job: Job, record: StudyRecord, replaces: bool = False) -> int:
    """Do a study, and judge it; return 0 if all runs are finished, else 1."""
    from rl_yardstick.experiments.plan import plan

    study, looks = record.study, record.looks
    planned = plan(study, job.root, specs=record.specs)
    check_settings_kept(job, planned, replaces)
    record.write(job.root)
    if engines := _engines(planned):
        job.console.print(f"engines: {engines}")
    if not looks:
        return conclude(job, do_study(job, study, planned), ())
    results, said = look_by_look(job, record)
    code = conclude(job, results, looks)
    # The number of runs, compared with a design that gives every agent all seeds.
    open_ = [p for p in said.pairs if p.word == "undecided"]
    undecided = "; ".join(f"{p.first} and {p.second} on {p.environment}" for p in open_)
    left = f"undecided: {undecided}" if undecided else "all is decided"
    n_runs = sum(sum(by.values()) for by in said.seeds.values())
    design = f"{looks[-1]:,} seeds of each agent would be {looks[-1] * len(record.specs):,}"
    job.console.print(f"{n_runs:,} runs, where {design}; {left}")
    return code


def check_settings_kept(job: Job, planned: Sequence[PlannedRun], replaces: bool) -> None:
    """Refuse to do runs again that finished with other settings, or move them aside."""
    from rl_yardstick.experiments.plan import other_settings

    others = other_settings(planned)
    if not others:
        return
    if not replaces:
        pairs = {key: pair for _, settings in others for key, pair in settings.items()}
        named = [f"{key}: {shown(a)} there, {shown(b)} now" for key, (a, b) in pairs.items()]
        words = "; ".join(named[:3]) + ("; ..." if len(named) > 3 else "")
        runs = "1 finished run has" if len(others) == 1 else f"{len(others)} finished runs have"
        raise UserError(
            f"{job.root}: {runs} other settings ({words}): --name NAME makes another study of it, "
            "--replace does them again and moves the old ones to replaced/"
        )
    place = job.root / "replaced" / str(len([*job.root.glob("replaced/*")]) + 1)
    for run, _ in others:
        target = place / run.path.relative_to(job.root / "runs")
        target.parent.mkdir(parents=True, exist_ok=True)
        run.path.rename(target)
    runs = "1 run is" if len(others) == 1 else f"{len(others)} runs are"
    job.console.print(f"{runs} done again: the old folders are in {place} now")


def _engines(planned: Sequence[PlannedRun]) -> str:
    """The engines of the missing runs of networks, in words."""
    from rl_yardstick.commands.engines import NETWORKS, planned_outlook, study_line

    missing: dict[tuple[str, str], list[PlannedRun]] = {}
    for run in planned:
        if run.spec.algo in NETWORKS and not run.is_finished:
            missing.setdefault(run.labels, []).append(run)
    if not missing:  # without the libraries
        return ""
    found = [(labels[0], planned_outlook(r[0].spec), len(r)) for labels, r in missing.items()]
    return study_line([(label, each, n) for label, each, n in found if each is not None])


def do_study(
    job: Job, study: StudySpec, planned: Sequence[PlannedRun], known: dict[Any, Any] | None = None
) -> StudyResults:
    """Do the missing runs of a study, and read all; ``known`` were read or failed before."""
    from rl_yardstick.experiments.pool import do_runs

    known = {} if known is None else known
    failures: dict[Path, str] = known.setdefault("failures", {})
    to_do = [run for run in planned if run.path not in failures and not run.is_finished]
    n_done = len(planned) - len(to_do)
    runs = "1 run" if len(planned) == 1 else f"{len(planned)} runs"
    there = f"{n_done} of them there already"
    job.console.print(f"{runs}, {there}; {job.workers.words}, in {job.root}")
    try:
        failures |= do_runs(to_do, job.workers, job.command, job.console, job.stop)
    finally:
        if job.stop.number:
            again = f"{called_as('compare')} --resume {job.root}"
            job.console.print(f"stopped; continue with: {again}")
    from rl_yardstick.experiments.results import read_results

    with job.console.status("reading the results"):
        results = read_results(study, planned, job.root, known.setdefault("results", {}))
    return replace(results, failures=failures)


def look_by_look(
    job: Job, record: StudyRecord, is_enough: Callable[[Study], bool] = lambda said: False
) -> tuple[StudyResults, Study]:
    """Do the runs of one planned look after another, until no agent needs seeds or ``is_enough``.

    It begins with the first look: finished runs may already be enough.
    """
    from rl_yardstick.experiments.analysis import looked
    from rl_yardstick.experiments.plan import plan

    counts = dict.fromkeys(record.specs, record.study.n_seeds)
    n_said, known = 0, dict[Any, Any]()
    while True:
        study = replace(record.study, n_seeds=max(counts.values()))
        planned = plan(study, job.root, counts, record.specs)
        results = do_study(job, study, planned, known)
        said = looked(results, record.looks)
        is_over = said.is_done or is_enough(said)
        if said.n_looks != n_said:
            n_said = said.n_looks
            job.console.print(_on_look(said, record.looks))
        if is_over:
            return results, said
        counts |= {(agent, e): n for e, by in said.seeds.items() for agent, n in by.items()}


def _on_look(said: Study, looks: Sequence[int]) -> str:
    """The result of a look: its number of seeds, and of undecided pairs."""
    text = f"look {said.n_looks} of {len(looks)}, at {looks[max(said.n_looks - 1, 0)]:,} seeds: "
    n_undecided = sum(pair.word == "undecided" for pair in said.pairs)
    if not n_undecided:
        return f"{text}all pairs are decided"
    return f"{text}{n_undecided} of {len(said.pairs)} pairs undecided"


def conclude(job: Job, results: StudyResults, looks: tuple[int, ...]) -> int:
    """Judge the finished runs, and say which are missing; return the exit code."""
    from rl_yardstick.experiments.results import mixed_versions

    tell = job.console.print
    if len(results.summary):
        _judge(job, results, looks)
        records = {run.environment: run.recorded() for run in results.finished[::-1]}
        for environment, record in records.items():
            if refusal := record.get("model_refused"):
                tell(f"{environment}: {refusal}; figures are sampled")
        if note := mixed_versions(run.recorded() for run in results.finished):
            tell(note)
    for one in results.left_out:
        again = f"remove {one.planned.path} to do it again"
        tell(f"left out: {one.planned.title}: {one.reason}; {again}")
    n_missing = len(results.planned) - len(results.finished)
    if n_missing > len(results.failures) + len(results.left_out):
        tell(f"{n_missing} of {len(results.planned)} runs are missing; the same command continues")
    return int(n_missing > 0)


def _judge(job: Job, results: StudyResults, looks: tuple[int, ...]) -> None:
    """Print the judgement, and write tables, figures and page."""
    from rl_yardstick.experiments.analysis import analyse, worst_failed_run

    console, width = job.console, results.study.episodes_table
    with console.status("judging the agents"):
        analysis = analyse(results, looks)
    job.stop.check()
    from rl_yardstick.report.documents import write_tables, write_verdicts
    from rl_yardstick.report.terminal import print_analysis, print_episodes_table

    print_analysis(console, analysis)
    if failed := worst_failed_run(results):
        console.print(f"why the worst run failed: {called_as('explain')} {failed}")
    with console.status("writing the tables"):
        files = [*write_tables(results), *write_verdicts(analysis, job.command)]
    blocks = None
    if width:
        from rl_yardstick.report.series import episodes_table

        blocks = episodes_table(results, width)
        print_episodes_table(console, blocks, width)
    if results.study.render_every:
        from rl_yardstick.report.films import write_films

        with console.status("filming"):
            films, refused = write_films(results)
        files += films
        for reason in refused:
            console.print(f"no film: {reason}")
    if job.with_page:
        files += _draw(job, analysis, blocks)
    console.print(f"\nfiles: {results.root}")
    for path in files:
        console.print(f"  {path.relative_to(results.root)}")


def _draw(job: Job, analysis: StudyAnalysis, blocks: pd.DataFrame | None) -> list[Path]:
    """Draw the figures and write the page; return the files."""
    from rl_yardstick.report.figures import write_figures
    from rl_yardstick.report.page import write_report
    from rl_yardstick.report.page.frame import Report
    from rl_yardstick.report.series import study_series

    root = analysis.results.root
    with job.console.status("drawing the figures"):
        series = study_series(analysis)
        files = write_figures(series, blocks)
    job.stop.check()
    learning = []
    if analysis.study.learning_pages:
        from rl_yardstick.report.page.learning import write_first_pages

        with job.console.status("watching"):
            learning = write_first_pages(analysis, job.workers.n_at_once, job.stop)
    with job.console.status("writing the page"):
        write_report(Report(series, job.command, learning=learning), root / "report.html")
    return [*files, *(root / one.place for one in learning if one.place), root / "report.html"]


# --- from flags to a study ------------------------------------------------------------------------

_BESIDE_RESUME = {"resume", "gym_packages", "jobs", "cluster", "no_report", "log_folder"}


def check_alone(args: argparse.Namespace) -> None:
    """Refuse flags of the study itself beside ``--resume``."""
    usual = vars(build_parser().parse_args([]))
    others = [name for name, value in vars(args).items() if value != usual[name]]
    if names := [name for name in others if name not in _BESIDE_RESUME]:
        raise UserError(f"--resume does a study as it was asked for: leave out {', '.join(names)}")


def study_spec(args: argparse.Namespace) -> StudySpec:
    """The study that the arguments select, with their changes."""
    from rl_yardstick.experiments.study import (
        METRICS,
        StudySpec,
        find_study,
        read_study,
        with_maps_named,
    )

    if args.max_seeds is not None and not args.until_decided:
        raise UserError("--max-seeds belongs to --until-decided: give both, or --seeds")
    for flag, is_given in (("quick", args.is_quick), ("replace", args.replace)):
        if args.until_decided and is_given:
            raise UserError(f"--until-decided and --{flag} do not go together: give one of them")
    if args.learning_pages and args.no_report:
        raise UserError("--watch-learning is a section of the page: leave out --no-report")
    if args.metric is not None and args.metric not in METRICS:
        raise unknown("--metric: unknown metric", args.metric, METRICS)
    check_tensorboard(args.tensorboard)
    if not args.study:
        study = _study_of_flags(args)
    elif args.env or args.algos:
        raise UserError("give a study file, or --env and --algos, not both")
    else:
        study = read_study(find_study(args.study))
    # A flag with the name of a field sets that field, if it is given.
    named = {key.name: getattr(args, key.name) for key in fields(StudySpec) if key.name in args}
    changes = {**named, "n_seeds": args.seeds, "gym_packages": tuple(args.gym_packages)}
    changes["figures"] = None if args.figures is None else tuple(args.figures)
    changes = {key: value for key, value in changes.items() if value is not None}
    study = with_maps_named(replace(_with_settings(study, args), **changes))
    if not args.study:
        environments = ", ".join(each.label for each in study.environments)
        study = replace(study, title=f"{', '.join(args.algos)} on {environments}")
    return study.quickened() if args.is_quick else study


def _study_of_flags(args: argparse.Namespace) -> StudySpec:
    from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec, file_name
    from rl_yardstick.pipeline.environments import check_env_id
    from rl_yardstick.pipeline.settings import check_agent

    if not (args.env and args.algos):
        raise UserError("what to compare? give --env and --algos, or a study file")
    for algo in args.algos:
        check_agent(algo)
    for env_id in args.env:
        check_env_id(env_id)
    for flag, names in (("--env", args.env), ("--algos", args.algos)):
        if len(set(names)) < len(names):
            raise UserError(f"{flag} names one of them twice")
    return StudySpec(
        name=file_name(f"{'-'.join(args.env).replace('/', '-')}_{'-'.join(args.algos)}"),
        title="",
        agents=tuple(AgentSpec(algo, algo) for algo in args.algos),
        environments=tuple(EnvironmentSpec(env_id, env_id) for env_id in args.env),
    )


def _conf_files(study: StudySpec, words: Sequence[str]) -> dict[str, Path]:
    """The files of ``--conf-file``, by the names of agents in the registry."""
    algos = list(dict.fromkeys(agent.algo for agent in study.agents))
    files: dict[str, Path] = {}
    for word in words:
        algo, colon, name = word.partition(":")
        if not (colon and algo in algos):
            if len(algos) > 1:
                raise UserError(
                    f"--conf-file {word}: whose hyperparameters? a file has those of one "
                    f"agent ({', '.join(algos)}): {algos[0]}:{word}"
                )
            algo, name = algos[0], word
        if algo in files:
            raise UserError(f"--conf-file names two files for {algo}")
        files[algo] = Path(name)
        if not files[algo].is_file():
            raise UserError(f"--conf-file: there is no file {files[algo]}")
    return files


def typed_settings(args: argparse.Namespace) -> dict[str, Any]:
    """The settings that the flags of a study or a search give to every agent."""
    from rl_yardstick.experiments.study import layered
    from rl_yardstick.pipeline.settings import parse_assignments

    settings: dict[str, Any] = parse_assignments(args.hyperparams, "--hyperparams")
    if args.env_kwargs:
        named = {"env_kwargs": parse_assignments(args.env_kwargs, "--env-kwargs")}
        settings = layered(settings, named)
    budgets = {"n_timesteps": args.n_timesteps, "n_episodes": args.n_episodes}
    return settings | {key: value for key, value in budgets.items() if value is not None}


def _with_settings(study: StudySpec, args: argparse.Namespace) -> StudySpec:
    """The study with the settings of the command line in every agent."""
    from rl_yardstick.experiments.study import AS_IT_COMES, layered
    from rl_yardstick.pipeline.components import arguments_of

    files = _conf_files(study, args.conf_file)
    changes = {**(AS_IT_COMES if args.as_it_comes else {}), **typed_settings(args)}
    is_free = args.is_quick and args.engine is None and "engine" not in changes

    def changed(agent: AgentSpec) -> AgentSpec:
        own = with_engine(agent.algo, changes, args.engine)
        has_auto = "=auto" in arguments_of(agent.algo).get("engine", ())
        if is_free and has_auto and "engine" not in agent.settings:
            own["engine"] = "auto"
        conf_file = files.get(agent.algo, agent.conf_file)
        return replace(agent, settings=layered(agent.settings, own), conf_file=conf_file)

    return replace(study, agents=tuple(map(changed, study.agents)))
