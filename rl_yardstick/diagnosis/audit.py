"""Runs the probes on an algorithm, over seeds, and comes to a verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rl_yardstick.diagnosis.faults import FAULTS
from rl_yardstick.diagnosis.probes import (
    NEEDS_VALUES,
    PROBES,
    Finding,
    Lab,
    NotSettled,
    Probe,
    probe_discount,
    probe_ends,
)
from rl_yardstick.diagnosis.subjects import Subject
from rl_yardstick.pipeline.errors import UserError, one_line

# A fault of one-step targets explains these faults of targets of several steps.
_OF_ONE_STEP = frozenset(list(FAULTS)[: list(FAULTS).index("importance-ratio")])
_OF_SEVERAL = frozenset({"n-step-return", "traces"})


@dataclass(frozen=True)
class Verdict:
    """The result of an audit."""

    subject: str
    findings: tuple[Finding, ...]

    @property
    def faults(self) -> list[Finding]:
        """The faults, the one that explains most first, without those that follow from another."""
        found = [finding for finding in self.findings if finding.state == "fault"]
        if _OF_ONE_STEP & {finding.fault for finding in found}:
            found = [finding for finding in found if finding.fault not in _OF_SEVERAL]
        found.sort(key=lambda finding: list(FAULTS).index(finding.fault))
        return found

    @property
    def is_right(self) -> bool:
        """Whether the targets were checked and no fault was found."""
        states = {f.probe: f.state for f in self.findings}
        decided = [states.get(_title(probe)) for probe in (probe_ends, probe_discount)]
        return not self.faults and decided == ["ok", "ok"]

    @property
    def exit_code(self) -> int:
        """0 if right, 1 for a fault, 2 if nothing can be said."""
        return 1 if self.faults else 0 if self.is_right else 2

    def as_json(self) -> dict[str, Any]:
        """The verdict as JSON: the findings, and the sentence and source of each fault."""
        words = ("right", "fault", "nothing can be said")
        faults = []
        for finding in self.faults:
            fault = FAULTS[finding.fault]
            entry = {"fault": finding.fault, "sentence": fault.sentence, "source": fault.source}
            faults.append({**entry, "measured": finding.text, "right": finding.right})
        return {
            "algorithm": self.subject,
            "verdict": words[self.exit_code],
            "fault": faults[0]["fault"] if faults else None,
            "faults": faults,
            "probes": [asdict(finding) for finding in self.findings],
        }


def audit(
    subject: Subject, seeds: Sequence[int], probes: Sequence[Probe] = PROBES
) -> Iterator[Finding]:
    """Yield the findings of each probe.

    A probe that finds nothing wrong with the first seed is done. Otherwise it is repeated with the
    other seeds, and the majority counts.
    """
    labs = [Lab(subject, seed) for seed in seeds]
    if not subject.has_values:
        probes = [probe for probe in probes if probe not in NEEDS_VALUES]
        yield Finding("its values", "skipped", "it has no values, so its targets cannot be checked")
    for probe in probes:
        found: list[list[Finding]] = []
        for lab in labs:
            found.append(_findings(probe, lab))
            if all(finding.state in ("ok", "skipped") for finding in found[0]):
                break
        yield from _most_agreed(found)


def _findings(probe: Probe, lab: Lab) -> list[Finding]:
    """The findings of a probe with one seed; "unsaid" where the probe fails."""
    name = _title(probe)
    try:
        return list(probe(lab))
    except NotSettled as error:
        return [Finding(name, "unsaid", str(error))]
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001 (user code may raise anything)
        text = f"{type(error).__name__}: {one_line(error)}"
        return [Finding(name, "unsaid", f"it cannot train here: {text}")]


def _most_agreed(found: list[list[Finding]]) -> list[Finding]:
    """The findings of the majority of seeds, as the first of these seeds gave them."""
    signs = [tuple((each.probe, each.state, each.fault) for each in findings) for findings in found]
    (sign, n), *_ = Counter(signs).most_common()
    if 2 * n > len(signs):
        return found[signs.index(sign)]
    name = found[0][0].probe
    told = {each.fault or each.state for findings in found for each in findings}
    return [Finding(name, "unsaid", f"seeds disagree: {', '.join(sorted(told))}")]


def _title(probe: Probe) -> str:
    return TITLES[probe]


_NAMES = (
    "the end of an episode",
    "the discount",
    "an episode that is cut off",
    "the next action",
    "the importance ratio",
    "the target network",
    "the age of training data",
    "observations that change in place",
    "targets of several steps",
    "traces",
    "what it does when evaluated",
    "the entropy term",
    "the schedule of the learning rate",
    "seeds",
    "saving and loading",
)
TITLES: dict[Probe, str] = dict(zip(PROBES, _NAMES, strict=True))
