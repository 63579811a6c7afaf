"""Define the exit codes of the command line."""

from __future__ import annotations

from enum import IntEnum


class Exit(IntEnum):
    """Exit codes of all commands."""

    DONE = 0
    BUG = 1
    REFUSED = 2
    LOCKED = 3
    FAILED = 4
    DAMAGED = 5
    CONTRADICTED = 6
    HUNG_UP = 129
    INTERRUPTED = 130
    TERMINATED = 143

    @property
    def sentence(self) -> str:
        """Meaning of the exit code, for the documentation."""
        return _SENTENCES[self]


_SENTENCES = {
    Exit.DONE: "done",
    Exit.BUG: "an error that magpend did not expect",
    Exit.REFUSED: "bad input, or refused; nothing was created or changed",
    Exit.LOCKED: "another process is writing to the run directory",
    Exit.FAILED: "a computation failed; committed results stay, and the same command continues",
    Exit.DAMAGED: "stored data are damaged",
    Exit.CONTRADICTED: "a study's required claim is contradicted; its report says which",
    Exit.INTERRUPTED: "stopped by Ctrl-C; committed results stay, and the same command continues",
    Exit.TERMINATED: "stopped by SIGTERM; committed results stay, and the same command continues",
    Exit.HUNG_UP: "its terminal was closed; committed results stay, and the same command continues",
}
