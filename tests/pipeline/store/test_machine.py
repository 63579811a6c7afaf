"""A directory's life, drawn at random: tasks, kills, damage, repairs, extensions; the same bytes at the end.

``MAGPEND_LONG=1`` draws more and longer lives, ``HYPOTHESIS_PROFILE=fresh`` new ones.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
import xarray as xr
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from magpend_core.status import Status
from pipeline.layout.plan import make_plan
from pipeline.runs.extend import extend
from pipeline.runs.status import state
from pipeline.runs.verify import verify_run
from pipeline.specification.spec import Spec
from pipeline.store import commits, records
from pipeline.store.checking import sound_commits
from pipeline.store.commits import Packer, pack_block, read_commits
from pipeline.store.errors import DamagedError, RefusedError, StoreError
from pipeline.store.run import RunDirectory
from pipeline.store.setup import create, establish
from pipeline.store.tasks import write_task
from tests.pipeline.factories import RESULT, duffing, finished, result_of, silent
from tests.pipeline.store.test_damage import delete, flip, truncate, zero

LONG = os.environ.get("MAGPEND_LONG") == "1"

N_TASKS, N_WIDE = 5, 9
ONE = 'kind = "grid"\nx = 0.1\nv = 0.1'


def spec_of(n: int) -> str:
    axes = f"frequency_hz = {{ start = 0.15, stop = 0.25, num = {n} }}"
    return duffing(axes, ONE, n_keep=2, execution="trajectories_per_task = 1")


TASKS = st.integers(0, N_TASKS - 1)
SEEDS = st.integers(0, 10_000)


class KilledError(Exception):
    """Stands for SIGKILL."""


@cache
def computed(n: int) -> tuple[dict[str, bytes], xr.Dataset]:
    """Bytes and cube of a run that nothing happens to."""
    with tempfile.TemporaryDirectory(prefix="life-") as folder:
        directory = finished(Path(folder), spec_of(n))
        return result_of(directory, RESULT), RunDirectory.open(directory).cube().load()


class Directory:
    """A run directory whose tasks know their outcome beforehand."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "run"
        text = spec_of(N_TASKS)
        (folder / "spec.toml").write_text(text)
        self.plan = make_plan(Spec.read(folder / "spec.toml"), text)
        self.info = create(self.path, self.plan)

    def values(self, index: int) -> dict[str, np.ndarray]:
        cube, block = computed(N_TASKS)[1], self.plan.task(index)
        return {v.name: cube[v.name].values[block] for v in self.plan.variables}

    def commit(self, index: int) -> None:
        values = self.values(index)
        (status,) = values["status"].ravel()
        write_task(self.info, index, values, {Status(status).name.lower(): 1})

    def go_on(self) -> None:
        """What a run does."""
        self.info = establish(self.path, self.plan, silent)
        found = sound_commits(self.info, silent)
        packer = Packer(self.info, found)
        for index in range(N_TASKS):
            if index not in found:
                self.commit(index)
                packer.add(index)


