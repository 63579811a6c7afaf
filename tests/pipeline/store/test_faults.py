"""Kills, failing calls and power cuts at every step of a run: it goes on, and ends with the very same bytes.

A short run is watched call by call (see `faults`). The suite takes a spread of its steps, another one for
each kind of fault; ``MAGPEND_LONG=1`` takes every step.
"""

from __future__ import annotations

import errno
import itertools
import os
import shutil
import signal
import subprocess
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline import open_run
from pipeline.layout.plan import make_plan
from pipeline.specification.spec import Spec
from pipeline.store import commits, records
from pipeline.store.errors import StoreError
from pipeline.store.stored_json import fits, unseal
from tests.pipeline.factories import RESULT, duffing, quietly, result_of
from tests.pipeline.store import faults
from tests.pipeline.store.faults import CHANGES, MKDIR, OPEN, READ, RENAME, SYNC, WRITE, Disk, Steps

LONG = os.environ.get("MAGPEND_LONG") == "1"
KILLS = 16

SPEC = duffing(
    kind="continuation",
    n_transient=1,
    n_keep=2,
    tolerance=1e-5,
    execution="points_per_task = 2",
    more='[continuation]\npath = "frequency_hz"\ndirection = "up"',
)


def go(folder):
    return quietly(folder / "spec.toml", folder / "run")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """An uninterrupted run: its files, its numbers, and all that it did."""
    folder, patch = tmp_path_factory.mktemp("faults"), pytest.MonkeyPatch()
    for module in (records, commits):  # two records make a pack, so that packing is a step too
        patch.setattr(module, "BLOCK", 2)
    (folder / "spec.toml").write_text(SPEC)
    go(folder)  # compiled, and imported
    shutil.rmtree(folder / "run")
    with Steps(folder / "run").watching() as steps:
        go(folder)
    ds = open_run(folder / "run").load()
    values = {str(name): ds[name].values for name in ds.data_vars}
    yield SimpleNamespace(folder=folder, log=steps.log, files=result_of(folder / "run", RESULT), values=values)
    patch.undo()


@pytest.fixture
def place(tmp_path):
    (tmp_path / "spec.toml").write_text(SPEC)
    return tmp_path


def spread(n, most, seed):
    """Numbers from 1 to `n`: all of them, or some from all over."""
    if LONG or n <= most:
        return range(1, n + 1)
    edges = np.linspace(1, n + 1, most + 1).astype(int)
    rng = np.random.default_rng(seed)
    return [int(rng.integers(a, b)) for a, b in itertools.pairwise(edges)]


def assert_nothing_wrong_is_shown(directory, finished):
    """What a reader gets of a stopped run was written, or is pending; or it is told that there is no run."""
    try:
        with open_run(directory) as ds:
            done = ds.status.values != 0
            for name, written in finished.values.items():
                found = ds[name].values
                assert np.array_equal(found[done], written[done], equal_nan=found.dtype.kind == "f"), name
    except StoreError:
        pass


def assert_goes_on(place, finished):
    with Steps(place / "run").watching():  # without waiting for the disk
        assert go(place).complete
    assert result_of(place / "run", RESULT) == finished.files


# ---- kills -------------------------------------------------------------------------------------


def in_a_child(function):
    """Run a function in a forked process; returns the signal that ended it, or 0."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads stay behind: none holds a lock here
        pid = os.fork()
    if pid == 0:
        try:
            os.setpgid(0, 0)
            function()
        finally:
            os._exit(0)
    return os.WTERMSIG(os.waitpid(pid, 0)[1])


def killed_at(place, number):
    """Run until a step, and kill the whole process group there."""

    def act(n, step):
        if n == number:
            os.killpg(0, signal.SIGKILL)

    def child():
        with Steps(place / "run", act).watching():
            go(place)

    return in_a_child(child)


@pytest.mark.slow
def test_kill__at_every_step(finished, place):
    tried = 0
    for number in spread(len(finished.log), KILLS, seed=1):
        assert killed_at(place, number) == signal.SIGKILL, number
        assert_nothing_wrong_is_shown(place / "run", finished)
        assert_goes_on(place, finished)
        shutil.rmtree(place / "run")
        tried += 1
    assert tried == len(finished.log) if LONG else tried == KILLS


@pytest.mark.slow
def test_kill__again_and_again(finished, place):
    """Each attempt is killed in its turn: what was committed stays, and in the end nothing is left to do."""
    rng, kills = np.random.default_rng(2), 0
    while killed_at(place, int(rng.integers(100, 300))) == signal.SIGKILL:
        kills += 1
        assert_nothing_wrong_is_shown(place / "run", finished)
        assert kills < 30
    assert kills >= 3
    assert_goes_on(place, finished)


# ---- calls that fail ---------------------------------------------------------------------------

FULL = CHANGES - {SYNC, faults.UNLINK}
KINDS = {
    errno.EIO: CHANGES | {READ},
    errno.ENOSPC: frozenset({OPEN, WRITE, MKDIR}),
    errno.EROFS: CHANGES - {SYNC, WRITE},
    errno.EACCES: (CHANGES | {READ}) - {SYNC, WRITE},
    errno.EDQUOT: frozenset({WRITE, SYNC}),
}


def failing(number, code, *, once):
    """Let a step fail, or from a step on all whose kind can fail so."""

    def act(n, step):
        if (n == number if once else n >= number) and step.kind in KINDS[code]:
            raise OSError(code, os.strerror(code), str(step.path))

    return act


def fails(main, place, act):
    """Run the command while calls fail; what it says, or None if it came through."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*no file lock here")
        with Steps(place / "run", act).watching() as steps:
            code, out, err = main("run", "spec.toml", "--out", "run", "--workers", 0)
    text = "\n".join(line for line in err.splitlines() if line.startswith("magpend: "))
    assert "Traceback" not in err + out
    if code == 0:
        return None, steps
    assert code in (2, 4, 5), (code, err)
    assert text.count("magpend: ") == 1, err
    return text, steps


