"""The commands as functions, for scripts and notebooks: ``import rl_yardstick as ys``.

- **Environments** are ids, objects, or a class or function that makes one. An object with a
  registered id stands for that id and its arguments; any other is copied.
- **Agents** are names or classes. Either class may stand in a cell of a notebook.
- **Settings** are flags of the command, with ``_`` in place of ``-``, and hyperparameters:
  ``n_timesteps=20_000`` is ``--n-timesteps 20000``, ``gamma=0.9`` is ``-params gamma:0.9``.
  ``folder`` is that of all runs; None makes a temporary one.

Each function raises `UserError`, with one line, for what does not exist or does not fit. An
interrupt ends the work at the next safe moment with `KeyboardInterrupt`.
"""

from __future__ import annotations

import base64
import html
import json
import shlex
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from copy import deepcopy
from dataclasses import replace
from functools import cached_property, partial
from importlib.util import find_spec
from io import StringIO
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd

from rl_yardstick import agents
from rl_yardstick.commands import audit as audit_command
from rl_yardstick.commands import compare as compare_command
from rl_yardstick.commands import explain as explain_command
from rl_yardstick.commands import optimum as optimum_command
from rl_yardstick.commands import train as train_command
from rl_yardstick.commands import tune as tune_command
from rl_yardstick.commands.cli import import_typed
from rl_yardstick.commands.terminal import TextConsole
from rl_yardstick.diagnosis import audit as audits
from rl_yardstick.diagnosis.environment_checks import examine
from rl_yardstick.diagnosis.explanation import explanation
from rl_yardstick.envs import found_models
from rl_yardstick.experiments.plan import StudyRecord, specs_of
from rl_yardstick.experiments.pool import REGISTRATIONS
from rl_yardstick.experiments.results import read_evaluations
from rl_yardstick.mdp.transition_model import TransitionModel
from rl_yardstick.pipeline import training
from rl_yardstick.pipeline.environments import check_env_id, make_env
from rl_yardstick.pipeline.errors import Stopped, UserError, one_line, shown, unknown
from rl_yardstick.pipeline.evaluation.exact import known_model
from rl_yardstick.pipeline.files import read_json, read_text
from rl_yardstick.pipeline.models import Wanted, load_agent, model_of_run
from rl_yardstick.pipeline.playing import playing_env
from rl_yardstick.pipeline.run import Run as RunFolder
from rl_yardstick.pipeline.run import Stop
from rl_yardstick.report.words import why_lines


class Shown:
    """A result that a notebook shows."""

    lines: Sequence[str]  #: its text
    png: bytes | None = None  #: its picture

    def __repr__(self) -> str:
        return "\n".join(self.lines)

    def _repr_html_(self) -> str:
        data = base64.b64encode(self.png or b"").decode("ascii")
        picture = f'<img src="data:image/png;base64,{data}" style="max-width: 100%">'
        return f"<pre>{html.escape(repr(self))}</pre>{picture if data else ''}"

    def _repr_png_(self) -> bytes | None:
        return self.png


class Told(Shown, dict[str, Any]):
    """Figures by name."""

    def __init__(self, data: Mapping[str, Any], lines: Sequence[str]) -> None:
        super().__init__(data)
        self.lines = lines


