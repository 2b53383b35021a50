"""Runs the probes on an algorithm, over seeds, and comes to a verdict."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from rl_yardstick.diagnosis import agent_probes, target_probes
from rl_yardstick.diagnosis.faults import FAULTS, Finding
from rl_yardstick.diagnosis.subjects import Lab, NotSettled, Subject
from rl_yardstick.pipeline.errors import UserError, one_line

Probe = Callable[[Lab], Finding | None]
PROBES: Mapping[Probe, str] = {
    target_probes.probe_ends: "the end of an episode",
    target_probes.probe_discount: "the discount",
    target_probes.probe_cuts: "an episode that is cut off",
    target_probes.probe_next_action: "the next action",
    target_probes.probe_ratio: "the importance ratio",
    target_probes.probe_target_network: "the target network",
    target_probes.probe_age: "the age of training data",
    target_probes.probe_n_steps: "targets of several steps",
    target_probes.probe_advantages: "advantages of rollouts",
    target_probes.probe_traces: "traces",
    agent_probes.probe_choice: "what it does when evaluated",
    agent_probes.probe_entropy: "the entropy term",
    agent_probes.probe_schedules: "the schedule of the learning rate",
    agent_probes.probe_exploration: "the schedule of exploration",
    agent_probes.probe_seeds: "seeds",
    agent_probes.probe_files: "saving and loading",
}
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
        return sorted(found, key=lambda finding: list(FAULTS).index(finding.fault))

    @property
    def is_right(self) -> bool:
        """Whether the targets were checked and no fault was found."""
        states = {f.probe: f.state for f in self.findings}
        deciding = (target_probes.probe_ends, target_probes.probe_discount)
        return not self.faults and all(states.get(PROBES[probe]) == "ok" for probe in deciding)

    @property
    def exit_code(self) -> int:
        """0 if right, 1 for a fault, 2 if nothing can be said."""
        return 1 if self.faults else 0 if self.is_right else 2

    def as_json(self) -> dict[str, Any]:
        """The verdict as JSON: the findings, and the sentence and source of each fault."""
        words = ("right", "fault", "nothing can be said")
        faults = [
            {"fault": finding.fault, **FAULTS[finding.fault]._asdict()}
            | {"measured": finding.text, "right": finding.right}
            for finding in self.faults
        ]
        return {
            "algorithm": self.subject,
            "verdict": words[self.exit_code],
            "fault": faults[0]["fault"] if faults else None,
            "faults": faults,
            "probes": [asdict(finding) for finding in self.findings],
        }


def audit(
    subject: Subject, seeds: Sequence[int], probes: Collection[Probe] | None = None
) -> Iterator[Finding]:
    """Yield the findings of each probe.

    A probe that finds nothing wrong with the first seed is done. Otherwise it is repeated with the
    other seeds, and the majority counts.
    """
    labs = [Lab(subject, seed) for seed in seeds]
    reads_values = {*list(PROBES)[:10], agent_probes.probe_schedules}
    if not subject.has_values:
        text = "it has no values, so its targets cannot be checked"
        yield Finding("skipped", text, probe="its values")
    for probe in PROBES if probes is None else probes:
        if probe in reads_values and not subject.has_values:
            continue
        found: list[Finding | None] = []
        for lab in labs:
            try:
                found.append(probe(lab))
            except NotSettled as error:
                found.append(Finding("unsaid", str(error)))
            except UserError:
                raise
            except Exception as error:  # noqa: BLE001 (user code may raise anything)
                text = f"it cannot train here: {type(error).__name__}: {one_line(error)}"
                found.append(Finding("unsaid", text))
            if found[0] is None or found[0].state in ("ok", "skipped"):
                break
        if (agreed := _most_agreed(found)) is not None:
            yield replace(agreed, probe=PROBES.get(probe, probe.__name__))


def _most_agreed(found: list[Finding | None]) -> Finding | None:
    """The finding of the majority of seeds, as the first of these seeds gave it."""
    signs = [(None, "") if each is None else (each.state, each.fault) for each in found]
    (sign, n), *_ = Counter(signs).most_common()
    if 2 * n > len(signs):
        return found[signs.index(sign)]
    told = sorted({fault or str(state) for state, fault in signs})
    return Finding("unsaid", f"seeds disagree: {', '.join(told)}")
