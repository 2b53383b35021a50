"""The commands as functions, for scripts and notebooks: ``import rl_yardstick as ys``.

- **Environments** are ids, objects, or a class or function that makes one. An object of a
  registered id stands for that id and its arguments; any other is copied.
- **Agents** are names, or classes.
- **Settings** are the command's flags, with ``_`` in place of ``-``, and hyperparameters:
  ``n_timesteps=20_000`` is ``--n-timesteps 20000``, ``gamma=0.9`` is ``-params gamma:0.9``.
- **Folders** are those of all runs, as in the commands; with ``folder=None``, temporary ones.
- **Results** show themselves in a notebook: the command's lines, and a picture if it has one.

Classes may stand in a cell of a notebook, which has no parallel workers to import it: they get a
copy. Every function raises `UserError`, with one line, for what does not exist or does not fit. An
interrupt ends the work at the next safe moment with `KeyboardInterrupt`.
"""

from __future__ import annotations

import base64
import html
import inspect
import json
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import asdict, replace
from functools import cached_property, partial
from hashlib import sha256
from importlib.util import find_spec
from io import StringIO
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from rl_yardstick.pipeline.errors import Stopped, UserError, one_line, shown

if TYPE_CHECKING:
    from rich.console import Console

    from rl_yardstick.experiments.analysis import StudyAnalysis
    from rl_yardstick.pipeline.run import Stop

# --- results --------------------------------------------------------------------------------------


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

    def __init__(self, data: Mapping[str, Any], lines: Sequence[str], png: bytes | None = None):
        super().__init__(data)
        self.lines, self.png = lines, png


class Run(Shown):
    """A run folder: the result of `train`, or ``Run(path)``.

    Attributes:
        folder: its path.
        spec: its settings.
        result: figures of the final policy (``mean_return``, ``score``, ``optimum``, ...) and of
            the training (``n_timesteps``, ``cpu_seconds``, ...).
        curve: mean returns of the evaluations in training: columns ``step`` and ``value``.
    """

    def __init__(self, folder: str | Path) -> None:
        import pandas as pd

        from rl_yardstick.experiments.results import read_evaluations
        from rl_yardstick.pipeline.run import Run as RunFolder

        self.folder, self._run = Path(folder), RunFolder(Path(folder))
        self.spec, found = self._run.spec(), self._run.recorded()
        kept = {key: value for key, value in found.items() if key not in ("final", "spec")}
        self.result: dict[str, Any] = {**(found.get("final") or {}), **kept}
        steps, values = read_evaluations(self.folder)
        self.curve = pd.DataFrame({"step": steps, "value": values})
        told = [f"{key:<14}{self.result[key]:,.6g}" for key in _TOLD if self.result.get(key)]
        self.lines = [self.spec.title, *told, f"{'folder':<14}{folder}"]
        pictures = (self.folder / name for name in ("value_map.png", "learning_curve.png"))
        self.png = next((path.read_bytes() for path in pictures if path.is_file()), None)

    @cached_property
    def model(self) -> Any:
        """The agent at the end of training, an algorithm of Stable-Baselines3."""
        from rl_yardstick.pipeline.models import load_agent, model_of_run
        from rl_yardstick.pipeline.playing import playing_env

        found = model_of_run(self._run)
        return load_agent(found, playing_env(found, None))


_TOLD = ("score", "mean_return", "optimum", "success_rate", "regret", "n_timesteps", "cpu_seconds")


class Study(Shown):
    """The result of `compare`.

    Attributes:
        folder: its folder; ``page`` is the path of the page there, None with ``no_report=True``.
        table: a row for each environment and agent, the best first: ``point``, ``low`` and
            ``high``, the mean of the metric and its 95 % interval; ``score``; ``cpu_seconds``.
        verdicts: a row for each pair of agents, as in ``verdicts.csv``.
        runs: a row for each run, as in ``summary.csv``; ``curves`` has their evaluations.
        analysis: all of this as objects.
    """

    def __init__(self, analysis: StudyAnalysis) -> None:
        import pandas as pd

        from rl_yardstick.commands.terminal import TextConsole
        from rl_yardstick.report.terminal import print_analysis

        self.analysis, self.folder, text = analysis, analysis.results.root, StringIO()
        self.runs, self.curves = analysis.results.summary, analysis.results.curves
        self.page = page if (page := self.folder / "report.html").is_file() else None
        self.verdicts = pd.read_csv(self.folder / "verdicts.csv")
        rows = [
            {"environment": one.environment, "agent": agent.agent, **asdict(agent.metric.mean)}
            | {"score": getattr(agent.score, "point", None), "cpu_seconds": agent.seconds.point}
            for one in analysis.environments
            for agent in one.agents
        ]
        self.table = pd.DataFrame(rows)
        print_analysis(TextConsole(file=text, width=100, force_jupyter=False), analysis)
        printed = [line.rstrip() for line in text.getvalue().strip().splitlines()]
        self.lines = [*printed, "", f"files: {self.page or self.folder}"]


