"""What a camera reports by itself (a recovery, a low battery): to the operator, and to the session's journal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rigs.gphoto2_config import CameraEvent
from workbench.journal import Journal


class DeviceNews:
    """Passes events on; those from before the session has a journal are written into it when it starts.

    Parameters
    ----------
    tell
        Shows the operator a line.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._journal: Journal | None = None
        self._early: list[CameraEvent] = []

    def __call__(self, event: CameraEvent) -> None:
        """Take an event in."""
        self._tell(event.message)
        if self._journal is None:
            self._early.append(event)
        else:
            _record(self._journal, event)

    @contextmanager
    def journaled(self, journal: Journal) -> Iterator[None]:
        """While this lasts, events are written into a journal, too."""
        for event in self._early:
            _record(journal, event)
        self._early.clear()
        self._journal = journal
        try:
            yield
        finally:
            self._journal = None


def _record(journal: Journal, event: CameraEvent) -> None:
    facts = {"fault": event.fault, "remedy": event.remedy, "attempt": event.attempt} if event.fault else {}
    journal.append("event", message=event.message, **facts)