@pytest.mark.slow
@pytest.mark.parametrize("once", [True, False], ids=["one call", "all from there"])
@pytest.mark.parametrize("code", KINDS, ids=[errno.errorcode[code] for code in KINDS])
def test_failing__at_every_step(finished, place, main, code, once):
    steps = list(enumerate(finished.log, 1))
    numbers = [n for n, step in steps if step.kind in KINDS[code]]
    # when the lock is taken away all is written
    released = max(n for n, step in steps if (step.kind, step.path.name) == (faults.UNLINK, "lock.json"))
    said = 0
    for place_in_list in spread(len(numbers), 4, seed=code + once):
        number = numbers[place_in_list - 1]
        text, _ = fails(main, place, failing(number, code, once=once))
        if text is not None:
            said += 1
            assert os.strerror(code) in text or "not committed" in text, text
            assert_nothing_wrong_is_shown(place / "run", finished)
        else:
            assert once or number >= released, finished.log[number - 1]
            assert result_of(place / "run", RESULT) == finished.files
        assert_goes_on(place, finished)
        shutil.rmtree(place / "run")
    assert said or once


# ---- no room -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_no_room__files_may_not_grow(finished, place):
    """The operating system itself refuses, in a process of its own."""
    code = "import resource, signal\nresource.setrlimit(resource.RLIMIT_FSIZE, (600, 600))\n"
    code += "from pipeline.cli.main import main\nmain()"
    words = ["run", place / "spec.toml", "--out", place / "run", "--workers", "0"]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("magpend: ")) == (4, 1)
    assert "Traceback" not in done.stderr
    assert os.strerror(errno.EFBIG) in done.stderr
    assert_nothing_wrong_is_shown(place / "run", finished)
    assert_goes_on(place, finished)


# ---- power cuts --------------------------------------------------------------------------------


def disks(finished):
    """The disk after each step of a run, with the step that comes next."""
    disk = Disk(top=finished.folder)
    for step in finished.log:
        yield disk, step
        disk.take(step)
    yield disk, None


def test_power_cut__order_of_syncs_and_renames(finished):
    """A record is renamed into place after all that it vouches for, and its own content, is on the disk."""
    top, n_records = finished.folder / "run", 0
    for disk, step in disks(finished):
        if step is None or step.kind != RENAME:
            continue
        source, target = step.path, step.target
        if target.parent.name not in ("commits", "run"):
            continue
        assert disk.names[source.parent][source.name].is_kept, f"{target.name} is renamed before it is synced"
        content = disk.names[source.parent][source.name].content
        if target.parent.name == "commits":
            found = records_in(target.name, content)
            vouched = [top / "cube.zarr" / key for record in found for key in record["objects"]]
            n_records += len(found)
        else:
            vouched = [f for f in disk.files() if top / "cube.zarr" in f.parents]
        kept = disk.after_a_cut(top, lambda path: False)
        for file in vouched:
            assert kept.get(file) == file.read_bytes(), (target.name, file)
    # each on its own, then in a pack
    assert n_records == 2 * make_plan(Spec.read(finished.folder / "spec.toml")).n_tasks
    assert disk.after_a_cut(top, lambda path: False).keys() >= {top / key for key in finished.files}


def records_in(name, content):
    """Records in a file of ``commits``, one or a pack; none if it is not what was sealed."""
    if name.startswith(".") or not fits(content):
        return []
    lines = content.splitlines(keepends=True)
    return [unseal(line) for line in (lines[:-1] if name.endswith(".jsonl") else lines)]


def shown(files, top, finished):
    """Number of tasks that are committed among files, after comparing what their records vouch for."""
    tasks = set()
    for path, content in files.items():
        if path.parent == top / "commits":
            for record in records_in(path.name, content):
                tasks.add(record["task"])
                for key in record["objects"]:
                    assert files.get(top / "cube.zarr" / key) == finished.files[f"cube.zarr/{key}"], key
    return len(tasks)


KEEPS = {
    "nothing unsynced": lambda disk, rng: lambda path: False,
    "names alone": lambda disk, rng: lambda path: path in disk.names,
    "by chance": lambda disk, rng: lambda path: bool(rng.random() < 0.5),
}


@pytest.mark.slow
@pytest.mark.parametrize("keeps", KEEPS)
def test_power_cut__at_every_step(finished, place, keeps):
    """No record that counts is there without what it vouches for; and the run goes on to the same bytes."""
    top, rng, seen = finished.folder / "run", np.random.default_rng(3), []
    chosen = set(spread(len(finished.log), 6, seed=4))
    for n, (disk, _) in enumerate(disks(finished)):
        files = disk.after_a_cut(top, KEEPS[keeps](disk, rng))
        seen.append(shown(files, top, finished))
        if n not in chosen:
            continue
        for path, content in files.items():
            copy = place / "run" / path.relative_to(top)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(content)
        assert_nothing_wrong_is_shown(place / "run", finished)
        assert_goes_on(place, finished)
        shutil.rmtree(place / "run")
    assert max(seen) == 2
    assert seen == sorted(seen) or keeps == "by chance"  # what was committed once stays committed
