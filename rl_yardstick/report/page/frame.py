"""What pages have in common: templates, data for scripts, sections."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from importlib.resources import files
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from rl_yardstick.envs.layout import GridLayout
from rl_yardstick.experiments.analysis import StudyAnalysis
from rl_yardstick.experiments.plan import PlannedRun
from rl_yardstick.pipeline.errors import visible
from rl_yardstick.report.series import StudySeries
from rl_yardstick.report.words import number, optimum_words, scale_words

_WORD_ENDS = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[-_/:.])(?=\w)")

STYLES = ("parts.css", "page.css", "paper.css")
# Scripts that the sections use, loaded before their own.
SHARED = ("core.js", "exports.js", "figures.js", "tables.js")

SIGNIFICANT = 5  # digits in the data of figures; a screen shows fewer


def templates(folder: str = "") -> Environment:
    """The templates, those in ``folder`` first; they escape all values."""
    paths = [f"templates/{folder}", "templates"]
    environment = Environment(
        loader=ChoiceLoader([PackageLoader("rl_yardstick.report.page", path) for path in paths]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
        finalize=lambda value: visible(value) if type(value) is str else value,
    )
    environment.filters.update(
        number=number,
        optimum=optimum_words,
        hidden=scale_words,
        # A label may wrap where its words end: "Frozen|Lake8x8-|v1".
        breakable=lambda label: Markup("<wbr>").join(_WORD_ENDS.split(label)),
    )
    return environment


def template_file(name: str) -> str:
    """The text of a file beside the templates."""
    return (files("rl_yardstick.report.page") / "templates" / name).read_text(encoding="utf-8")


def rounded(number: float) -> float | None:
    """A number for figures; None if it is not finite."""
    return float(f"{number:.{SIGNIFICANT}g}") if math.isfinite(number) else None


def as_json(value: Any, of_float: Callable[[float], Any] = rounded) -> str:
    """Compact JSON of a value, also of arrays and dataclasses, with its floats by ``of_float``."""
    text = json.dumps(value, default=lambda one: vars(one) if is_dataclass(one) else one.tolist())
    names = ("parse_float", "parse_constant")
    read: Any = dict.fromkeys(names, lambda found: of_float(float(found)))
    value = json.loads(text, **read)
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def data_uri(kind: str, content: bytes) -> str:
    """A file as a data URI; ``kind`` is its MIME type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def packed(text: str) -> str:
    """A text compressed by gzip and encoded in base64: a third of its size."""
    return base64.b64encode(gzip.compress(text.encode("utf-8"), mtime=0)).decode("ascii")


def script_hash(text: str) -> str:
    """How a content security policy names an inline script."""
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def page_frame(
    scripts: Sequence[str], styles: Sequence[str] = STYLES, is_plotted: bool = True
) -> dict[str, str]:
    """Styles, scripts, and their content security policy; of a page with figures also Plotly."""
    early, own = template_file("theme.js"), "\n".join(map(template_file, scripts))
    running, style = [early, own], "\n".join(map(template_file, styles))
    page = {"style": style, "early": early, "own": own}
    if is_plotted:
        from plotly.offline import get_plotlyjs

        running += [template_file("start.js"), get_plotlyjs()]
        page |= {"start": running[2], "plotly": packed(running[3])}
    ours = {name: Markup(text) for name, text in page.items()}  # noqa: S704  # no one else's
    return {**ours, "policy": " ".join(map(script_hash, running))}


def setting(value: Any) -> str:
    """A hyperparameter as its YAML file has it."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


@dataclass(frozen=True)
class LearningPage:
    """The page that plays the first training of an agent."""

    agent: str  # its label
    environment: str  # that of the environment
    seed: int  # of the training
    place: str  # path of the file, relative to the study's folder; empty if there is none
    words: str  # what it shows, or why there is none
    size: int = 0  # of the file, in bytes


@dataclass(frozen=True)
class Report:
    """The input of a study's page."""

    series: StudySeries  # the numbers in its figures
    command: str  # the command that reproduces the study
    # The pages that play trainings, where they were asked for.
    learning: Sequence[LearningPage] = ()

    @property
    def analysis(self) -> StudyAnalysis:
        """The study."""
        return self.series.analysis


@dataclass(frozen=True)
class Section:
    """One part of the page."""

    name: str  # of its template, its script and its anchor
    title: str  # its heading
    context: Mapping[str, Any] = field(default_factory=dict)  # the variables of its template
    # The data of its script, to write as JSON; None if there are none.
    data: Any = None
    # The script's data for each environment, in their order, parsed when that is chosen; None
    # where there are none.
    places: Sequence[Any] = ()
    # Whether it shows the environment that is chosen at the top of the page. Its template marks
    # what belongs to environment i by ``data-environment="i"``.
    by_environment: bool = False


def first_runs(analysis: StudyAnalysis) -> list[list[PlannedRun]]:
    """By environment, the first finished run of each agent; no batches, which save no agent."""
    first: dict[tuple[str, str], PlannedRun] = {}
    for run in analysis.results.finished:
        if not run.is_batch:
            first.setdefault(run.labels, run)
    ranked = [[(a.agent, one.environment) for a in one.agents] for one in analysis.environments]
    return [[first[name] for name in names if name in first] for names in ranked]


def layout_data(layout: GridLayout) -> dict[str, Any]:
    """The layout of states on a map, for scripts."""
    return {
        "rows": layout.rows,
        "moves": layout.moves,
        "names": dict(layout.names),
        "layers": [layout.collected_in(layer) for layer in range(layout.n_layers)],
    }
