"""Write files atomically, without following links; errors name the file and the remedy."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import stat
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr

TEMPORARY = ".tmp"

# absent on Windows
_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
_NO_WAIT = getattr(os, "O_NONBLOCK", 0)
_FOLDER = getattr(os, "O_DIRECTORY", 0)

_REMEDIES = {
    errno.ENOSPC: "make room on its disk",
    errno.EDQUOT: "make room within the quota of its disk",
    errno.EFBIG: "raise the limit on the size of a file",
    errno.EROFS: "make its disk writable, or give another place",
    errno.EACCES: "change the access rights, or give another place",
    errno.EPERM: "change the access rights, or give another place",
    errno.ENOENT: "its folder is gone: make it again, or give another place",
    errno.ENOTDIR: "a file is where its folder should be: remove it, or give another place",
    errno.EISDIR: "a folder is at its place: remove it, or give another place",
    errno.EEXIST: "something else is at its place: remove it, or give another place",
}


class NoFileError(FileNotFoundError):
    """Error for a path that is not a regular file; the message says why."""


class LinkError(NoFileError):
    """Error for a link where a regular file is expected."""


class WritingError(OSError):
    """An error for a file that could not be written; the message names file, cause and remedy.

    `errno` is the cause's.
    """

    def __str__(self) -> str:
        return str(self.strerror)


@contextlib.contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Convert an `OSError` raised in the block into a `WritingError` that names the file and the remedy.

    Raises
    ------
    WritingError
        For any `OSError`.
    """
    try:
        yield
    except WritingError:
        raise
    except NoFileError as error:
        raise WritingError(
            errno.EEXIST, f"{path}: cannot be written (what is there {error}); remove it, then repeat the command."
        ) from None
    except OSError as error:
        remedy = _REMEDIES.get(error.errno or 0, "look after its disk")
        raise WritingError(
            error.errno,
            f"{error.filename2 or error.filename or path}: cannot be written ({error.strerror or error}); "
            f"{remedy}, then give the same command again.",
        ) from error


def open_plain(path: Path, mode: str, **options: Any) -> IO[Any]:
    """Open a regular file; refuse links, folders, pipes and devices.

    Parameters
    ----------
    path, mode, options
        Arguments of `open`.

    Raises
    ------
    LinkError
        If the path is a link.
    NoFileError
        If the path is anything else but a plain file.
    FileNotFoundError
        If the path does not exist.
    """
    return open(path, mode, opener=_open_plain, **options)


def _open_plain(path: str, flags: int) -> int:
    if not _NO_FOLLOW and os.path.islink(path):
        raise LinkError("is a link")
    try:
        handle = os.open(path, flags | _NO_FOLLOW | _NO_WAIT, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise LinkError("is a link") from None
        if error.errno == errno.ENXIO:  # a socket, or a pipe that nobody reads
            raise NoFileError("is no file") from None
        if error.errno == errno.ENOTDIR:
            raise NoFileError("lies below a file") from None
        raise
    if stat.S_ISREG(os.fstat(handle).st_mode):
        return handle
    os.close(handle)
    raise NoFileError("is no file")


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file atomically, so that a crash never leaves it incomplete. A link at the path is replaced by the file.

    Raises
    ------
    WritingError
        If the file cannot be written.
    """
    temporary = temporary_beside(path)
    with writing(path):
        try:
            with temporary.open("xb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except OSError:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


def temporary_beside(path: Path) -> Path:
    """Return a unique name for a temporary file in the folder of a given file."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}{TEMPORARY}")


def sync_folder(path: Path) -> None:
    """Flush a folder's entries to disk, so that they survive a crash; do nothing where folders cannot be opened."""
    if not _FOLDER:
        return
    handle = os.open(path, os.O_RDONLY | _FOLDER)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_netcdf(path: Path, ds: xr.Dataset) -> None:
    """Write a dataset as a NetCDF file atomically: complete or not at all."""
    write_atomically(path, netcdf_bytes(ds))


def json_value(value: Any) -> Any:
    """Return data in types that JSON has: numpy's become Python's, and numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {key: json_value(inner) for key, inner in value.items()}
    plain = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(plain, list | tuple):
        return [json_value(inner) for inner in plain]
    return None if isinstance(plain, float) and not math.isfinite(plain) else plain


def netcdf_bytes(ds: xr.Dataset) -> bytes:
    """Return a dataset as the bytes of a NetCDF file."""
    return bytes(ds.to_netcdf(engine="scipy", format="NETCDF3_64BIT"))