# --- the functions --------------------------------------------------------------------------------


def train(
    env: Any, algo: str | type = "ppo", *, folder: str | Path | None = "logs", **settings: Any
) -> Run:
    """Train an agent, as ``train.py``; after an interrupt, ``train.py --resume`` continues."""
    from rl_yardstick.commands import train as command
    from rl_yardstick.pipeline.run import Run as RunFolder

    args = _flags(command, [env], [algo], settings)
    spec, root = command.spec_from_flags(args), _folder(folder)
    with (
        _at_work(args.verbose) as on,
        RunFolder.claim(root, spec, console=on[0], stop=on[1]) as run,
    ):
        run.begin(spec, {"algo": spec.algo, "env": spec.env_id, "seed": spec.seed}, args.command)
        with run.console.status("loading the libraries"):
            from rl_yardstick.pipeline import training
        agent = training.train(spec, run).agent
    found = Run(run.path)
    found.model = agent
    return found


def compare(
    envs: Any,
    algos: Any,
    seeds: int = 10,
    *,
    folder: str | Path | None = "logs/studies",
    **settings: Any,
) -> Study:
    """Compare agents over seeds, as ``compare.py``, in parallel processes.

    ``envs`` and ``algos`` are one or a list; settings hold for all agents. The same call again does
    the missing runs alone. Other settings, or other code of your classes, make another folder,
    unless ``name`` is given.
    """
    from rl_yardstick.commands import compare as command
    from rl_yardstick.experiments.analysis import analyse
    from rl_yardstick.experiments.plan import StudyRecord, plan_of_looks, specs_of

    envs, algos = _listed(envs), _listed(algos)
    args = _flags(command, envs, algos, {"seeds": seeds, **settings})
    args.name = args.name or _name([*args.env, *args.algos], [*envs, *algos], settings)
    study = command.study_spec(args)
    record, root = StudyRecord(study, specs_of(study)), _folder(folder) / study.name
    with _at_work() as (console, stop):
        workers = command.workers_of(args, root, study.run_timeout)
        job = command.Job(root, args.command, console, stop, workers, not args.no_report)
        with command.held(root), workers:
            if args.until_decided:
                record = replace(record, looks=plan_of_looks(study, root, args.max_seeds))
            results, _ = command.finished(job, record)
            command.tell_notes(console, results)
            if results.summary.empty:
                raise UserError(f"no run has finished: {next(iter(results.failures.values()), '')}")
            analysis = analyse(results, record.looks)
            command.written(job, analysis)
    return Study(analysis)


def explain(model: Any, env: Any = None, **env_kwargs: Any) -> Told:
    """Show where an agent loses return against the optimum, as ``explain``.

    ``model`` is a `Run`, a path, or an algorithm of Stable-Baselines3, which needs its ``env``.
    Returns ``return``, ``optimum``, ``gap``, ``parts``, ``states``, ``proposals``, ... by name.
    """
    from rl_yardstick.commands import explain as command
    from rl_yardstick.commands.terminal import TextConsole
    from rl_yardstick.diagnosis.explanation import explanation
    from rl_yardstick.pipeline.models import Wanted
    from rl_yardstick.report.words import why_lines

    env_id, kwargs = (None, {}) if env is None else _environment(env)
    kwargs, algo, typed = {**kwargs, **env_kwargs}, None, list[str]()
    with tempfile.TemporaryDirectory() as folder:
        path, picture = Path(folder) / "model.zip", Path(folder) / "map.png"
        if isinstance(model, Run | str | Path):
            path = model.folder if isinstance(model, Run) else Path(model)
            typed = Run(path).spec.gym_packages if (path / "run.json").is_file() else typed
        else:
            algo = _agent(type(model), typed)
            model.save(path)
        wanted = Wanted(path, algo, env_id, env_kwargs=kwargs, typed=typed)
        one = command.asked(TextConsole(quiet=True), wanted)
        found = explanation(one.found.spec, one.agent, one.evaluator)
        with suppress(UserError):  # without a map
            command.draw(one, found, picture)
        png = picture.read_bytes() if picture.exists() else None
    return Told(found.as_data(), why_lines(found), png)


