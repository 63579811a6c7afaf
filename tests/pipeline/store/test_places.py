"""Places that no run may take, links, disks that fail, set-ups that stopped: nothing is lost without a word."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import platform
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipeline.compute import execute, task
from pipeline.runs.derive import prune
from pipeline.runs.status import state
from pipeline.runs.verify import describe, verify_run
from pipeline.store import commits, local, records, tasks
from pipeline.store.commits import marker_key, pack_block, read_commits, sweep
from pipeline.store.errors import IncompleteError, LockedError, RefusedError, StoreError, UnreadableError
from pipeline.store.files import RECORD_COPY
from pipeline.store.local import writer_lock
from pipeline.store.products import open_product
from pipeline.store.run import RunDirectory, open_run
from pipeline.store.runfile import read_run
from pipeline.store.setup import check, establish
from pipeline.store.stored_json import seal, unseal
from tests.pipeline.factories import contents, duffing, quietly, silent

# ---- places that no run may take ---------------------------------------------------------------


@pytest.mark.parametrize("below", ["cube.zarr/new", "commits/new", "new", "cube.zarr", "derived/a/b"])
def test_run__refuses_a_place_inside_of_another_run(place, below):
    before = contents(place)
    with pytest.raises(RefusedError, match=r"lies inside of the run directory .*; give another --out"):
        quietly(place.with_name("spec.toml"), place / below)
    assert contents(place) == before


FOREIGN = {
    "thesis.tex": ("x", "is not empty and no run directory"),
    "lock.json": ('{"packages": {}}', "has a lock.json that no run has left"),
    "lock.json of nothing": ("", "has a lock.json that no run has left"),
    "timings.jsonl": ('{"name": "somebody"}\n', "has a timings.jsonl that no run has left"),
    "timings.jsonl of numbers": ("1 2 3\n", "has a timings.jsonl that no run has left"),
    RECORD_COPY: ('{"mine": 1}\n', rf"has a {RECORD_COPY} that no run has left"),
    "cube.zarr/zarr.json": ('{"attributes": {"digest": "of mine"}}', "digest of mine"),
    "cube.zarr/zarr.json of nothing": ("{}", "and nothing in it shows that this run"),
}


@pytest.mark.parametrize("what", FOREIGN)
def test_check__a_folder_with_a_file_of_somebody_else_stays(made, tmp_path, what):
    text, words = FOREIGN[what]
    path = tmp_path / "theirs" / what.partition(" of ")[0]
    path.parent.mkdir(parents=True)
    assert check(tmp_path / "theirs", made.plan.identity) is None
    path.write_text(text)
    with pytest.raises(RefusedError, match=f"(?s){words}.*[Gg]ive another --out"):
        check(tmp_path / "theirs", made.plan.identity)
    assert [f.read_text() for f in (tmp_path / "theirs").rglob("*") if f.is_file()] == [text]
    with pytest.raises(RefusedError, match="is a file"):
        check(path, made.plan.identity)
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "nowhere")
    with pytest.raises(RefusedError, match="is a link that leads nowhere; remove it, or give another --out"):
        check(link, made.plan.identity)


def test_check__another_run_stays(whole):
    directory, other = whole.info.directory, {**whole.plan.identity, "versions": {"engine": 1000}}
    assert check(directory, whole.plan.identity) == whole.info
    (directory / "run.json").unlink()
    with pytest.raises(RefusedError, match="what another run has left"):
        check(directory, other)
    assert check(directory, whole.plan.identity) is None


# ---- links: what they lead to is never touched ---------------------------------------------------

RUN = ("run", "spec.toml", "--out", "run", "--workers", 0)
VERIFY = ("verify", "--repair", "run")
EXTEND = ("extend", "run", "--axis", "amplitude=0.2:0.3:5", "--workers", 0)
PLOT = ("plot", "bifurcation", "run")
ANALYSE = ("analyse", "attractors", "run", "--no-polish", "--no-extend")
WRITERS, DRAWERS, ANALYSTS = (RUN, VERIFY, EXTEND), (PLOT,), (ANALYSE,)

PLACES = {
    "lock": WRITERS,
    "lock.json": WRITERS,
    "timings.jsonl": WRITERS,
    "extended.json": WRITERS,
    "run.json": (RUN, VERIFY),
    "commits": WRITERS,
    "commits/000000.json": WRITERS,
    "cube.zarr": WRITERS,
    "cube.zarr/zarr.json": WRITERS,
    "cube.zarr/section": WRITERS,
    "cube.zarr/section/zarr.json": WRITERS,
    "cube.zarr/section/c.0.0.0.0.0": WRITERS,
    "cube.zarr/x_0/c.0": WRITERS,
    "figures": DRAWERS,
    "figures/{figure}.png": DRAWERS,
    "figures/{figure}.nc": DRAWERS,
    "derived": ANALYSTS,
    "derived/{product}": ANALYSTS,
    "derived/{product}/zarr.json": ANALYSTS,
}


IN_TABLE = ("run.json", "commits", "cube.zarr")
"""Links from these places to the same content: `test_damage`."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("below", "kind"),
    [(p, k) for p in PLACES for k in ("same", "dangling") if k == "dangling" or not p.startswith(IN_TABLE)],
)
def test_commands__write_through_no_link(place, main, tmp_path, below, kind):
    commands = PLACES[below]
    if commands is ANALYSTS:
        below = below.format(product=next((place / "derived").iterdir()).name)
    if commands is DRAWERS:
        assert main(*PLOT)[0] == 0
        below = below.format(figure=next((place / "figures").iterdir()).stem)
    elsewhere, path = tmp_path / "elsewhere", place / below
    outside = elsewhere / "outside"
    elsewhere.mkdir()
    if path.exists():
        path.rename(outside)
    else:
        outside.write_text("somebody's\n")
    if kind == "dangling":
        shutil.rmtree(outside) if outside.is_dir() else outside.unlink()
    path.symlink_to(outside)
    before = contents(elsewhere)
    for command in commands:
        code, _, said = main(*command)
        assert contents(elsewhere) == before, (command, said)
        assert "Traceback" not in said
        if path.is_symlink() and command in (RUN, PLOT):
            assert code == 2, (command, said)
            assert f"{below}: is a link" in said


