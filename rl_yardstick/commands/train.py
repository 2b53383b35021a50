"""``train.py``: its flags, the training that they ask for, and its output."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from secrets import randbelow
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from rl_yardstick.commands import cli, terminal
from rl_yardstick.commands.cli import Flags, OneLineParser, flag, several, shared, switch
from rl_yardstick.commands.terminal import APART, percent, say
from rl_yardstick.pipeline.errors import Stopped, UserError
from rl_yardstick.pipeline.files import read_text

if TYPE_CHECKING:
    from rich.console import Console

    from rl_yardstick.pipeline.callbacks import PullSummary
    from rl_yardstick.pipeline.run import Run
    from rl_yardstick.pipeline.spec import TrainSpec
    from rl_yardstick.pipeline.training import Training

RESUMED = "this run, or the newest unfinished one of --algo and --env"
PAGE = "learning.html"
TRACKED = "runs"  # where TensorBoard's files of --track go, as in rl_zoo3
STORAGE = "hyperparameters of an Optuna trial in sqlite:///FILE or a journal FILE.log"
WATCH = f"write a page that plays the training ({PAGE} in the run folder)"
WATCHED = cli.whole_number(1, besides={0: "the steps in which its policy improves"})
# Flags that may stand beside --resume: none of the training itself.
_BESIDE_RESUME = {"resume", "log_folder", "gym_packages", "verbose", "progress", "track"}
_BESIDE_RESUME |= {"wandb_project_name", "wandb_entity", "wandb_group", "wandb_tags"}
_OF_RIVAL = ("env_kwargs", "n_timesteps", "n_episodes", "conf_file")  # flags of `next_commands`

EPILOG = """\
examples:
  python train.py --env Warehouse-v0 --algo ppo --engine auto
  python train.py --env FrozenLake-v1 --algo qlearning --n-episodes 5000 --seed 0
  python train.py --resume logs/ppo/Warehouse-v0_3
  python train.py --list