def audit(algo: str | type, **settings: Any) -> Told:
    """Test an implementation for known bugs, as ``audit``.

    Returns ``verdict``, ``fault``, ``faults`` and ``probes`` by name.
    """
    from rl_yardstick.commands import audit as command
    from rl_yardstick.diagnosis.audit import Verdict
    from rl_yardstick.diagnosis.audit import audit as findings_of

    args = _flags(command, [], [algo], settings)
    with _at_work() as (console, _), console.status("auditing"):
        subject = command.subject_of(args)
        verdict = Verdict(subject.name, tuple(findings_of(subject, range(args.seeds))))
    lines = [f"audit of {subject.name}", *map(command.finding_line, verdict.findings)]
    return Told(verdict.as_json(), [*lines, *command.verdict_lines(verdict)])


def optimum(env: Any, **env_kwargs: Any) -> Told:
    """The highest expected return under the time limit, where the environment's model is known.

    Returns by name: ``optimum`` (a return, undiscounted), ``baseline`` (of the best random or
    constant policy), ``horizon`` (the time limit in steps), ``values`` (the highest expected return
    from each state on, shape (S,)), ``actions`` (which are optimal, with all steps left, bool of
    shape (S, A)) and ``policy`` (an optimal action at each step, shape (horizon, S)).
    """
    from rl_yardstick.mdp import finite_horizon_optimum
    from rl_yardstick.pipeline.environments import check_env_id, with_files_read
    from rl_yardstick.pipeline.evaluation.exact import exact_evaluator, model_refusal
    from rl_yardstick.pipeline.spec import validated

    env_id, kwargs = _environment(env)
    check_env_id(env_id)
    entry = with_files_read(env_id, {"env_kwargs": {**kwargs, **env_kwargs}})
    spec = validated({"algo": "optimal", "env_id": env_id, **entry})
    if (evaluator := exact_evaluator(spec)) is None:
        raise UserError(model_refusal(spec) or f"the model of {env_id} is not known")
    scale, horizon = evaluator.yardstick, evaluator.horizon
    figures = {"optimum": scale.optimum, "baseline": scale.baseline, "horizon": horizon}
    values, actions = evaluator.optimum
    policy = finite_horizon_optimum(evaluator.model, horizon).policy
    told = [f"{key:<14}{value:,.6g}" for key, value in figures.items()]
    arrays = {"values": values, "actions": actions, "policy": policy}
    return Told(figures | arrays, [env_id, *told])


def tune(
    env: Any, algo: str | type, *, folder: str | Path | None = "logs/tuning", **settings: Any
) -> Told:
    """Search for hyperparameters, and test the best on other seeds, as ``tune.py``.

    The same call again continues. Returns ``tuning.json`` by name, ``folder``, and ``conf_file``:
    the winner's settings for `train`, or None if the shipped settings stay.
    """
    import time

    from rl_yardstick.commands import compare
    from rl_yardstick.commands import tune as command
    from rl_yardstick.pipeline.files import read_json
    from rl_yardstick.tuning.retesting import RECORD, WINNER

    args = _flags(command, [env], [algo], settings)
    args.name = args.name or _name([args.env, args.algo], [env, algo], settings)
    tuning, deadline = command.tuning_spec(args), time.monotonic() + args.timeout
    root = _folder(folder) / tuning.study.name
    with _at_work() as (console, stop):
        workers = compare.workers_of(args, root, tuning.study.run_timeout)
        job = compare.Job(root, args.command, console, stop, workers, not args.no_report)
        command.carry_out(job, tuning, deadline)
    winner = root / WINNER if (root / WINNER).exists() else None
    lines = [tuning.study.title, f"winner: {winner or 'none'}", f"files: {root}"]
    return Told({**read_json(root / RECORD), "folder": root, "conf_file": winner}, lines)