@pytest.mark.parametrize("what", ["chunk", "chunk later", "zarr.json", "folder", "product file", "product"])
def test_open_run__links_are_not_followed_out(place, tmp_path, what):
    """Whatever is behind a link, with the same bytes or not: it is not read as a part of the run."""
    product, section = next((place / "derived").glob("attractors-*.zarr")), place / "cube.zarr" / "section"
    paths = {"zarr.json": section / "zarr.json", "folder": section, "product": product}
    path = (paths | {"product file": product / "zarr.json"}).get(what, section / "c.0.0.0.0.0")
    opened = open_run(place)
    path.rename(tmp_path / "outside")
    path.symlink_to(tmp_path / "outside")
    use = open_run if what in ("zarr.json", "folder", "chunk") else lambda _: open_product(product)
    with pytest.raises((StoreError, OSError), match=r"link|is missing"):
        opened.section.load() if what == "chunk later" else use(place)


# ---- chunks that are gone ----------------------------------------------------------------------

COMMANDS = (
    "status RUN",
    "analyse attractors RUN",
    "plot bifurcation RUN",
    "report RUN",
    "explore RUN --no-browser",
    "extend RUN --axis amplitude=0.2:0.4:5 --out wider",
)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("command", COMMANDS)
def test_lost_chunk__is_damage_and_not_pending(place, main, command, packed, monkeypatch):
    """A file that a commit record names is gone: no command goes on with the other cells."""
    if packed:
        for module in (records, commits):
            monkeypatch.setattr(module, "BLOCK", 2)
        info = read_run(place)
        pack_block(info, 0)
        assert not (place / marker_key(1)).exists()
    chunk = place / "cube.zarr/section/c.1.0.0.0.0"
    chunk.unlink()
    code, _, err = main(*(str(place) if word == "RUN" else word for word in command.split()))
    assert code == 5, err
    assert f"{chunk} is missing" in err
    assert f"magpend verify {place}" in err
    assert not (place.parent / "wider").exists()


