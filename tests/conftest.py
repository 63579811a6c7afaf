"""What all tests share: one compile cache, temporary files in memory, a command called in this process, examples drawn.

``HYPOTHESIS_PROFILE=fresh`` draws new examples in every run, more of them, and remembers what failed;
otherwise they are the same ones in every run. Without ``--all`` or ``-m`` the tests marked ``slow`` are left out;
``MAGPEND_LONG=1`` runs what is marked ``long``, too.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest
from hypothesis import settings

# a deadline would fail where the machine is busy, and what is compiled at first use takes long once
settings.register_profile("repeatable", derandomize=True, database=None, deadline=None, print_blob=True)
settings.register_profile("fresh", deadline=None, max_examples=300, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


# two processes whose small matrices are each shared among threads wait for each other; workers of pytest inherit it
os.environ.setdefault("OMP_NUM_THREADS", "1")


def _is_writable(folder: Path) -> bool:
    """Whether a file can be put into a folder, which is made if need be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _share_compile_cache() -> None:
    """Let all tests, their subprocesses and pytest's workers compile into one folder, before any does.

    It is the user's own, so that a second run compiles nothing; one for this run where there is none.
    """
    if os.environ.get("MAGPEND_CACHE_DIR"):
        return
    folder = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "magpend"
    if not _is_writable(folder):
        folder = Path(tempfile.mkdtemp(prefix="magpend-tests-"))
        _TO_REMOVE.append(folder)
    os.environ["MAGPEND_CACHE_DIR"] = str(folder)


MEMORY, ROOM = Path("/dev/shm"), 8 * 2**30
"""A file system in memory where there is one, and how many bytes must be free there."""


def _keep_temporary_files_in_memory() -> None:
    """Put the tests' folders where a sync takes no time: runs sync each file that they write.

    Name a folder in ``TMPDIR`` to keep what a failed test has written.
    """
    if os.environ.get("TMPDIR") or not _is_writable(MEMORY) or shutil.disk_usage(MEMORY).free < ROOM:
        return
    folder = Path(tempfile.mkdtemp(prefix="magpend-tests-", dir=MEMORY))
    _TO_REMOVE.append(folder)
    # for pytest's own folders, its workers and all processes that tests start
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)


_TO_REMOVE: list[Path] = []
_share_compile_cache()
_keep_temporary_files_in_memory()


def pytest_unconfigure() -> None:
    for folder in _TO_REMOVE:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module", autouse=True)
def _figures_are_closed() -> Iterator[None]:
    """Close what a module has opened by pyplot, which warns of many open figures."""
    yield
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        pyplot.close("all")


def _long_steps() -> Iterator[None]:
    """Follow branches in steps four times as long as a user's, for tests that do not ask how long steps are."""
    from pipeline.analysis.branches.arclength import Settings

    with pytest.MonkeyPatch.context() as patch:
        defaults = {**{field.name: field.default for field in fields(Settings)}, "longest_step": 0.02}
        patch.setattr(Settings.__init__, "__defaults__", tuple(defaults.values()))
        yield


long_steps = pytest.fixture(_long_steps, name="long_steps")
long_steps_of_a_file = pytest.fixture(_long_steps, scope="module", name="long_steps_of_a_file")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all", action="store_true", help="run the whole suite, with the tests that are marked slow")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--all") and not config.getoption("-m"):
        slow = [item for item in items if item.get_closest_marker("slow") or item.get_closest_marker("long")]
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if item not in set(slow)]
    if os.environ.get("MAGPEND_LONG", "0") == "1":
        return
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker(pytest.mark.skip(reason="takes minutes; MAGPEND_LONG=1 runs it"))


@pytest.fixture
def command(monkeypatch, capsys):
    """Call ``magpend WORDS`` in a folder, which must succeed; returns its output and its notes."""
    from pipeline.cli.main import main

    def call(folder, *words):
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", ["magpend", *map(str, words)])
        code = 0
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
        captured = capsys.readouterr()
        assert code == 0, captured.err
        return captured.out, captured.err

    return call
