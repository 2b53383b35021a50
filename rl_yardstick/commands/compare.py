"""``compare.py``: its flags, the steps of a study, and its output."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rl_yardstick.commands import cli
from rl_yardstick.commands.cli import Flags, OneLineParser, flag, several, shared, switch
from rl_yardstick.commands.terminal import table_console
from rl_yardstick.pipeline.errors import UserError, unknown

if TYPE_CHECKING:
    from rich.console import Console

    from rl_yardstick.experiments.analysis import StudyAnalysis
    from rl_yardstick.experiments.plan import PlannedRun, StudyRecord
    from rl_yardstick.experiments.pool import Workers
    from rl_yardstick.experiments.results import StudyResults
    from rl_yardstick.experiments.study import AgentSpec, StudySpec
    from rl_yardstick.pipeline.run import Stop
    from rl_yardstick.verdicts import Study

# --- flags ----------------------------------------------------------------------------------------

EPILOG = """\
examples:
  python compare.py --env FrozenLake-v1 --algos qlearning sarsa dqn ppo --seeds 10
  python compare.py studies/warehouse-learning-rate.yml --until-decided
  python compare.py --resume logs/studies/warehouse-learning-rate
  python compare.py logs/ppo logs/dqn  # runs that were done elsewhere, by their logs
  python compare.py --logged log.csv --policy logs/linucb/ReplayBandit-v0_1