def test_lost_chunk__is_left_to_compute_in_a_dry_run_and_a_run(place, main):
    before = (place / "cube.zarr/status/c.1.0.0").read_bytes()
    (place / "cube.zarr/status/c.1.0.0").unlink()
    code, out, _ = main("run", place.with_name("spec.toml"), "--out", place, "--dry-run")
    assert code == 0
    assert "cells, 2 done" in out
    assert main("run", place.with_name("spec.toml"), "--out", place, "--workers", 0)[0] == 0
    assert (place / "cube.zarr/status/c.1.0.0").read_bytes() == before


def test_lost_chunk__of_a_record_that_another_process_withdraws_meanwhile(place, monkeypatch):
    info, absent_objects = read_run(place), commits.absent_objects
    asked = []

    def meanwhile(*arguments):
        if not asked:
            (place / marker_key(1)).unlink()
            (place / "cube.zarr/status/c.1.0.0").unlink()
        asked.append(1)
        return absent_objects(*arguments) if asked[1:] else {1: "status/c.1.0.0 is missing"}

    monkeypatch.setattr(commits, "absent_objects", meanwhile)
    assert set(read_commits(info)) == {0, 2}


def test_verify__repairs_nothing_of_an_intact_run_that_it_may_not_write_to(place, main, monkeypatch):
    def refused(*arguments):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(place))

    monkeypatch.setattr(local.LocalFiles, "lock", refused)
    code, out, _ = main("verify", "--repair", place)
    assert (code, "3 of 3 tasks committed and intact" in out) == (0, True)
    (place / marker_key(1)).write_text("torn")
    assert main("verify", "--repair", place)[0] == 4


def test_prune__links_are_not_followed(place, tmp_path):
    derived, outside = place / "derived", tmp_path / "outside"
    (outside / "x.zarr").mkdir(parents=True)
    (outside / "x.zarr/kept").write_text("x")
    (derived / "mean-1.zarr").symlink_to(outside / "x.zarr")
    prune(place)
    assert not (derived / "mean-1.zarr").is_symlink()
    shutil.rmtree(derived)
    derived.symlink_to(outside)
    with pytest.raises(RefusedError, match="derived: is a link"):
        prune(place)
    assert (outside / "x.zarr/kept").read_text() == "x"


# ---- disks that fail ---------------------------------------------------------------------------


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.ESTALE])
def test_read__an_unreadable_record_stops_and_removes_nothing(place, monkeypatch, number):
    before, original = contents(place), local.open_plain

    def open_plain(path, mode, **options):
        if path.name == "000001.json":
            raise OSError(number, os.strerror(number), str(path))
        return original(path, mode, **options)

    monkeypatch.setattr(local, "open_plain", open_plain)
    for use in (RunDirectory.open, verify_run, lambda d: quietly(place.with_name("spec.toml"), d)):
        with pytest.raises(UnreadableError, match=r"000001\.json: cannot be read .* Nothing was removed"):
            use(place)
    assert contents(place) == before


def test_scan__commits_that_never_stay_the_same_stop(place, monkeypatch):
    """Somebody packs and unpacks for ever: reading ends all the same."""
    opened, calls = RunDirectory.open(place), []

    def names(folder):
        calls.append(folder)
        return ["000000-000999.jsonl"] if len(calls) % 2 else []

    monkeypatch.setattr(commits, "_names", names)
    with pytest.raises(UnreadableError, match="changes while it is read"):
        commits.scan(opened.info)