class Run(Shown):
    """A run folder: the result of `train`, or ``Run(path)``.

    Attributes:
        result: figures of the final policy (``mean_return``, ``score``, ``optimum``, ...), and
            ``run.json``.
        curve: mean returns of the evaluations in training: columns ``step`` and ``value``.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder, self._run = Path(folder), RunFolder(Path(folder))
        self.spec, found = self._run.spec(), self._run.recorded()
        self.result: dict[str, Any] = {**(found.get("final") or {}), **found}
        steps, values = read_evaluations(self.folder / "evaluations.npz")
        self.curve = pd.DataFrame({"step": steps, "value": values})
        names = ("score", "mean_return", "optimum", "success_rate", "regret", "n_timesteps")
        told = [
            f"{key:<14}{self.result[key]:,.6g}" for key in names if self.result.get(key) is not None
        ]
        self.lines = [self.spec.title, *told, f"{'folder':<14}{folder}"]
        pictures = (self.folder / name for name in ("value_map.png", "learning_curve.png"))
        self.png = next((path.read_bytes() for path in pictures if path.is_file()), None)

    @cached_property
    def model(self) -> Any:
        """The agent at the end of training, an algorithm of Stable-Baselines3."""
        found = model_of_run(self._run)
        return load_agent(found, playing_env(found, None))


class Study(Shown):
    """A folder of a study: the result of `compare`, or ``Study(path)``.

    Attributes:
        page: the path of its page; None with ``no_report=True``.
        table: a row for each environment and agent: ``mean``, ``mean_interval`` (95 %), ... of
            scores where they are known, else of the metric.
        verdicts, runs: a row for each pair of agents, and for each run, as in the CSV files.
    """

    def __init__(self, folder: str | Path, text: str = "") -> None:
        self.folder = Path(folder)
        self.table = pd.DataFrame(read_json(self.folder / "verdicts.json")["agents"])
        self.verdicts = pd.read_csv(self.folder / "verdicts.csv")
        self.runs = pd.read_csv(self.folder / "summary.csv")
        self.page = page if (page := self.folder / "report.html").is_file() else None
        self.lines = (text or read_text(self.folder / "verdicts.md")).strip().splitlines()


def train(env: Any, algo: str | type = "ppo", **settings: Any) -> Run:
    """Train an agent, as ``train.py``; after an interrupt, ``train.py --resume`` continues."""
    args = _flags(train_command, env, algo, settings)
    spec = train_command.spec_from_flags(args)
    with _at_work(args.verbose) as work, RunFolder.claim(Path(args.log_folder), spec) as run:
        run.console, run.stop = work
        run.begin(spec, {**vars(args), "seed": spec.seed}, args.command)
        outcome = training.train(spec, run)
        run.console = TextConsole(quiet=True)  # the result shows itself
        train_command.print_outcome(run, spec, outcome, args)
    found = Run(run.path)
    found.model = outcome.agent
    return found


def compare(envs: Any, algos: Any, seeds: int = 10, **settings: Any) -> Study:
    """Compare agents over seeds, as ``compare.py``; ``envs`` and ``algos`` are one or a list.

    The same call again does the missing runs alone; with other settings, or other code of your
    classes, it needs another ``name``.
    """
    args = _flags(compare_command, envs, algos, {"seeds": seeds, **settings})
    study, text, again = compare_command.study_spec(args), StringIO(), "the same call"
    record, root = StudyRecord(study, specs_of(study)), Path(args.log_folder) / study.name
    workers = compare_command.workers_of(args, root, study.run_timeout)
    with _at_work() as work, compare_command.held(root), workers:
        job = compare_command.Job(root, args.command, *work, workers, not args.no_report, again)
        results, _ = compare_command.finished(job, record)
        if results.summary.empty:
            raise UserError(f"no run has finished: {next(iter(results.failures.values()), '')}")
        printed = TextConsole(file=text, width=100, **_PLAIN)
        compare_command.conclude(replace(job, console=printed), results, ())
    return Study(root, text.getvalue())


def judge(
    what: Any, env: Any = (), columns: Mapping[str, str] | None = None, **settings: Any
) -> Study:
    """Judge runs that other programs have done by their logs, as ``compare.py LOGS``.

    ``what`` are files and folders, or a table with a row for each score or step, ``env`` the
    environment of logs that name none, and ``columns`` a table's own names by the usual ones.
    """
    known, text = compare_command.BESIDE_LOGS | {"folder"}, StringIO()
    if wrong := [name for name in settings if name not in known]:
        raise unknown("judge has no setting", wrong[0], known)
    with tempfile.TemporaryDirectory() as folder, _at_work() as (_, stop):
        paths = what if isinstance(what, list | tuple) else [what]
        if isinstance(what, pd.DataFrame):
            paths = [Path(folder) / "table.csv"]
            what.to_csv(paths[0], index=any(what.index.names))
        args = _flags(compare_command, env, [], settings, [*map(str, paths)])
        args.columns = dict(columns or {})
        console = TextConsole(file=text, width=100, **_PLAIN)
        root = compare_command.judge_logs(args, args.command, console, stop)
    return Study(root, text.getvalue())


def explain(model: Any, env: Any = None, **env_kwargs: Any) -> Told:
    """Show where an agent loses return against the optimum, as ``explain``.

    ``model`` is a `Run`, a path, or an algorithm of Stable-Baselines3, which needs its ``env``.
    Returns ``return``, ``optimum``, ``gap``, ``parts``, ``states``, ``proposals``, ... by name.
    """
    env_id, kwargs = (None, {}) if env is None else _environment(env)
    algo, typed = None, list[str]()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.zip"
        if isinstance(model, str | Path):
            path = Path(model)
        elif isinstance(model, Run):
            path, typed = model.folder, model.spec.gym_packages
        elif env_id is None:
            raise UserError("explain(model, env): a model that is in no folder needs its env")
        else:
            algo = _agent(type(model))
            model.save(path)
        wanted = Wanted(path, algo, env_id, env_kwargs=kwargs | env_kwargs, typed=typed)
        found, agent, evaluator = explain_command.asked(TextConsole(quiet=True), wanted)
    explained = explanation(found.spec, agent, evaluator)
    return Told(explained.as_data(), why_lines(explained))


def audit(algo: str | type, **settings: Any) -> Told:
    """Test an implementation for known bugs, as ``audit``.

    Returns by name: ``verdict``, ``fault``, ``target`` (the measured backup in words), ``measured``
    (its coefficients), ``notes`` and ``not_seen``.
    """
    args = _flags(audit_command, [], algo, settings)
    subject = audit_command.subject_of(args)
    verdict = audits.audit(subject, args.seeds or 0)
    return Told(verdict.as_json(), [subject.name, *verdict.lines()])


def optimum(env: Any, **env_kwargs: Any) -> Told:
    """The highest expected return under the time limit, as ``optimum``.

    Returns by name: undiscounted returns ``optimum`` and ``baseline`` (of the best random or
    constant policy), ``horizon`` (steps), ``states``, ``seconds`` of the search for the model,
    ``values`` (shape (S,)), ``actions`` (those optimal with all steps left, bool (S, A)).
    """
    env_id, kwargs = _environment(env)
    check_env_id(env_id)
    return Told(*optimum_command.optimum_of(env_id, kwargs | env_kwargs))


def model(env: Any, **env_kwargs: Any) -> TransitionModel:
    """The exact `TransitionModel` of a finite environment: its own, or found in its code."""
    env_id, kwargs = _environment(env)
    with closing(make_env(env_id, kwargs | env_kwargs)) as made:
        return known_model(made, env_id)


def check_env(env: Any, **env_kwargs: Any) -> Told:
    """Check an environment for mistakes, as ``check-env``; returns the findings by their names."""
    env_id, kwargs = _environment(env)
    kwargs = {**kwargs, **env_kwargs, "disable_env_checker": True}
    found = examine(lambda: make_env(env_id, kwargs))
    return Told({one.name: one for one in found}, [*map(str, found)] or ["nothing found"])


def tune(env: Any, algo: str | type, **settings: Any) -> Told:
    """Search for hyperparameters, and test the best on other seeds, as ``tune.py``.

    The same call again continues. Returns ``tuning.json`` by name, ``folder``, and ``conf_file``:
    the winner's settings for `train`, or None if the shipped settings stay.
    """
    args = _flags(tune_command, env, algo, settings)
    tuning, deadline = tune_command.tuning_spec(args), time.monotonic() + args.timeout
    root = Path(args.log_folder) / tuning.study.name
    workers = compare_command.workers_of(args, root, tuning.study.run_timeout)
    with _at_work() as work:
        job = compare_command.Job(root, args.command, *work, workers, not args.no_report)
        tune_command.carry_out(job, tuning, deadline)
    winner = path if (path := root / "winner.yml").exists() else None
    lines = [tuning.study.title, f"winner: {winner or 'none'}", f"files: {root}"]
    return Told({**read_json(root / "tuning.json"), "folder": root, "conf_file": winner}, lines)


# Flags that are no settings in Python; some hyperparameters have their names.
_NONE = {"help", "list", "resume", "resume_or_start", "env", "algo", "algos", "params", "columns"}
_NONE |= {"hyperparams", "policy", "logged", "cluster", "until_decided", "max_seeds"}
_PLAIN: Any = {"force_jupyter": False, "force_terminal": False}


def _flags(
    command: Any, envs: Any, algos: Any, settings: Mapping[str, Any], first: Sequence[str] = ()
) -> Any:
    """A command's flags from keywords; a keyword that is no flag is a hyperparameter."""
    parser, params = command.build_parser(), dict[str, Any]()
    envs, algos = (one if isinstance(one, list | tuple) else [one] for one in (envs, algos))
    flags = {name.lstrip("-").replace("-", "_"): name for name in parser._option_string_actions}
    made, given = [_environment(env, len(envs) == 1) for env in envs], {**settings}
    ids, names = [env_id for env_id, _ in made], [_agent(algo) for algo in algos]
    if made and made[0][1]:
        given["env_kwargs"] = made[0][1] | given.get("env_kwargs", {})
    if "folder" in given:
        given["log_folder"] = given.pop("folder") or tempfile.mkdtemp(prefix="yardstick-")
    words = [*first, *(["--env", *ids] if ids else [])]
    words += ["--algos" if "algos" in flags else "--algo", *names] if names else []
    for key, value in given.items():
        if key not in flags or key in _NONE:
            params[key] = value
        elif isinstance(value, Mapping):
            words += [flags[key], *_assignments(value)]
        elif value is not None and value is not False:
            several = value if isinstance(value, list | tuple) else [value][value is True :]
            words += [flags[key], *map(str, several)]
    words += ["-params", *_assignments(params)] if params else []
    args = parser.parse_args(words)
    args.command = shlex.join(["yardstick", command.__name__.rpartition(".")[2], *words])
    if ids:
        import_typed(args)
    return args