The same command again does the missing runs, and no others.
"""


def _margin(text: str) -> float:
    with suppress(ValueError):
        if 0 <= (number := float(text)) < float("inf"):
            return number
    raise argparse.ArgumentTypeError(f"must be a number of at least 0, not {text!r}")


SEEDS = cli.whole_number(1, 1_000_000)
FLAGS: Flags = {
    "": (
        flag("study", "a study (a file, or a shipped one), or logs of finished runs", nargs="*"),
        several("--env", "environments", "ID"),
        several("--algos", "agents (train --list has them)", "AGENT"),
        flag("--seeds", "how many seeds (default: the study's, or 10)", SEEDS, dest="n_seeds"),
        flag(
            "--first-seed", "the first of these seeds (default: the study's, or 0)", cli.FIRST_SEED
        ),
        switch(
            "--until-decided", "more seeds for agents in undecided pairs, at looks fixed before"
        ),
        flag("--max-seeds", "the most seeds for that (default: 80)", SEEDS),
        *shared("--n-timesteps", "--n-episodes"),
        *shared("--hyperparams", help="hyperparameters to change in every agent"),
        *shared("--engine"),
        several("-conf --conf-file", "hyperparameters from another file", "[AGENT:]YAML"),
        *shared("--env-kwargs"),
        switch("--as-it-comes", "without the settings' changes of environments in training"),
        *shared("--gym-packages"),
        switch("--quick", "few seeds and a small budget, for a first look", dest="is_quick"),
    ),
    "runs": (
        *shared("--jobs", "--cluster", "--run-timeout"),
        flag("--resume", "do what is left of the study in this folder", Path, metavar="STUDY"),
    ),
    "judgement and output": (
        flag("--metric", "the figure that verdicts compare: final, best, area, regret, ..."),
        flag("--margin", "difference of the means within which agents are tied", _margin),
        flag("--episodes-table", "average, min, max of every N episodes", cli.COUNT),
        flag("--render-every", "film an episode after every N episodes", cli.whole_number(0), 0),
        flag("--name", "name of the study's folder", cli.folder_name, metavar="NAME"),
        flag("-f --log-folder", "folder of all studies", default="logs/studies"),
        switch("-tb --tensorboard", "write a TensorBoard log of each run"),
        *shared("--model", default=None),
        *shared("--diagnose", default=None),
        switch("--watch-learning", "pages that play how agents learn", dest="learning_pages"),
        flag("--figures", "formats (default: png svg)", nargs="+", choices=("png", "svg", "pdf")),
        flag("--pattern", "labels in the paths of logs, e.g. '{agent}/{env}_{seed}'", default=""),
        switch("--no-report", "only tables: no figures and no page"),
    ),
    "off-policy evaluation, instead of a study": (
        flag("--logged", "judge trained agents on logged pulls", Path, metavar="LOG.csv"),
        several("--policy", "run folders or zips", "RUN", type=Path),
        several("--columns", "a log's own names, e.g. arm=item_id reward=click", "NAME=COLUMN"),
    ),
}


def build_parser() -> OneLineParser:
    """The flags; those of single runs have the same meaning as in train."""
    words = "Compare agents on environments over seeds: tables, figures, and a page."
    return OneLineParser(words, EPILOG, FLAGS)


# --- the steps of a study -------------------------------------------------------------------------


def main() -> int:
    """Do a study, or judge policies on a log; return the exit code."""
    args = build_parser().parse_args()
    from rl_yardstick.pipeline.components import check_code, check_typed
    from rl_yardstick.pipeline.run import Stop

    stop = Stop().listen()
    cli.import_typed(args)
    args.columns = dict(word.partition("=")[::2] for word in args.columns)
    if args.logged or args.policy:
        return compare_on_log(args)
    from rl_yardstick.experiments.study import METRICS

    if args.metric is not None and args.metric not in METRICS:
        raise unknown("--metric: unknown metric", args.metric, METRICS)
    if is_logs(args.study):
        cli.check_alone(build_parser(), BESIDE_LOGS, "logs: their runs are finished")
        judge_logs(args, cli.command_line(), table_console(), stop)
        return 0
    if args.pattern or args.columns:
        raise UserError("--pattern and --columns belong to logs: name their folders or files")
    from rl_yardstick.experiments.plan import StudyRecord, plan_of_looks, specs_of

    if args.resume is not None:
        cli.check_alone(build_parser(), _BESIDE_RESUME)
        root, record = args.resume, StudyRecord.read(args.resume)
        check_typed(record.study.gym_packages, args.gym_packages, str(root))
        for spec in record.specs.values():
            check_code(spec, str(root))
    else:
        study = study_spec(args)
        root, record = Path(args.log_folder) / study.name, StudyRecord(study, specs_of(study))
    workers = workers_of(args, root, record.study.run_timeout)
    job = Job(root, cli.command_line(), table_console(), stop, workers, not args.no_report)
    job.console.print(record.study.title, style="bold")
    with held(root), workers:
        if args.until_decided:
            record = replace(record, looks=plan_of_looks(record.study, root, args.max_seeds))
        return carry_out(job, record)


def is_logs(words: Sequence[str]) -> bool:
    """Whether folders or files with logs are typed, and not a study."""
    paths = [Path(word) for word in words]
    there = [path for path in paths if path.exists() and not (path / "study.json").exists()]
    others = [path for path in paths if path not in there or path.suffix in (".yml", ".yaml")]
    if others and len(words) > 1:
        raise UserError(f"{others[0]} is no folder or file with logs: give one study, or logs")
    return bool(words) and not others


def judge_logs(args: argparse.Namespace, command: str, console: Console, stop: Stop) -> Path:
    """Judge finished runs by their logs; return the folder with tables and page."""
    if len(args.env or ()) > 1:
        raise UserError("--env names the environment of logs that name none: give one")
    from rl_yardstick.experiments.logs import find_logs
    from rl_yardstick.experiments.others import UNNAMED, results_of
    from rl_yardstick.experiments.study import file_name
    from rl_yardstick.pipeline.settings import parse_assignments

    kwargs = parse_assignments(args.env_kwargs, "--env-kwargs")
    paths = [Path(word) for word in args.study]
    root = Path(args.log_folder) / (args.name or file_name(paths[0].absolute().stem))
    if (root / "study.json").exists():
        raise UserError(f"{root} is a study's folder: give another one by --name NAME")
    with console.status("reading the logs"):
        logs, notes = find_logs(paths, args.columns)
        (env,) = args.env or [UNNAMED]
        results = results_of(logs, notes, root, args.pattern, env, kwargs)
    given = cli.given(args, ("metric", "margin", "figures"))
    results = replace(results, study=replace(results.study, **given))
    for line in (results.study.title, *notes):
        console.print(line)
    workers = workers_of(args, root, None)
    with held(root), workers:
        _judge(Job(root, command, console, stop, workers, not args.no_report), results, ())
    return root


@dataclass(frozen=True)
class Job:
    """What the steps of a study share: its folder, the command, and who does the runs."""

    root: Path  #: the folder of the study
    command: str  #: recorded in run folders
    console: Console
    stop: Stop
    workers: Workers
    with_page: bool = True  #: draw the figures and write the page, beside the tables
    again: str = ""  #: what continues after a signal, if it is no command


@contextmanager
def held(root: Path) -> Iterator[None]:
    """Hold a study's folder; a new one is removed again if an error leaves nothing in it."""
    from rl_yardstick.pipeline.run import Run

    run = Run(root)  # with the lock of a run's folder
    run.is_new = not root.exists()
    root.mkdir(parents=True, exist_ok=True)
    with run:
        try:
            yield
        finally:
            run.has_begun = len([*root.iterdir()]) > 1  # more than the lock


