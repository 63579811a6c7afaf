"""Name the errors of a run directory; each message says what to do."""

from __future__ import annotations


class StoreError(Exception):
    """Base class: the run directory cannot be used as asked. The message says why and what to do."""


class RefusedError(StoreError):
    """An error for a directory that holds another run, or is no run directory."""


class DamagedError(StoreError):
    """An error for stored content that has changed since it was written."""


class LockedError(StoreError):
    """An error for a run directory that another process writes to."""


class UnreadableError(StoreError):
    """A failure of the file system during a read: it is unknown whether the file is there and whole."""


class IncompleteError(StoreError):
    """An error for a run whose tasks all returned while some are not committed."""