# --- settings -------------------------------------------------------------------------------------

# Flags that are no settings in Python; some hyperparameters have their names.
_NONE = {
    "help",
    "h",
    "list",
    "resume",
    "resume_or_start",
    "log_folder",
    "f",
    "env",
    "algo",
    "algos",
}
_NONE |= {"params", "hyperparams", "policy", "logged", "columns", "cluster", "script", "json"}
# Settings that change no result of a run.
_BESIDE = {"first_seed", "jobs", "no_report", "until_decided", "max_seeds", "n_trials", "trials"}


def _flags(
    command: ModuleType, envs: Sequence[Any], algos: Sequence[Any], settings: Mapping[str, Any]
) -> Any:
    """A command's flags from keywords; a keyword that is no flag is a hyperparameter."""
    from rl_yardstick.commands.cli import import_typed

    parser, packages, words, params = command.build_parser(), list[str](), list[str](), {}
    flags = {name.lstrip("-").replace("-", "_"): name for name in parser._option_string_actions}
    found = [_environment(env, len(envs) == 1) for env in envs]
    words += ["--env", *(env_id for env_id, _ in found)] if envs else []
    words += ["--algos" if "algos" in flags else "--algo", *(_agent(a, packages) for a in algos)]
    given = {**settings, "env_kwargs": {**settings.get("env_kwargs", {})}}
    for _, kwargs in found:
        given["env_kwargs"] = kwargs | given["env_kwargs"]
    for key, value in given.items():
        if key not in flags or key in _NONE:
            params[key] = value
        elif isinstance(value, Mapping):
            words += [flags[key], *_assignments(value)] if value else []
        elif value is not None and value is not False:
            words += [flags[key], *(map(str, _listed(value)) if value is not True else ())]
    words += ["-params", *_assignments(params)] if params else []
    try:
        args = parser.parse_args(words)
    except UserError as error:
        raise UserError(str(error).removesuffix(" (see --help)")) from None
    args.command = shlex.join(["yardstick", command.__name__.rpartition(".")[2], *words])
    if envs:
        import_typed(args)
    args.gym_packages = [*args.gym_packages, *packages]
    return args


def _assignments(values: Mapping[str, Any]) -> list[str]:
    """``name:literal`` words; classes by their names, such as ``torch.nn.Tanh``."""

    def plain(one: Any) -> Any:
        kind = one if hasattr(one, "__qualname__") else type(one)
        return one.tolist() if hasattr(one, "tolist") else f"{kind.__module__}.{kind.__qualname__}"

    return [f"{k}:{json.loads(json.dumps(v, default=plain))!r}" for k, v in values.items()]


def _listed(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]


def _folder(folder: str | Path | None) -> Path:
    return Path(tempfile.mkdtemp(prefix="yardstick-") if folder is None else folder)


def _name(names: Sequence[str], made: Sequence[Any], settings: Mapping[str, Any]) -> str | None:
    """A name of a folder, with a digest of settings and sources; None without any."""
    from rl_yardstick.experiments.study import file_name

    deciding = [f"{key}={value}" for key, value in settings.items() if key not in _BESIDE]
    for one in made:
        kind = one if isinstance(one, str | type) or inspect.isfunction(one) else type(one)
        # Of a class in a notebook, only the sources of its methods are known.
        for part in [] if isinstance(kind, str) else [kind, *vars(kind).values()]:
            with suppress(OSError, TypeError):
                deciding.append(inspect.getsource(getattr(part, "py_func", part)))
    digest = sha256("\n".join(sorted(deciding)).encode()).hexdigest()[:8]
    return file_name(f"{'-'.join(names).replace('/', '-')[:60]}_{digest}") if deciding else None


# --- environments and agents ----------------------------------------------------------------------

_MADE: dict[str, Any] = {}  # by id, what makes the environments that are registered here