def workers_of(args: argparse.Namespace, root: Path, timeout: float | None) -> Workers:
    """The workers that the flags ask for."""
    from rl_yardstick.experiments.pool import Workers

    if args.cluster is None:
        return Workers(args.jobs, timeout)
    try:
        from rl_yardstick.experiments.cluster import ClusterWorkers

        return ClusterWorkers(args.cluster, max(args.jobs, 0), root, timeout)
    except ImportError:
        raise UserError("--cluster needs Dask: pip install 'rl-yardstick[cluster]'") from None


def finished(
    job: Job, record: StudyRecord, is_enough: Callable[[Study], bool] = lambda said: False
) -> tuple[StudyResults, Study | None]:
    """Do the missing runs of a study; return the results of all, and the verdicts of the last look.

    A growing study does one planned look after another, until no agent needs seeds or
    ``is_enough``; it begins with the first look, because finished runs may already be enough.
    """
    from rl_yardstick.experiments.analysis import looked
    from rl_yardstick.experiments.plan import check_settings_kept, plan

    study, failures, n_said = record.study, dict[Path, str](), 0
    counts = dict.fromkeys(record.specs, study.n_seeds)
    planned = plan(study, job.root, counts, record.specs)
    check_settings_kept(job.root, planned)
    record.write(job.root)
    while True:
        results = do_study(job, study, planned, failures)
        if not record.looks:
            return results, None
        said = looked(results, record.looks)
        if said.n_looks != n_said:
            n_said = said.n_looks
            n = sum(pair.word == "undecided" for pair in said.pairs)
            told = f"{n} of {len(said.pairs)} pairs undecided" if n else "all pairs are decided"
            where = f"look {n_said} of {len(record.looks)}, at {record.looks[n_said - 1]:,} seeds"
            job.console.print(f"{where}: {told}")
        if said.is_done or is_enough(said):
            return results, said
        counts |= {(agent, e): n for e, by in said.seeds.items() for agent, n in by.items()}
        study = replace(study, n_seeds=max(counts.values()))
        planned = plan(study, job.root, counts, record.specs)


def carry_out(job: Job, record: StudyRecord) -> int:
    """Do a study, and judge it; return 0 if all runs are finished, else 1."""
    (results, said), looks = finished(job, record), record.looks
    code = conclude(job, results, looks)
    if said is None:
        return code
    n_undecided = sum(pair.word == "undecided" for pair in said.pairs)
    left = f"{n_undecided} pairs are undecided" if n_undecided else "all is decided"
    n_runs = sum(sum(by.values()) for by in said.seeds.values())
    design = f"{looks[-1]:,} seeds of each agent would be {looks[-1] * len(record.specs):,}"
    job.console.print(f"{n_runs:,} runs, where {design}; {left}")
    return code


