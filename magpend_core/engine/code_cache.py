"""Cache machine code on disk. Use a cache file only if it is intact, fits the present code, and was written by this
user.

numba unpickles a cache file and executes the machine code in it. So a cache file here begins with the sha256 of its
content, and the content begins with the key and the digest of the source. A file that is empty, cut short, changed
or made for another function is not used: the function is compiled again and the file written anew. A checksum is
no signature: whoever can write to the folder decides what is executed. So folders are created for their owner
alone, and a folder that others own or can write to is not used.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import logging
import multiprocessing
import os
import pickle
import stat
import threading
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile, UserProvidedCacheLocator
from numba.core.compiler_lock import global_compiler_lock

from magpend_core.troubleshooting import see

fcntl: Any = import_module("fcntl") if find_spec("fcntl") else None  # Windows has none

LOG = logging.getLogger("magpend.cache")

_DIGEST = hashlib.sha256
_LENGTH = _DIGEST().digest_size

_PICKING = threading.Lock()
"""Lock for changes of numba's settings, which all threads share: two threads at once would mix up their folders."""


@cache
def say(line: str) -> None:
    """Log a warning once, and only from the main process, since all worker processes meet the same problem."""
    if multiprocessing.parent_process() is None:
        LOG.warning(line)


def keep(dispatcher: Any, home: Path, folder: Path) -> Any:
    """Give a compiled function an on-disk cache for its machine code.

    Parameters
    ----------
    dispatcher
        Object returned by numba's decorator.
    home, folder
        The folder of all caches, and the subfolder for this function.

    Returns
    -------
    dispatcher
        The given dispatcher. If the folder cannot be used, it has no cache and a warning is logged.
    """
    if not hasattr(dispatcher, "py_func"):  # NUMBA_DISABLE_JIT
        return dispatcher
    function = dispatcher.py_func
    file = inspect.getfile(function)
    own = folder / UserProvidedCacheLocator.get_suitable_cache_subpath(file)  # type: ignore[no-untyped-call]
    problem = _made(home, own)
    if not problem:
        try:
            dispatcher._cache = cache = KeptCode(function, folder)
            dispatcher.compile = cache.compiling_once(dispatcher.compile, dispatcher.targetctx)
        except RuntimeError as error:  # the folder was removed after the check
            problem = f"{error};"
    if problem:
        say(
            f"magpend's compile cache is not used, every process compiles anew: {problem} set "
            f"MAGPEND_CACHE_DIR to a folder of your own {see('compile-cache')}."
        )
    return dispatcher


@cache
def _made(home: Path, folder: Path) -> str:
    """Create a cache folder that only its owner can write to. Return the reason if it cannot be used, else an empty
    text.
    """
    try:
        home.parent.mkdir(parents=True, exist_ok=True)
        for path in (home, *_below(home, folder)):
            path.mkdir(mode=0o700, exist_ok=True)
            found = path.stat()
            if problem := _exposed(found):
                mended = f"chmod go-w {path}, or " if found.st_uid == os.geteuid() else ""
                return f"{path} {problem}, and what is in it is executed; {mended}"
        if not os.access(folder, os.W_OK | os.X_OK):
            return f"{folder} cannot be written to;"
    except OSError as error:
        return f"{error.filename or home} cannot be used ({error.strerror or error});"
    return ""


def _below(home: Path, folder: Path) -> list[Path]:
    parts = folder.relative_to(home).parts
    return [home.joinpath(*parts[: i + 1]) for i in range(len(parts))]


def _exposed(found: os.stat_result) -> str:
    """Return, as text, who else can write to a file or folder; empty if only the owner can."""
    if not hasattr(os, "geteuid"):
        return ""
    mode = f"mode {stat.S_IMODE(found.st_mode):04o}"
    if found.st_uid != os.geteuid():
        return f"belongs to user {found.st_uid} ({mode}), not to you ({os.geteuid()})"
    return f"can be written by others (owner {found.st_uid}, {mode})" if found.st_mode & 0o022 else ""


class _InItsFolder(CompileResultCacheImpl):
    """Variant of numba's cache that uses only the given folder, never one beside the sources."""

    _locator_classes = [UserProvidedCacheLocator]  # noqa: RUF012 # as declared there