def fail_at(monkeypatch, name, kind):
    """Let calls of the system fail without a path, as `write` and `fsync` do; returns the calls that did."""
    original, failed = getattr(os, kind), []

    def call(first, *arguments, **options):
        target = os.readlink(f"/proc/self/fd/{first}") if isinstance(first, int) else str(first)
        if name in target:
            failed.append(target)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return original(first, *arguments, **options)

    monkeypatch.setattr(os, kind, call)
    return failed


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc to name open files")
@pytest.mark.parametrize(
    "command",
    [
        ("plot", "bifurcation", "run"),
        ("plot", "bifurcation", "run", "--out", "figure.pdf"),
        ("analyse", "attractors", "run", "--csv", "table.csv", "--no-polish", "--no-extend"),
        ("report", "run", "--out", "page.html", "--only-stored"),
    ],
)
def test_commands__name_what_could_not_be_written(place, main, monkeypatch, command):
    fail_at(monkeypatch, str(place.parent), "fsync")
    code, _, said = main(*command)
    assert code == 4, said
    assert "cannot be written (No space left on device); make room on its disk" in said
    assert "[Errno" not in said


@pytest.mark.parametrize("moment", ["before writing", "while writing"])
def test_run__removed_while_it_goes_on_ends_and_can_be_made_again(sound, tmp_path, monkeypatch, bytes_of, moment):
    shutil.copy(sound / "spec.toml", tmp_path)
    write_task, write_block, done = task.write_task, tasks.write_block, []

    def writing_task(info, index, *rest):
        done.append(index)
        if len(done) == 2 and moment == "before writing":
            shutil.rmtree(tmp_path / "run")
        write_task(info, index, *rest)

    def writing_block(cube, *rest):
        if len(done) == 2 and moment == "while writing" and (tmp_path / "run").exists():
            shutil.rmtree(tmp_path / "run")
            # as zarr would make it, had it opened the array before
            (tmp_path / "run/cube.zarr/section").mkdir(parents=True)
        return write_block(cube, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(task, "write_task", writing_task)
        patch.setattr(tasks, "write_block", writing_block)
        with pytest.raises(Exception, match=r"removed|gone|missing|damaged|not found|No such|fail"):
            quietly(tmp_path / "spec.toml", tmp_path / "run")
    assert quietly(tmp_path / "spec.toml", tmp_path / "run").complete
    assert bytes_of(tmp_path / "run") == bytes_of(sound / "run")


def test_run__ends_only_if_every_task_is_committed_here(place, main, monkeypatch):
    """Workers that wrote elsewhere, and a record that vanished."""
    original = execute.run_tasks

    def elsewhere(job, indices, **options):
        yield from ({"run": 0, "task": i, "cells": 1} for i in indices)

    def losing(job, indices, **options):
        yield from original(job, indices, **options)
        (place.with_name("losing") / marker_key(2)).unlink()

    for function, words in (
        (elsewhere, "3 of 3 tasks were computed but are not committed here"),
        (losing, "1 of 3 .*the first is 2"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(execute, "run_tasks", function)
            with pytest.raises(IncompleteError, match=words):
                quietly(place.with_name("spec.toml"), place.with_name(function.__name__))
    with monkeypatch.context() as patch:
        patch.setattr(execute, "run_tasks", elsewhere)
        assert main("run", "spec.toml", "--out", "losing", "--workers", 0)[0] == 4
    assert quietly(place.with_name("spec.toml"), place.with_name("losing")).complete


# ---- setting up, sweeping, rebuilding ------------------------------------------------------------


def test_sweep__removes_and_names_what_no_record_vouches_for_and_nothing_else(whole, tmp_path):
    """A chunk without its record, a file of a crash, and links: not what they lead to."""
    directory, said = whole.info.directory, []
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "kept").write_text("x")
    for name in ("derived/kept.txt", "figures/kept.txt"):
        (directory / name).parent.mkdir()
        (directory / name).write_text("x")
    before = contents(directory)
    (directory / "cube.zarr/section/c.0.0.abc.partial").write_bytes(b"x")
    (directory / "cube.zarr/status/c.link").symlink_to(outside / "kept")
    (directory / "cube.zarr/status/folder").symlink_to(outside)
    leftovers = ["section/c.0.0.abc.partial", "status/c.link", "status/folder"]
    assert verify_run(directory).leftovers == leftovers
    assert sweep(whole.info, read_commits(whole.info), said.append) == 3
    assert "removed 3 files that no commit record vouches for: cube.zarr/" in said[0]
    assert contents(directory) == before
    assert (outside / "kept").read_text() == "x"


@pytest.mark.slow
def test_rebuild__files_worded_by_another_version(whole):
    """Where the metadata come out otherwise, repair leaves them; a run writes them and their digests anew."""
    directory = whole.info.directory
    data = unseal((directory / "run.json").read_bytes())
    data["skeleton"]["q/zarr.json"] = {"size": 1, "sha256": "0" * 64}
    (directory / "run.json").write_text(seal(json.dumps(data)))
    found = verify_run(directory, repair=True)
    assert found.skeleton == ["q/zarr.json: its content has changed"]
    assert "another version" in describe(found, directory, repaired=True)[-1]
    establish(directory, whole.plan, silent)
    assert verify_run(directory).sound
    assert len(RunDirectory.open(directory).commits) == whole.plan.n_tasks


# ---- two coordinators in one directory -------------------------------------------------------------------


TWENTY = duffing(
    "frequency_hz = { start = 0.15, stop = 0.25, num = 20 }",
    'kind = "grid"\nx = 0.5\nv = 0.1',
    execution="trajectories_per_task = 1",
)

WITHOUT_LOCKS = """
import sys, time, warnings
import filelock
from pipeline.runs.run import run
def broken(self, *arguments, **options):
    raise NotImplementedError("no locks here")
filelock.FileLock.acquire = broken
warnings.simplefilter("ignore")
spec, out, start = sys.argv[1:]
while time.time() < float(start):
    time.sleep(0.01)
assert run(spec, out, workers=0, echo=lambda line: None).complete
"""


def _hold(directory, ready, done):
    with writer_lock(directory):
        ready.set()
        done.wait(60)


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the lock of a directory."""
    context = multiprocessing.get_context("spawn")
    ready, done = context.Event(), context.Event()
    process = context.Process(target=_hold, args=(tmp_path, ready, done))
    process.start()
    assert ready.wait(60)
    yield process
    process.kill()
    process.join()


@pytest.mark.slow
def test_writer_lock__names_its_holder_and_frees_a_killed_one(holder, tmp_path):
    with pytest.raises(LockedError) as caught, writer_lock(tmp_path):
        pass
    said = str(caught.value)
    assert f"(process {holder.pid} on {platform.node()} since 20" in said
    assert "Wait for it or stop it" in said
    holder.kill()
    holder.join()
    with writer_lock(tmp_path) as alone:  # at once: it waits for nobody
        assert alone
        assert json.loads((tmp_path / "lock.json").read_text())["pid"] == os.getpid()
    assert not (tmp_path / "lock.json").exists()


@pytest.mark.slow
def test_writer_lock__holder_unknown(holder, tmp_path):
    for text in ("", "{", '{"pid": "x"}', "[]"):
        (tmp_path / "lock.json").write_text(text)
        with pytest.raises(LockedError, match=r"is writing here\. Wait"), writer_lock(tmp_path):
            pass


@pytest.mark.slow
def test_run__two_without_locks_end_with_the_same_bytes(write_spec, tmp_path, environment, bytes_of):
    spec = write_spec(TWENTY)
    quietly(spec, tmp_path / "alone")
    # once the imports are done, both begin at the same moment
    arguments = [sys.executable, "-c", WITHOUT_LOCKS, str(spec), str(tmp_path / "both"), str(time.time() + 6)]
    both = [subprocess.Popen(arguments, env=environment, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    errors = [process.communicate(timeout=200)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], errors
    assert state(tmp_path / "both").complete
    found = verify_run(tmp_path / "both")
    assert (found.sound, found.leftovers) == (True, [])
    assert bytes_of(tmp_path / "both") == bytes_of(tmp_path / "alone")