def do_study(
    job: Job, study: StudySpec, planned: Sequence[PlannedRun], failures: dict[Path, str]
) -> StudyResults:
    """Do the missing runs of a study, and read all; adds to ``failures``, which are not tried."""
    from rl_yardstick.agents.registry import ALGORITHMS
    from rl_yardstick.experiments.pool import do_runs

    to_do = [run for run in planned if run.path not in failures and not run.is_finished]
    n_done = len(planned) - len(to_do)
    job.console.print(
        f"{len(planned)} runs, {n_done} of them there already; {job.workers.words}, in {job.root}"
    )
    if slow := {run.agent for run in to_do if ALGORITHMS[run.spec.algo].for_bandits} - {
        run.agent for run in to_do if run.is_batch
    }:
        ways = "-n up to the time limit, or --env-kwargs max_episode_steps:N"
        told = f"seeds of {', '.join(sorted(slow))} are done one by one, about 100 times as slowly"
        job.console.print(f"note: {told} as a batch, which needs runs of one episode: {ways}")
    try:
        failures |= do_runs(to_do, job.workers, job.command, job.console, job.stop)
    finally:
        if job.stop.number:
            typed = study.gym_packages
            again = job.again or cli.to_copy("compare", "--resume", job.root, typed=typed)
            job.console.print(f"stopped; continue with: {again}")
    from rl_yardstick.experiments.results import read_results

    with job.console.status("reading the results"):
        return replace(read_results(study, planned, job.root), failures=failures)


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
            for note in record.get("notes", ()):
                tell(f"{environment}: {note}")
        if note := mixed_versions(run.recorded() for run in results.finished):
            tell(note)
    for run in results.planned:
        if reason := results.left_out.get(run.path):
            again = f"remove {run.path} to do it again"
            tell(f"left out: {run.title}: {reason}; {again}")
    return int(len(results.finished) < len(results.planned))


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
        typed = results.study.gym_packages
        console.print(f"why the worst run failed: {cli.to_copy('explain', failed, typed=typed)}")
    with console.status("writing the tables"):
        files = [*write_tables(results), *write_verdicts(analysis, job.command)]
    if width:
        from rl_yardstick.report.series import episodes_table

        print_episodes_table(console, episodes_table(results, width), width)
    if results.study.render_every:
        from rl_yardstick.report.films import write_films

        with console.status("filming"):
            films, refused = write_films(results)
        files += films
        for reason in refused:
            console.print(f"no film: {reason}")
    if job.with_page:
        files += _draw(job, analysis)
    console.print(f"\nfiles: {results.root}")
    for path in files:
        console.print(f"  {path.relative_to(results.root)}")


def _draw(job: Job, analysis: StudyAnalysis) -> list[Path]:
    """Draw the figures and write the page, unless nothing is new; return the files."""
    from rl_yardstick.report.page import current_files, write_report

    if analysis.results.finished and (files := current_files(analysis.results, job.command)):
        return files
    from rl_yardstick.report.figures import write_figures
    from rl_yardstick.report.page.frame import Report
    from rl_yardstick.report.series import study_series

    with job.console.status("drawing the figures"):
        series = study_series(analysis)
        files = write_figures(series)
    job.stop.check()
    learning = []
    if analysis.study.learning_pages:
        from rl_yardstick.report.page.learning import write_first_pages

        with job.console.status("watching"):
            learning = write_first_pages(analysis, job.workers.n_at_once, job.stop)
    root, pages = analysis.results.root, [one.place for one in learning if one.place]
    with job.console.status("writing the page"):
        write_report(Report(series, job.command, learning=learning), root / "report.html")
    return [*files, *(root / place for place in (*pages, "report.html"))]


# --- from flags to a study ------------------------------------------------------------------------

BESIDE_LOGS = {
    *("study", "pattern", "columns", "env", "env_kwargs", "gym_packages", "metric", "margin"),
    *("name", "log_folder", "figures", "no_report", "jobs"),
}
_BESIDE_RESUME = {"resume", "gym_packages", "jobs", "cluster", "no_report", "log_folder"}


def study_spec(args: argparse.Namespace) -> StudySpec:
    """The study that the arguments select, with their changes."""
    from rl_yardstick.experiments.study import StudySpec, find_study, read_study, with_maps_named

    if args.max_seeds is not None and not args.until_decided:
        raise UserError("--max-seeds belongs to --until-decided: give both, or --seeds")
    if args.until_decided and args.is_quick:
        raise UserError("--until-decided and --quick do not go together: give one of them")
    if args.learning_pages and args.no_report:
        raise UserError("--watch-learning is a section of the page: leave out --no-report")
    cli.check_installed(args.tensorboard, "-tb", "tensorboard", "tensorboard")
    if args.study and (args.env or args.algos):
        raise UserError("give a study file, or --env and --algos, not both")
    if not args.study and not (args.env and args.algos):
        raise UserError("what to compare? give --env and --algos, or a study file")
    is_file = bool(args.study)
    study = read_study(find_study(args.study[0])) if is_file else study_of(args.algos, args.env)
    # A flag with the name of a field sets that field, if it is given.
    changes = cli.given(args, (key.name for key in fields(StudySpec)))
    study = with_maps_named(replace(_with_settings(study, args), **changes))
    if not is_file:
        environments = ", ".join(each.label for each in study.environments)
        study = replace(study, title=f"{', '.join(args.algos)} on {environments}")
    return study.quickened() if args.is_quick else study