class KeptCode(FunctionCache):
    """On-disk cache of one compiled function; an unusable cache file causes a new compilation, not an error."""

    _impl_class = _InItsFolder

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        # numba takes its folder from global settings; restore them for other users of numba
        settings: Any = numba.config
        with _PICKING:
            before = settings.CACHE_DIR, settings.CACHE_LOCATOR_CLASSES
            settings.CACHE_DIR, settings.CACHE_LOCATOR_CLASSES = str(folder), ""
            try:
                super().__init__(function)  # type: ignore[no-untyped-call]
            finally:
                settings.CACHE_DIR, settings.CACHE_LOCATOR_CLASSES = before
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = self._entries = _Entries(self._cache_path, self._impl.filename_base, stamp)  # type: ignore[no-untyped-call]

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the cached machine code for a signature; None if there is no usable one."""
        try:
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        except Exception as error:
            # intact but unreadable: written by another version of Python or numpy than the cache key says
            say(f"a compiled kernel in {self._cache_path} cannot be used ({error!r}); it is compiled again.")
            return None

    def compiling_once(self, compile_: Callable[[Any], Any], target_context: Any) -> Callable[[Any], Any]:
        """Return numba's compilation of the function such that other processes wait for it and read its result."""

        def compile_once(sig: Any) -> Any:
            path = self._entries.path_of(self._index_key(sig, target_context.codegen()))  # type: ignore[no-untyped-call]
            # threads of this process wait for numba's lock first, so that none waits for another one's file
            with global_compiler_lock, made_once(path):
                return compile_(sig)

        return compile_once

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save the machine code for a signature, if the folder can be written to."""
        try:
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]
        except OSError as error:
            _say_not_kept(self._cache_path, error)


class PartFolder:
    """Folder of precompiled engine functions (parts), each in a file with a checksum; see `precompiled`."""

    def __init__(self, folder: Path) -> None:
        self._home, self._folder = folder.parent, folder / "parts"

    def read(self, name: str) -> bytes | None:
        """Return the record of a precompiled function; None if there is no usable one."""
        try:
            return None if _made(self._home, self._folder) else _read_sealed(self._path(name))
        except OSError as error:
            say(f"a compiled kernel is not used: {self._path(name)} ({error.strerror}); it is compiled again.")
            return None

    def write(self, name: str, record: bytes) -> None:
        """Write the record of a precompiled function, if the folder can be used."""
        if _made(self._home, self._folder):
            return
        path = self._path(name)
        own = f"{path}.{os.getpid()}.{threading.get_ident()}"
        try:
            with open(own, "wb", opener=_for_the_owner) as file:
                file.write(_DIGEST(record).digest())
                file.write(record)
            os.replace(own, path)
        except OSError as error:
            _say_not_kept(str(self._folder), error)

    def making(self, name: str) -> contextlib.AbstractContextManager[None]:
        """Return a context in which no other process makes the record of a precompiled function."""
        return contextlib.nullcontext() if _made(self._home, self._folder) else made_once(self._path(name))

    def _path(self, name: str) -> str:
        return os.path.join(self._folder, f"{name}.part")


@contextlib.contextmanager
def made_once(path: str) -> Iterator[None]:
    """Make other processes that need the same cache file wait while this context is open, if the file is missing.

    A process that is killed holds no lock. Where files cannot be locked, each process makes its own.
    """
    lock = None if fcntl is None or os.path.exists(path) else _locked(f"{path}.lock")
    try:
        yield
    finally:
        if lock is not None:
            with contextlib.suppress(OSError):
                os.unlink(f"{path}.lock")
            fcntl.flock(lock, fcntl.LOCK_UN)  # a process forked meanwhile shares the file, and would hold the lock
            os.close(lock)


def _locked(path: str) -> int | None:
    """Open and lock a file; None if it cannot be locked."""
    while True:
        try:
            opened = _for_the_owner(path, os.O_RDWR | os.O_CREAT)
        except OSError:
            return None
        try:
            fcntl.flock(opened, fcntl.LOCK_EX)
            if os.fstat(opened).st_ino == os.stat(path).st_ino:
                return opened
        except FileNotFoundError:  # whoever had the lock has removed the file
            pass
        except OSError:
            os.close(opened)
            return None
        os.close(opened)


def _for_the_owner(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _read_sealed(path: str) -> bytes | None:
    """Read a cache file. If its checksum is wrong or others can write to it, warn and return None."""
    try:
        with open(path, "rb") as file:
            problem = _exposed(os.fstat(file.fileno()))
            sealed = b"" if problem else file.read()
    except FileNotFoundError:
        return None
    content = sealed[_LENGTH:]
    # an empty file fails here, too: it does not begin with the digest of an empty content
    if not problem and _DIGEST(content).digest() == sealed[:_LENGTH]:
        return content
    say(
        f"a compiled kernel is not used: {path} {problem or 'is damaged'}; it is compiled again {see('compile-cache')}."
    )
    return None


def _say_not_kept(folder: str, error: OSError) -> None:
    say(
        f"compiled kernels cannot be kept in {folder} ({error.strerror or error}); make room there, or set "
        f"MAGPEND_CACHE_DIR to another folder {see('compile-cache')}."
    )


class _Entries(IndexDataCacheFile):
    """Cache files of numba, one per signature, without numba's index, which two processes could garble."""

    def load(self, key: Any) -> Any:
        path = self.path_of(key)
        content = _read_sealed(path)
        if content is None:
            return None
        name, stamp, kept = pickle.loads(content)
        if (name, stamp) == (key, self._source_stamp):
            return kept
        say(f"a compiled kernel is not used: {path} is damaged; it is compiled again {see('compile-cache')}.")
        return None

    def save(self, key: Any, data: Any) -> None:
        content = self._dump((key, self._source_stamp, data))  # type: ignore[no-untyped-call]
        with self._open_for_write(self.path_of(key)) as file:
            os.chmod(file.name, 0o600)
            file.write(_DIGEST(content).digest())
            file.write(content)

    def flush(self) -> None:
        for path in Path(self._cache_path).glob(self._data_name_pattern.format(number=0)[:-5] + "*.nbc"):
            path.unlink(missing_ok=True)

    def path_of(self, key: Any) -> str:
        """Return the path of the file with the machine code for a key of numba."""
        name = _DIGEST(repr(key).encode()).hexdigest()[:16]
        return os.path.join(self._cache_path, f"{self._index_name.removesuffix('.nbi')}.{name}.nbc")
