"""What can be wrong with a run directory; each message says what to do."""

from __future__ import annotations


class StoreError(Exception):
    """The run directory cannot be used as asked; the message says why and what to do."""


class RefusedError(StoreError):
    """The directory holds another run, or is no run directory."""


class DamagedError(StoreError):
    """What is stored is not what was written."""


class LockedError(StoreError):
    """Another process is writing to the run directory."""


class UnreadableError(StoreError):
    """The file system failed while something was read; whether it is there is not known."""


class IncompleteError(StoreError):
    """All tasks returned, and not all of them are committed."""
