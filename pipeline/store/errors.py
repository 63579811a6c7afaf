"""Define the exceptions for run directories; each message says what to do."""

from __future__ import annotations

from magpend_core.troubleshooting import see


class StoreError(Exception):
    """Base class of errors for a run directory that cannot be used; the message has cause and remedy.

    If it has a `topic`, its note names that section of the page of troubleshooting.
    """

    topic = ""

    def __init__(self, *args: object) -> None:
        super().__init__(*args)
        if self.topic:
            self.add_note(see(self.topic))


class RefusedError(StoreError):
    """An error for a directory that holds another run, or is no run directory."""


class DamagedError(StoreError):
    """An error for stored content that has changed since it was written."""

    topic = "damaged"


class LockedError(StoreError):
    """An error for a run directory that another process writes to."""

    topic = "locked"


class UnreadableError(StoreError):
    """An error of the file system during a read: whether the file exists and is undamaged is unknown."""

    topic = "unreadable"


class IncompleteError(StoreError):
    """An error for a run in which tasks that should be finished have no commit record."""

    topic = "pending"
