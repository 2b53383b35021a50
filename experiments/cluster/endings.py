"""How runs end that were sent to a cluster, by what their workers say and what then lies here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from experiments.cluster.answers import FAILED, STOPPED, UNFIT, RefusedAnswerError, unpacked
from experiments.cluster.receiving import check_in_place, receive
from experiments.cluster.sent_runs import SentRun
from experiments.launching import RunFailure, failed, failure_log
from experiments.planned_runs import PlannedRun
from pipeline.errors import UserError, one_line


@dataclass(frozen=True)
class Ending:
    """The end of a run.

    Attributes:
        reason: why it failed; empty where it is done, and in its place.
        details: the same at length, if there is more to say.
    """

    reason: str = ""
    details: str = ""

    def written_down(self, planned: PlannedRun, root: Path) -> RunFailure | None:
        """The failure, with its details in the study's folder; of a run that is done, none."""
        if self.reason:
            return failed(planned, root, self.reason, self.details or f"{self.reason}\n")
        failure_log(root, planned).unlink(missing_ok=True)
        return None


def ending_of(sent: SentRun, content: object, root: Path) -> Ending | None:
    """What a run ends with by the answer of its worker; what it leaves is in its place then.

    Args:
        sent: the run.
        content: the answer, of which nothing is believed.
        root: the study's folder.

    Returns:
        The end; None where the run is to be sent again.

    Raises:
        UserError: if the worker can do no run at all.
    """
    try:
        answer = unpacked(content)
        if answer.kind == FAILED:
            return Ending(answer.reason or "it does not say why", answer.details)
        if answer.kind == UNFIT:
            raise UserError(f"--cluster: {answer.reason}: start it anew, from the same folder")
        if answer.kind == STOPPED:
            sent.worker = None
            return None
        if answer.files is None:
            check_in_place(sent.planned)
        else:
            receive(sent.planned, root, answer.files)
    except RefusedAnswerError as error:
        sent.refuse(one_line(error))
        return None
    except OSError as error:  # the disk is full
        return Ending(one_line(error))
    return Ending()