def _assignments(values: Mapping[str, Any]) -> list[str]:
    """``name:literal`` words; classes by their names, such as ``torch.nn.Tanh``."""
    texts = json.dumps(dict(values), default=lambda one: f"{one.__module__}.{one.__qualname__}")
    return [f"{key}:{value!r}" for key, value in json.loads(texts).items()]


def _environment(given: Any, is_alone: bool = True) -> tuple[str, dict[str, Any]]:
    """An id and further arguments, for an environment that is alone; registers one without id."""
    if isinstance(given, str):
        return given, {}
    spec = given.spec if (is_object := isinstance(given, gym.Env)) else None
    if spec and spec.id in gym.registry and not spec.additional_wrappers:
        known = gym.registry[spec.id]
        usual = {"render_mode": spec.kwargs.get("render_mode"), **known.kwargs}
        own = {k: v for k, v in spec.kwargs.items() if repr(usual.get(k, spec)) != repr(v)}
        if spec.max_episode_steps != known.max_episode_steps:
            own["max_episode_steps"] = spec.max_episode_steps or -1
        if is_alone or not own:
            return spec.id, own
    if not (is_object or callable(given)):
        raise UserError(f"an environment is an id, one object or a class, not {shown(given)}")
    for known in gym.registry.values():
        if given in (known.entry_point, *getattr(known.entry_point, "args", ())):
            return known.id, {}
    name = getattr(type(given.unwrapped) if is_object else given, "__name__", "")
    name = name if name.isidentifier() else "Env"
    env_id = next(one for n in count() if (one := f"{name}-v{n}") not in gym.registry)
    made = partial(deepcopy, given) if is_object else given
    REGISTRATIONS[env_id] = partial(gym.register, env_id, entry_point=made)
    REGISTRATIONS[env_id]()
    return env_id, {}