def study_of(algos: Sequence[str], env_ids: Sequence[str]) -> StudySpec:
    """A study without a title of agents and environments, whose names are checked."""
    from rl_yardstick.experiments.study import AgentSpec, EnvironmentSpec, StudySpec, file_name
    from rl_yardstick.pipeline.environments import check_env_id
    from rl_yardstick.pipeline.settings import check_agent

    for check, names in ((check_agent, algos), (check_env_id, env_ids)):
        for name in names:
            check(name)
        if len(set(names)) < len(names):
            raise UserError(f"--env or --algos names {max(names, key=[*names].count)} twice")
    return StudySpec(
        name=file_name(f"{'-'.join(env_ids).replace('/', '-')}_{'-'.join(algos)}"),
        title="",
        agents=tuple(AgentSpec(algo, algo) for algo in algos),
        environments=tuple(EnvironmentSpec(env_id, env_id) for env_id in env_ids),
    )


def _conf_files(study: StudySpec, words: Sequence[str]) -> dict[str, Path]:
    """The files of ``--conf-file``, by the names of agents in the registry."""
    algos = list(dict.fromkeys(agent.algo for agent in study.agents))
    files: dict[str, Path] = {}
    for word in words:
        algo, _, name = word.partition(":")
        if algo not in algos:
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
            raise UserError(f"--conf-file: there is no file {name}")
    return files


def _with_settings(study: StudySpec, args: argparse.Namespace) -> StudySpec:
    """The study with the settings of the command line in every agent."""
    from rl_yardstick.experiments.study import AS_IT_COMES
    from rl_yardstick.pipeline.components import arguments_of
    from rl_yardstick.pipeline.settings import layered

    files, typed = _conf_files(study, args.conf_file), cli.typed_settings(args, "--hyperparams")
    changes = {**(AS_IT_COMES if args.as_it_comes else {}), **typed}
    is_free = args.is_quick and args.engine is None and "engine" not in changes

    def changed(agent: AgentSpec) -> AgentSpec:
        own = cli.with_engine(agent.algo, changes, args.engine)
        has_auto = "=auto" in arguments_of(agent.algo).get("engine", ())
        if is_free and has_auto and "engine" not in agent.settings:
            own["engine"] = "auto"
        conf_file = files.get(agent.algo, agent.conf_file)
        return replace(agent, settings=layered(agent.settings, own), conf_file=conf_file)

    return replace(study, agents=tuple(map(changed, study.agents)))


# --- off-policy evaluation ------------------------------------------------------------------------


def compare_on_log(args: argparse.Namespace) -> int:
    """Judge the policies of ``--policy`` on the log of ``--logged``; return the exit code."""
    if not (args.logged and args.policy):
        raise UserError("--logged LOG.csv and --policy RUN go together: one of them is missing")
    if args.study or args.env or args.algos:
        raise UserError("give a study, --env and --algos, or --logged and --policy, not both")
    if wrong := args.columns.keys() - {"arm", "reward", "propensity"}:
        raise UserError(f"--columns {wrong.pop()}: name arm, reward or propensity, as arm=item_id")
    console = table_console()
    from rl_yardstick.experiments.off_policy import compare_policies, load_policy, read_logged
    from rl_yardstick.report.terminal import print_comparison

    with console.status("judging the policies"):
        data = read_logged(args.logged, args.columns)
        policies = [load_policy(path, args.gym_packages) for path in dict.fromkeys(args.policy)]
        compared = compare_policies(data, policies)
    print_comparison(console, compared)
    return 0
