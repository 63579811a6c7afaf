"""Record where, when and with which versions a run was made. None of this enters the run's digest."""

from __future__ import annotations

import contextlib
import platform
import subprocess
from datetime import UTC, datetime
from functools import lru_cache
from importlib import metadata
from pathlib import Path

_ROOT = Path(__file__).parents[2]
_GIT_SECONDS = 5.0
_PACKAGES = ("magpend", "numpy", "numba", "zarr", "numcodecs", "xarray")


def provenance() -> dict[str, str]:
    """Return the time ``created`` (UTC, ISO 8601), the ``host``, and, if magpend runs from a git repository, its
    ``git_commit``.

    This has 40 hexadecimal digits, followed by ``+changes`` where files differ from the commit.
    """
    commit = git_commit()
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        **({"git_commit": commit} if commit else {}),
    }


def versions() -> dict[str, str]:
    """Return the versions of Python, of magpend and of the packages that affect numbers and files."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


@lru_cache
def git_commit() -> str:
    """Return the git commit of magpend's sources; empty if they are in no repository."""
    # a package installed below somebody's repository does not belong to it
    if _git("ls-files", "--error-unmatch", str(Path(__file__).relative_to(_ROOT))) is None:
        return ""
    return _git("describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+changes") or ""


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(_ROOT), *arguments],
            capture_output=True,
            encoding="utf-8",
            check=True,
            timeout=_GIT_SECONDS,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