"""

FLAGS: Flags = {
    "": (
        flag("--algo", "agent (default: ppo; see --list)", default="ppo"),
        flag("--env", "environment id (default: CartPole-v1; see --list)", default="CartPole-v1"),
        switch("--list", "list agents and environments that fit each other; --env: for this one"),
    ),
    "budget and settings": (
        flag("-n --n-timesteps", "environment steps", cli.BUDGET, -1),
        flag("--n-episodes", "episodes instead of steps", cli.BUDGET, -1),
        flag("--seed", "seed of everything (default: a random one)", cli.SEED, -1),
        *shared("--hyperparams", "--engine", "--conf-file", "--env-kwargs"),
        flag("--storage", STORAGE, metavar="WHERE"),
        flag("--study-name", "name of that study", metavar="NAME"),
        flag("--trial-id", "number of that trial (default: the best)", cli.whole_number(0)),
        several("--eval-env-kwargs", "environment arguments for evaluation only"),
        *shared("--gym-packages"),
        flag("-i --trained-agent", "zip or run folder to train further", default="", metavar="ZIP"),
        *shared("--vec-normalize"),
        flag("--vec-env", "kind of VecEnv", default="dummy", choices=["dummy", "subproc"]),
        *shared("--device", "--num-threads"),
    ),
    "evaluation and output": (
        flag("--eval-freq", "steps between evaluations; -1 for none", cli.INTERVAL),
        flag("--eval-episodes", "episodes of each (at most 20, or 100 at the end)", cli.COUNT),
        flag("--n-eval-envs", "environments to evaluate on (10)", cli.COUNT, 10),
        flag("--save-freq", "steps between checkpoints", cli.INTERVAL, -1),
        switch("--save-replay-buffer", "save the replay buffer too"),
        flag("-f --log-folder", "folder of all runs (logs)", default="logs"),
        switch("-uuid --uuid", "add a unique id to the run folder's name"),
        flag("-tb --tensorboard-log", "write TensorBoard logs there", default="", metavar="DIR"),
        switch("--track", "track the run in Weights & Biases"),
        flag("--wandb-project-name", "its project", default="sb3", metavar="NAME"),
        flag("--wandb-entity", "its user or team", metavar="NAME"),
        flag("--wandb-group", "its group of runs", metavar="NAME"),
        several("-tags --wandb-tags", "its tags", metavar="TAG"),
        flag("--log-interval", "episodes or rollouts between log records", cli.LOG_INTERVAL, -1),
        flag("--verbose", "0 silent, 1 (default), 2 the library's tables", cli.VERBOSITY, 1),
        switch("-P --progress", "a progress bar even without a terminal"),
        *shared("--model", "--diagnose"),
        flag("--watch-learning", WATCH, nargs="?", const="", metavar="FILE"),
        flag("--watch-episodes", "first episodes of a table to play on it", WATCHED, 0),
    ),
    "resuming": (
        flag("--resume", RESUMED, nargs="?", const="", metavar="RUN"),
        switch("--resume-or-start", "resume the newest run with these settings, or start one"),
    ),
}


def build_parser() -> OneLineParser:
    """The flags, with the names and meanings that rl_zoo3 gives them."""
    words = "Train an agent and leave a run folder with its models, curves and settings."
    return OneLineParser(words, EPILOG, FLAGS)


def main() -> int:
    """Train, resume or list."""
    parser = build_parser()
    args = parser.parse_args()
    cli.import_typed(args)
    if args.list:
        from rl_yardstick.report.catalogue import print_lists

        is_for_one = any(word.partition("=")[0] == "--env" for word in parser.typed)
        print_lists(terminal.table_console(), args.env if is_for_one else "")
        return 0
    from rl_yardstick.pipeline.run import Run, Stop

    stop = Stop().listen()
    console = terminal.TextConsole(quiet=args.verbose < 1, force_terminal=args.progress or None)
    if args.resume is not None:
        return resume(Run(unfinished_run(args), console, stop), args)
    spec = spec_from_flags(args)
    if args.resume_or_start and (found := newest_run(args, partial(has_spec, spec, args.seed < 0))):
        return resume(Run(found, console, stop), args)
    suffix = f"_{uuid4()}" if args.uuid else ""
    run = Run.claim(Path(args.log_folder), spec, suffix, console=console, stop=stop)
    return carry_out(spec, run, args, resumes=False)


def carry_out(spec: TrainSpec, run: Run, args: argparse.Namespace, resumes: bool) -> int:
    """Hold the folder, train, and print the result."""
    from rl_yardstick.pipeline.run import tracked

    with run:
        print_header(run.console, spec)
        if args.storage and not resumes:
            trial = f"trial {args.trial_id} of {args.study_name} in {args.storage}"
            say(run.console, trial, "dim")
        if not resumes:
            run.begin(spec, {**vars(args), "seed": spec.seed}, cli.command_line())
        try:
            with run.console.status("loading the libraries"):
                from rl_yardstick.pipeline.training import train
            where = {"project": args.wandb_project_name, "entity": args.wandb_entity}
            where |= {"group": args.wandb_group, "tags": args.wandb_tags}
            with tracked(run, spec, where) if args.track else nullcontext():
                outcome = train(spec, run, resumes, print_engine)
        except Stopped:
            if run.has_begun:
                again = cli.to_copy("train", "--resume", run.path, typed=args.gym_packages)
                run.console.print(f"stopped; resume with: {again}")
            raise
        if not run.console.quiet:
            print_outcome(run, spec, outcome, args)
    return 0


# --- from flags to a spec -------------------------------------------------------------------------


def spec_from_flags(args: argparse.Namespace) -> TrainSpec:
    """The spec that the flags and the hyperparameters ask for; torch is not imported."""
    from rl_yardstick.pipeline import environments, settings

    settings.check_agent(args.algo)
    environments.check_env_id(args.env)
    cli.check_installed(args.tensorboard_log, "-tb", "tensorboard", "tensorboard")
    cli.check_installed(args.track, "--track", "wandb", "wandb", "tensorboard")
    cli.check_device(args.device)
    typed = cli.with_engine(args.algo, cli.typed_settings(args, "-params"), args.engine)
    changes = trial_from_flags(args), typed
    entry, origins = settings.changed_entry(args.algo, args.env, args.conf_file, *changes)
    names = (
        *("eval_freq", "eval_episodes", "n_eval_envs", "save_freq", "save_replay_buffer"),
        *("exact_model", "log_interval", "vec_env", "device", "diagnose", "watch_episodes"),
        "gym_packages",
    )
    spec = settings.read_spec(
        args.algo,
        args.env,
        entry,
        seed=args.seed if args.seed >= 0 else randbelow(2**31),
        final_episodes=args.eval_episodes,
        n_threads=args.num_threads,
        trained_agent=whole_zip(Path(args.trained_agent)) if args.trained_agent else None,
        vec_normalize=_statistics(args),
        tensorboard_log=args.tensorboard_log or (TRACKED if args.track else None),
        library_log=args.verbose > 1,
        watch_learning=_page(args),
        origins=origins,
        **{name: getattr(args, name) for name in names},
    )
    environments.check_fit(spec)
    return spec


def trial_from_flags(args: argparse.Namespace) -> dict[str, Any]:
    """The settings of the trial that is asked for, if any; its number and study become typed."""
    if args.storage is None:
        if args.study_name is not None or args.trial_id is not None:
            raise UserError("--study-name and --trial-id need --storage")
        return {}
    from rl_yardstick.tuning.reading import settings_of_trial

    found = settings_of_trial(args.algo, args.storage, args.study_name, args.trial_id)
    settings, args.study_name, args.trial_id = found
    return settings


def whole_zip(path: Path) -> str:
    """The absolute path of the zip of ``--trained-agent``, which is whole."""
    from rl_yardstick.pipeline.models import model_in, zip_data

    path = model_in(path) if path.is_dir() else path
    zip_data(path)
    return str(path.absolute())


def _statistics(args: argparse.Namespace) -> str | None:
    path = args.vec_normalize
    if path is not None and not args.trained_agent:
        raise UserError("--vec-normalize needs --trained-agent")
    return None if path is None else str(path if str(path) == "none" else path.absolute())


def _page(args: argparse.Namespace) -> str | None:
    """The path of the page of ``--watch-learning``: a name in the run folder, or absolute."""
    if args.watch_learning is None and args.watch_episodes:
        raise UserError("--watch-episodes needs --watch-learning")
    if not args.watch_learning:
        return None if args.watch_learning is None else PAGE
    path = Path(args.watch_learning)
    if path.suffix != ".html" or path.is_dir():
        raise UserError(f"--watch-learning writes a .html file, not {path.name!r}")
    if not path.absolute().parent.is_dir():
        raise UserError(f"--watch-learning: there is no folder {path.parent}")
    return str(path.absolute())


# --- resuming -------------------------------------------------------------------------------------


def resume(run: Run, args: argparse.Namespace) -> int:
    """Resume a run whose modules were typed."""
    from rl_yardstick.pipeline.components import check_code, check_typed
    from rl_yardstick.pipeline.run import FINISHED, resumable

    if args.resume_or_start and run.recorded().get("state") == FINISHED:
        run.console.print(f"{run.path} is finished already")
        return 0
    spec = resumable(run.path)
    check_typed(spec.gym_packages, args.gym_packages, str(run.path))
    check_code(spec, str(run.path))
    cli.check_installed(args.track, "--track", "wandb", "wandb", "tensorboard")
    with suppress(UserError, ValueError):  # a run of a study has another command
        words = shlex.split(read_text(run.path / spec.env_name / "command.txt"))
        first = build_parser().parse_args(words[2:])
        vars(args).update(cli.given(first, _OF_RIVAL))
    log = spec.tensorboard_log or (TRACKED if args.track else None)
    spec = spec.changed(gym_packages=args.gym_packages, tensorboard_log=log)
    return carry_out(spec, run, args, resumes=True)


def unfinished_run(args: argparse.Namespace) -> Path:
    """The run of ``--resume``, or the newest unfinished one of ``--algo`` and ``--env``."""
    beside = _BESIDE_RESUME if args.resume else _BESIDE_RESUME | {"algo", "env"}
    cli.check_alone(build_parser(), beside)
    if not args.resume:
        over = (None, "finished")
        found = newest_run(args, lambda run: run.recorded().get("state") not in over)
        if found is not None:
            return found
        raise UserError(f"{args.log_folder} has no unfinished run of {args.algo} on {args.env}")
    if not Path(args.resume).is_dir():
        raise UserError(f"{args.resume}: there is no such run folder")
    return Path(args.resume)


def newest_run(args: argparse.Namespace, fits: Callable[[Run], bool]) -> Path | None:
    """The newest run of ``--algo`` and ``--env`` that fits."""
    from rl_yardstick.pipeline.run import Run, numbered_runs

    runs = numbered_runs(Path(args.log_folder) / args.algo, args.env.replace("/", "-"))
    return next((path for _, path in reversed(runs) if fits(Run(path))), None)


def has_spec(spec: TrainSpec, any_seed: bool, run: Run) -> bool:
    """Whether a run has exactly these settings."""
    with suppress(UserError):
        found = run.spec()
        return found == (spec.changed(seed=found.seed) if any_seed else spec)
    return False


# --- output ---------------------------------------------------------------------------------------


def print_header(console: Console, spec: TrainSpec) -> None:
    """Print the agent, the environment, the budget and the hyperparameters."""
    unit = "steps" if spec.n_timesteps else "episodes"
    budget = spec.n_timesteps or spec.n_episodes or 0
    say(console, f"{spec.algo} on {spec.place}, seed {spec.seed}, {budget:,} {unit}", "bold")
    plain, explained = list[str](), list[str]()
    for key, value in spec.hyperparams.items():
        if key == "policy" and not str(value).startswith(("Mlp", "Cnn", "MultiInput")):
            continue  # our tables and bandits have one each
        note = spec.origins.get(key)
        text = f"{key}={str(value)[:200]}"  # a whole map would fill the screen
        (explained if note else plain).append(f"{text} ({note})" if note else text)
    for line in ["  ".join(plain), *explained] if plain else explained:
        console.print(line, style="dim")


def print_engine(parts: Training) -> None:
    """Print on which engine networks will train, and whether compiled code could do it."""
    agent, steps, callback = parts.agent, parts.spec.total_timesteps, [parts.callback]
    if hasattr(agent, "engine_plan"):
        plan, auto = (agent.engine_plan(steps, callback, engine) for engine in (None, "auto"))
        other = f"; --engine auto: {auto}" if auto.is_compiled and not plan.is_compiled else ""
        parts.run.console.print(f"engine   {plan}{other}", style="dim", soft_wrap=True)


def print_outcome(run: Run, spec: TrainSpec, outcome: Training, args: argparse.Namespace) -> None:
    """Print what was done, below it the result, and the commands to type next."""
    console = run.console
    for label, text in rows_of(run, outcome):
        say(console, f"{label:<9}{text}")
    results = [] if outcome.pulled is None else [describe_pulls(outcome.pulled)]
    if (final := outcome.final) is not None:
        others = terminal.describe_others(final.others) if final.others else []
        results += [*terminal.result_lines(final), *(f"also     {line}" for line in others)]
    say(console, "\n".join(["", *results]) if results else "")
    exact = outcome.judge.exact
    if final and exact is None and hasattr(outcome.agent.observation_space, "n"):
        from rl_yardstick.pipeline.evaluation.exact import told_of_bins

        with console.status("computing the model of the bins"):
            line = told_of_bins(spec, outcome.agent)
        say(console, f"bins     {line}") if line else None
    if exact and final and (told := exact.instead(outcome.agent, final)):
        say(console, f"instead  {told}\nmore     docs/explain.md")
    say(console, "\n".join(["", *next_commands(run, spec, outcome.can_be_explained, args)]))
    if outcome.watch is not None and spec.watch_learning is not None:
        from rl_yardstick.report.page.learning import write_learning_page

        page = run.path.absolute() / spec.watch_learning  # or where FILE is
        with console.status("writing the page that plays the training"):
            words = write_learning_page(spec, outcome.watch, page)
        say(console, f"learning {words}: {page.as_uri()}")


def rows_of(run: Run, outcome: Training) -> list[tuple[str, str]]:
    """What was done: labels and figures."""
    taken, final = outcome.progress.taken.cpu_seconds, outcome.final
    n_steps, evaluation = outcome.agent.num_timesteps, outcome.evaluation
    speed = f"{n_steps / max(taken, 1e-9):,.0f} steps/s"
    text = f"{n_steps:,} steps in {taken:.1f} s of processor time ({speed})"
    rows = [("trained", text)]
    if outcome.engine and not hasattr(outcome.agent, "engine_plan"):  # told before the training
        rows.append(("engine", outcome.engine))
    if evaluation.best is not None:
        yardstick = None if final is None else final.yardstick
        best = terminal.judged(evaluation.best, yardstick, evaluation.best_episodes)
        rows.append(("best", APART.join([*best, f"at step {evaluation.best_timesteps:,}"])))
    if final is not None:
        share = outcome.evaluation_steps / max(n_steps, 1)
        played = f"on {outcome.evaluation_steps:,} steps beside training ({share:.0%} of it)"
        how = played if outcome.evaluation_steps else "exactly, no episodes sampled"
        rows.append(("tested", f"{how}; {evaluation.taken.cpu_seconds:.1f} s of processor time"))
    return [*rows, ("files", str(run.path))]


def describe_pulls(pulls: PullSummary) -> str:
    """The regret of a training in a few words."""
    from rl_yardstick.pipeline.run import LAST_PULLS

    if pulls.regret is not None and pulls.optimal is not None:
        best = f"best arm in {percent(pulls.optimal)} of the last {min(LAST_PULLS, pulls.n_pulls)}"
        return f"regret {pulls.regret:,.2f} over {pulls.n_pulls:,} pulls{APART}{best}"
    if pulls.reward is None:
        return f"regret not known: none of {pulls.n_pulls:,} pulls is in the log"
    known = f"{pulls.n_matched:,} of {pulls.n_pulls:,} that are in the log"
    return f"regret not known{APART}reward {pulls.reward:.4f} a pull over the {known}"


def next_commands(run: Run, spec: TrainSpec, explained: bool, args: Any) -> list[str]:
    """Commands to type next, in the working directory of the training."""
    from rl_yardstick.report.catalogue import rival

    labels, typed = (("watch    ", "enjoy"), ("explain  ", "explain")), args.gym_packages
    told = [f"{label}{cli.to_copy(name, run.path, typed=typed)}" for label, name in labels]
    told = told[: 1 + explained]
    if spec.env_kwargs and not args.env_kwargs:  # of a file, or of a study
        return told
    more = ["--env-kwargs", *args.env_kwargs] if args.env_kwargs else []
    more += ["--n-timesteps", args.n_timesteps] if args.n_timesteps > 0 else []
    more += ["--n-episodes", args.n_episodes] if args.n_episodes > 0 else []
    more += ["--conf-file", f"{spec.algo}:{args.conf_file}"] if args.conf_file else []
    words = ["--env", spec.env_id, "--algos", spec.algo, rival(spec), *more]
    return [*told, f"compare  {cli.to_copy('compare', *words, typed=typed)}"]