def _environment(given: Any, is_alone: bool = True) -> tuple[str, dict[str, Any]]:
    """An id and further arguments, for an environment that is alone; registers one without id."""
    import gymnasium as gym

    import rl_yardstick.envs  # noqa: F401  # registers this project's environments
    from rl_yardstick.experiments.pool import REGISTRATIONS

    is_object = isinstance(given, gym.Env)
    if isinstance(given, str):
        return given, {}
    spec = given.spec if is_object else None
    if spec and spec.id in gym.registry and not spec.additional_wrappers:
        known = gym.registry[spec.id]
        usual = {"render_mode": spec.kwargs.get("render_mode"), **known.kwargs}
        own = {k: v for k, v in spec.kwargs.items() if repr(usual.get(k, spec)) != repr(v)}
        if spec.max_episode_steps != known.max_episode_steps:
            own["max_episode_steps"] = spec.max_episode_steps or -1
        if is_alone or not own:
            return spec.id, own
    if found := [env_id for env_id, made in _MADE.items() if made is given]:
        return found[0], {}
    if not (is_object or callable(given)):
        form = "an id, a gymnasium.Env, or a class or function that makes one"
        raise UserError(f"an environment is {form}, not {shown(given)}")
    named = type(given.unwrapped) if is_object else given
    name = re.sub(r"\W", "", getattr(named, "__name__", "")) or "Env"
    env_id = next(one for n in count() if (one := f"{name}-v{n}") not in gym.registry)
    made = partial(_copied, given) if is_object else given
    REGISTRATIONS[env_id] = partial(gym.register, env_id, entry_point=made)
    REGISTRATIONS[env_id]()
    _MADE[env_id] = given
    return env_id, {}


def _copied(env: Any, render_mode: str | None = None) -> Any:
    try:
        return deepcopy(env)
    except Exception as error:  # of the user's code
        way_out = "give its class, or a function that makes it"
        raise ValueError(f"cannot be copied ({one_line(error)}): {way_out}") from error


def _agent(algo: Any, packages: list[str]) -> str:
    """The name of an agent; a class of the user gets one, and its module is one of ``packages``."""
    from rl_yardstick import agents
    from rl_yardstick.experiments.pool import REGISTRATIONS

    if not isinstance(algo, type):
        return str(algo)
    module, name = algo.__module__, algo.__qualname__
    if module.partition(".")[0] in ("rl_yardstick", "stable_baselines3", "sb3_contrib"):
        entries = agents.ALGORITHMS.items()
        return next((key for key, one in entries if one.entry_point.endswith(f":{name}")), name)
    if getattr(sys.modules.get(module), name, None) is not algo:
        raise UserError(f"{name}: define the class at the top of its module or cell")
    name_of = getattr(agents, "name_of", None)  # of plain classes
    if name_of is not None and all(base.__name__ != "BaseAlgorithm" for base in algo.__mro__):
        name = name_of(algo)
    else:
        try:
            agents.register(name, f"{module}:{name}")
        except ValueError as error:
            raise UserError(one_line(error)) from error
    packages += [module] if module != "__main__" else []
    REGISTRATIONS[name] = partial(_know, name, agents.ALGORITHMS[name], algo)
    return name


def _know(name: str, entry: Any, algo: type) -> None:
    """Register an agent in a worker, where its class may be a copy from a cell."""
    from rl_yardstick.agents import ALGORITHMS

    ALGORITHMS[name] = entry
    setattr(sys.modules[algo.__module__], algo.__name__, algo)


@contextmanager
def _at_work(verbose: int = 1) -> Iterator[tuple[Console, Stop]]:
    """A console, and a request to stop that an interrupt sets."""
    from rl_yardstick.commands.terminal import TextConsole
    from rl_yardstick.pipeline.run import Stop

    # Without ipywidgets a notebook shows lines in place of a bar.
    in_notebook = None if find_spec("ipywidgets") else False
    # Workers would import the script that started them, and begin it once more.
    main = vars(sys.modules["__main__"])
    hidden = {name: main.pop(name) for name in ("__file__", "__spec__") if name in main}
    main["__spec__"] = None
    try:
        with Stop().listening() as stop:
            yield TextConsole(quiet=verbose < 1, force_jupyter=in_notebook), stop
    except Stopped:
        raise KeyboardInterrupt("stopped at a safe moment") from None
    finally:
        main.update(hidden)
