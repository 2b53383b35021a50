"""The page of a tuning as one file, in the frame of a study's page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import ChoiceLoader, PackageLoader

from pipeline.files import write_text
from report.page.markup import SHARED, as_json, frame, packed, template_file, templates
from report.tuning_page.tuning_figures import history, parallel
from report.tuning_page.tuning_tables import changes, cost, rows
from report.tuning_page.tuning_trials import Trials, importances, trials_of

_SCRIPT = Path(__file__).resolve().parent / "templates" / "tuning.js"


class Part(NamedTuple):
    """A section of the page: its anchor and its heading."""

    name: str
    title: str


def write_tuning_page(record: Mapping[str, Any], path: Path, retest_page: str = "") -> None:
    """Write the page of a tuning, one file that needs nothing else and no network.

    Args:
        record: what the tuning wrote down, see `tuning.retesting`.
        path: the file, which is replaced.
        retest_page: the page of the re-test as seen from there; empty where there is none.
    """
    trials = trials_of(record)
    shares = importances(trials)
    parts = [Part("verdict", "What was found"), Part("history", "History")]
    if trials.judged and record["asked"]:
        parts.append(Part("parallel", "Settings tried"))
    if shares:
        parts.append(Part("importances", "What matters"))
    parts += [Part("cost", "Cost"), Part("trials", "All trials")]
    write_text(path, _render(trials, parts, shares, retest_page))


def _render(
    trials: Trials, parts: list[Part], shares: Mapping[str, float], retest_page: str
) -> str:
    record = trials.record
    asked = record["asked"] or {}
    environment = templates()
    environment.loader = ChoiceLoader(
        [PackageLoader("report.tuning_page"), PackageLoader("report.page")]
    )
    retest = record["retest"]
    again = retest["settings"] if retest else []
    winner = next((each for each in again if each["label"] == retest["winner"]), None)
    data: dict[str, Any] = {
        "page": {"agents": [], "environments": []},
        "history": history(trials),
        "parallel": {**parallel(trials, shares), "winner": winner and winner["number"]},
        "importances": {"names": [*shares], "shares": [*shares.values()]},
    }
    shared = [template_file(name) or "" for name in SHARED]
    own = [_SCRIPT.read_text(encoding="utf-8"), template_file("paper.js") or ""]
    return environment.get_template("tuning.html").render(
        title=f"{asked.get('algo', 'an agent')} on {asked.get('env', 'an environment')}",
        record=record,
        asked=asked,
        sections=parts,
        retest=retest,
        retest_page=retest_page,
        winner=winner,
        changes=[] if winner is None else changes(trials, winner["number"]),
        n_params=len(trials.distributions()),
        cost=cost(trials),
        rows=rows(trials),
        shares=shares,
        data={name: packed(as_json(item)) for name, item in data.items()},
        **frame("\n".join([*shared, *own])),
    )
