"""Where a training can stop so that nothing is half done."""

from __future__ import annotations

from agents.common.callback_horizons import BlockCallback
from pipeline.stopping import current


class StopAtSafeMoment(BlockCallback):
    """Ends the training, if a signal asks for it, before the next steps are taken.

    That is after the last update and before the environments move: what the agent has seen it has
    learnt from, and what it is about to see has not happened yet.
    """

    takes_blocks = True

    def _on_rollout_start(self) -> None:
        self.stop_if_asked()

    def stop_if_asked(self) -> None:
        """End the training here, if a signal asks for it.

        Raises:
            Stopped: if so.
        """
        stop = current()
        if stop.number is not None:
            with stop.held():
                self.before_stopping()
            stop.raise_if_asked()

    def before_stopping(self) -> None:
        """What there is to do at the last safe moment."""

    def _on_step(self) -> bool:
        return True