def _agent(algo: str | type) -> str:
    """The name of an agent; a class of the user gets one."""
    if isinstance(algo, str):
        return algo
    if not isinstance(algo, type):
        raise UserError(f"an agent is a name or a class, not {shown(algo)}")
    if algo.__module__.partition(".")[0] in ("rl_yardstick", "stable_baselines3", "sb3_contrib"):
        place = f":{algo.__name__}"
        return next(k for k, one in agents.ALGORITHMS.items() if one.entry_point.endswith(place))
    try:
        return agents.name_of(algo)
    except ValueError as error:
        raise UserError(one_line(error)) from error


@contextmanager
def _at_work(verbose: int = 1) -> Iterator[tuple[TextConsole, Stop]]:
    """A console, and a request to stop that an interrupt sets."""
    # Without ipywidgets a notebook shows lines in place of a bar.
    options = _PLAIN if "ipykernel" in sys.modules and not find_spec("ipywidgets") else {}
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # Workers would import the script that started them, and begin it once more.
    main = vars(sys.modules["__main__"])
    hidden: dict[str, Any] = {name: main.pop(name, None) for name in ("__file__", "__spec__")}
    main["__spec__"] = None
    try:
        yield TextConsole(quiet=verbose < 1, **options), Stop().listen()
    except Stopped:
        raise KeyboardInterrupt("stopped at a safe moment") from None
    except OSError as error:
        raise UserError(f"{error.filename or 'a file'}: {error.strerror or error}") from error
    finally:
        found_models.limit("auto")
        main.update({name: value for name, value in hidden.items() if value is not None})
        for number, handler in handlers.items():
            if signal.getsignal(number) is not handler:
                signal.signal(number, handler)