class Life(RuleBasedStateMachine):
    """Rules do what happens to a directory; the invariant is what a reader may see."""

    def __init__(self) -> None:
        super().__init__()
        self.patches = [patch.object(module, "BLOCK", 2) for module in (records, commits)]
        for block in self.patches:
            block.start()
        self.folder = Path(tempfile.mkdtemp(prefix="life-"))
        self.wanted = computed(N_TASKS)[0]
        self.run = Directory(self.folder)

    def teardown(self) -> None:
        try:
            self.finish()
        finally:
            for block in self.patches:
                block.stop()
            shutil.rmtree(self.folder)

    @rule(index=TASKS)
    def compute(self, index):
        """A task, for the first time, once more, or late."""
        with contextlib.suppress(DamagedError):  # metadata that are damaged at that moment
            self.run.commit(index)

    @rule(index=TASKS, step=st.integers(1, 9))
    def kill(self, index, step):
        """A worker dies after some of the steps of the protocol."""
        files = type(self.run.info.files)
        calls = []

        def dying(name):
            original = getattr(files, name)

            def call(self, *arguments, **options):
                calls.append(name)
                if len(calls) == step:
                    raise KilledError
                return original(self, *arguments, **options)

            return patch.object(files, name, call)

        with dying("zarr"), dying("sync"), dying("write"):
            try:
                self.run.commit(index)
            except (KilledError, DamagedError):
                return

    @rule(block=st.integers(0, 1), step=st.sampled_from(["write", "remove", "none"]))
    def pack(self, block, step):
        """The coordinator packs, or dies over it."""

        def die(*arguments):
            raise KilledError

        if step == "none":
            pack_block(self.run.info, block)
            return
        with patch.object(type(self.run.info.files), step, die):
            try:
                pack_block(self.run.info, block)
            except KilledError:
                return

    @rule(seed=SEEDS, way=st.sampled_from([flip, truncate, zero, delete, "swap", "foreign"]))
    def damage(self, seed, way):
        """Something happens to a file."""
        rng = np.random.default_rng(seed)
        files = sorted(f for f in self.run.path.rglob("*") if f.is_file() and f.stat().st_size and f.name != "lock")
        file, other = (files[int(i)] for i in rng.integers(len(files), size=2))
        if callable(way):
            way(file, rng)
        elif way == "swap":
            first, second = file.read_bytes(), other.read_bytes()
            file.write_bytes(second)
            other.write_bytes(first)
        else:
            (self.run.path / "cube.zarr/status").mkdir(exist_ok=True, parents=True)
            (self.run.path / "cube.zarr/status/c.77").write_bytes(b"stray")

    @rule()
    def repair(self):
        """What is left counts, and is sound."""
        try:
            verify_run(self.run.path, repair=True)
        except (DamagedError, RefusedError):  # run.json is not what it was
            return
        assert verify_run(self.run.path).sound

    @rule()
    def finish(self):
        """Whatever happened: the same command ends with the bytes of a run that nothing happened to."""
        try:
            self.run.go_on()
        except RefusedError as refusal:  # nothing says any more whose files these are
            if "or remove it" not in str(refusal):
                raise
            shutil.rmtree(self.run.path)
            self.run.go_on()
        assert result_of(self.run.path, RESULT) == self.wanted
        found = verify_run(self.run.path)
        assert (found.sound, found.n_committed, found.leftovers) == (True, N_TASKS, [])
        assert state(self.run.path).complete

    @rule()
    def extend(self):
        """Refined, in whatever state: the bytes of a run that was so fine from the beginning."""
        finer, wide = self.folder / "finer.toml", self.folder / "wide"
        finer.write_text(spec_of(N_WIDE))
        try:
            extend(self.run.path, finer, wide, workers=0, echo=silent)
        except StoreError:  # no cell is there to be taken, or run.json or metadata are not what they were
            self.finish()
            extend(self.run.path, finer, wide, workers=0, echo=silent)
        assert result_of(wide, RESULT) == computed(N_WIDE)[0]
        shutil.rmtree(wide)

    @invariant()
    def is_read_as_written_or_not_at_all(self):
        try:
            opened = RunDirectory.open(self.run.path)
            cube = opened.cube().load()
        except StoreError:
            return
        committed = read_commits(opened.info)
        for index in range(N_TASKS):
            written, block = self.run.values(index), self.run.plan.task(index)
            for variable in self.run.plan.variables:
                expected = written[variable.name]
                if index not in committed:
                    expected = np.full_like(expected, variable.fill)
                assert np.array_equal(cube[variable.name].values[block], expected, equal_nan=True)


Life.TestCase.settings = settings(max_examples=200 if LONG else 5, stateful_step_count=30 if LONG else 8, deadline=None)
test_life = Life.TestCase
