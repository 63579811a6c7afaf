"""Run the command line as if on Windows: ``python tests/windows.py run quickstart --smoke``.

For magpend's own modules the POSIX names of `os`, `signal` and `time` are absent, and the POSIX modules cannot be
imported. A folder cannot be opened, a file that is open for reading cannot be synced, and no process can be asked by a
signal 0. For all modules a file that is open can be neither replaced, renamed nor removed, and no file may have a name
that Windows refuses. Encodings, drives, separators and the system's own locks are Linux's.
"""

import builtins
import errno
import fcntl
import os
import re
import signal
import stat
import sys
import time
from types import ModuleType

OWN = ("pipeline", "magpend", "magpend_core", "workflows")
_POSIX = """
O_CLOEXEC O_DIRECTORY O_NOCTTY O_NOFOLLOW O_NONBLOCK O_SYNC chown chroot confstr ctermid eventfd fchdir fchmod
fchown fdatasync fork forkpty fpathconf fstatvfs getegid geteuid getgid getgroups getloadavg getpgid getpgrp
getpriority getresgid getresuid getsid getuid getxattr killpg lchown lockf major makedev memfd_create minor mkfifo
mknod nice openpty pathconf pidfd_open pipe2 posix_fadvise posix_fallocate posix_spawn posix_spawnp pread preadv
pwrite pwritev readv sched_getaffinity sched_setaffinity sched_yield sendfile setegid seteuid setgid setgroups
setpgid setpriority setsid setuid setxattr splice statvfs sync sysconf tcgetpgrp tcsetpgrp ttyname uname wait wait3
wait4 waitid writev SIGALRM SIGBUS SIGCHLD SIGCONT SIGHUP SIGKILL SIGPIPE SIGPROF SIGQUIT SIGSTOP SIGTSTP SIGUSR1
SIGUSR2 alarm getitimer pause pthread_kill pthread_sigmask setitimer siginterrupt sigpending sigtimedwait sigwait
sigwaitinfo clock_getres clock_gettime clock_settime pthread_getcpuclockid tzset CLOCK_MONOTONIC
CLOCK_PROCESS_CPUTIME_ID CLOCK_REALTIME CLOCK_THREAD_CPUTIME_ID
"""
ABSENT = frozenset(_POSIX.split())
UNIMPORTABLE = {
    "crypt",
    "curses",
    "fcntl",
    "grp",
    "posix",
    "pty",
    "pwd",
    "readline",
    "resource",
    "syslog",
    "termios",
    "tty",
}
REFUSED = re.compile(r'[<>:"|?*\\\x00-\x1f]|[. ]$|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)', re.IGNORECASE)


class _Seen(ModuleType):
    """A standard module as magpend sees it."""

    def __init__(self, real, **changed):
        super().__init__(real.__name__)
        self._real, self._changed = real, changed

    def __getattr__(self, name):
        if name in ABSENT:
            raise AttributeError(f"{self._real.__name__}.{name} is not on Windows")
        return self._changed.get(name) or getattr(self._real, name)


def _open(path, flags, *rest, **options):
    if os.path.isdir(path):
        raise PermissionError(errno.EACCES, "a folder cannot be opened", path)
    return os.open(path, flags, *rest, **options)


def _fsync(number):
    if stat.S_ISREG(os.fstat(number).st_mode) and fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(errno.EBADF, "a file that is open for reading cannot be synced")
    os.fsync(number)


def _kill(number, code):
    raise AssertionError("os.kill ends a process, or all of a console if its signal is 0")


_SEEN = {
    "os": _Seen(os, open=_open, fsync=_fsync, kill=_kill, supports_effective_ids=frozenset()),
    "signal": _Seen(signal),
    "time": _Seen(time),
}
_import = builtins.__import__


def _imported(name, globals=None, locals=None, fromlist=(), level=0):
    if str((globals or {}).get("__name__")).partition(".")[0] in OWN and not level:
        if name in UNIMPORTABLE:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if name in _SEEN:
            return _SEEN[name]
    return _import(name, globals, locals, fromlist, level)


def _watch(event, arguments):
    """Refuse what Windows refuses of any program."""
    if event in ("os.rename", "os.remove"):
        for path in map(os.path.realpath, arguments[: 2 if event == "os.rename" else 1]):
            # where there is no lock of Windows, `filelock` removes its file before it closes it
            if not path.endswith("lock") and any(one == path or one.startswith(f"{path}/") for one in _opened()):
                raise PermissionError(errno.EACCES, "open, or a folder with an open file", path)
    is_moved = event == "os.rename"
    made = is_moved or event == "os.mkdir" or (event == "open" and (arguments[2] or 0) & os.O_CREAT)
    path = arguments[1 if is_moved else 0] if made else ""
    parts = str(path).split("/") if isinstance(path, str | os.PathLike) else []
    if wrong := [part for part in parts if part not in ("", ".", "..") and REFUSED.search(part)]:
        raise OSError(errno.EINVAL, f"no name on Windows: {wrong[0]}", path)


def _opened():
    found = set()
    for name in os.listdir("/proc/self/fd"):
        try:
            found.add(os.readlink(f"/proc/self/fd/{name}"))
        except OSError:
            continue
    return found


if __name__ == "__main__":
    builtins.__import__ = _imported
    sys.addaudithook(_watch)
    from pipeline.cli.entry import main

    main()
