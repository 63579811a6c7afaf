"""Make a specification from a region that the user has selected, and compute its run beside the present one."""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magpend_core.models.imported import KEY
from pipeline.explorer import RequestError
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.verticals import vertical
from pipeline.explorer.live.jobs import PATIENCE_S, Job
from pipeline.explorer.live.messages import Region, RunRequest
from pipeline.layout.cells import parameter_axes
from pipeline.layout.identity import canonical
from pipeline.layout.plan import Plan, make_plan
from pipeline.layout.vocabulary import is_grid_dim, parameter_name
from pipeline.runs.status import state
from pipeline.runs.zoom import Changes, to_toml, zoom
from pipeline.specification.spec import Spec
from pipeline.specification.starts import GridStarts, RandomStarts
from pipeline.store.errors import StoreError
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    from pipeline.explorer.live.live import LiveRun

MOST_OF_REGION = 2_000_000
"""Cells of a region that the explorer runs; more are for the command line."""


_PACKAGES = Path(__file__).parents[3]


def zoomed(run: RunDirectory, region: Region) -> tuple[Spec, list[str]]:
    """Return the specification for a selected region, and notes on the parts of it that lie outside the run."""
    ExploredRun.open(run).check_axes(region.at)
    return zoom(run.spec, changes_of(run, region))


def zoom_toml(run: RunDirectory, region: Region) -> str:
    """Return the specification for a selected region as TOML, with comments on its origin."""
    spec, notes = zoomed(run, region)
    head = [f"# Zoom into a run, digest {run.info.digest}.", *(f"# note: {_one_line(note)}" for note in notes)]
    return "\n".join([*head, to_toml(spec)])


def changes_of(run: RunDirectory, region: Region) -> Changes:
    """Return the changes that restrict the specification of a run to a selected region."""
    swept = {axis.parameter: axis for axis in parameter_axes(run.spec)}
    first, second = _names(run, region, list(swept))
    ranges = {}
    for key, ends in ((first, region.x), (second, region.y)):
        if key is not None and ends is not None:
            ranges[key] = _rounded(key, *ends)
    pins = {}
    for name, index in region.at.items():
        key = parameter_name(name)
        if key not in swept or key in ranges:
            continue
        values = swept[key].values
        if not 0 <= index < len(values):
            raise RequestError(f"at.{name} = {index}: the axis has {len(values)} values, 0 to {len(values) - 1}.")
        pins[key] = float(values[index])
    return Changes(ranges, pins)


def _names(run: RunDirectory, region: Region, swept: list[str]) -> tuple[str, str | None]:
    """Return the names of the one or two axes or states that a selected region restricts."""
    walk = run.spec.continuation
    if region.axes is None:
        if not swept:
            raise RequestError("the run sweeps no parameter; name the states of the starts in axes.")
        return (walk.path if walk is not None else swept[0]), None
    names = [name for name in region.axes if name is not None]
    given = [name.removesuffix("_0") if is_grid_dim(name) else parameter_name(name) for name in names]
    states = run.model.state_names
    starts = run.spec.initial_conditions
    has_ranges = isinstance(starts, GridStarts | RandomStarts) and not starts.origin
    known = [*swept, *(states if has_ranges else ())]
    first = given[0]
    if first not in known:
        raise RequestError(f"axes: {region.axes[0]!r} is not what the run sweeps: {', '.join(known)}.")
    if len(given) < 2 or given[1] == first:
        return first, None
    # a state over a parameter is the diagram's vertical axis, not a range of starts
    if given[1] not in (*known, *states):
        vertical(ExploredRun.open(run), names[1])
    fits = given[1] in known and (given[1] in swept or first in states)
    return first, given[1] if fits else None


def _rounded(name: str, low: float, high: float) -> tuple[float, float]:
    """Round the ends of an interval to the digits that a mouse can resolve."""
    n_digits = 4  # decimal digits of an interval's length that its ends keep
    if not low < high:
        raise RequestError(f"{name}: the interval {low:g} to {high:g} is empty; its end must be greater.")
    if not math.isfinite(high - low):
        raise RequestError(f"{name}: the interval {low:g} to {high:g} is too long.")
    digits = n_digits - 1 - math.floor(math.log10(high - low))
    ends = round(low, digits), round(high, digits)
    return ends if ends[0] < ends[1] else (low, high)


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)


# ---- running it ----------------------------------------------------------------------------------


def region_name(run: RunDirectory, spec: Spec) -> str:
    """Return the name of the directory for the run of a region; equal specifications have equal names."""
    digest = hashlib.sha256(canonical(spec.as_dict()).encode()).hexdigest()[:8]
    base = re.sub(r"-zoom-[0-9a-f]{8}$", "", run.directory.resolve().name)
    return f"{base}-zoom-{digest}"


class RegionRunner:
    """Computes the runs of selected regions, one at a time for all users."""

    def __init__(self, live: LiveRun) -> None:
        self._live, self._busy = live, live.region_lock

    def run(self, job: Job) -> None:
        """Compute the run of the region that a job describes, and report its progress."""
        request = job.request
        assert isinstance(request, RunRequest)
        plan = self._checked(request)
        out = self._live.run.directory.resolve().parent / region_name(self._live.run, plan.spec)
        if not self._busy.acquire(blocking=False):
            raise RequestError("a region is being run already; cancel it, or wait.")
        try:
            with tempfile.TemporaryDirectory(prefix="magpend-region-") as folder:
                path = Path(folder) / "region.toml"
                path.write_text(to_toml(plan.spec), "utf-8")
                self._watch(job, plan, path, out)
        finally:
            self._busy.release()

    def _checked(self, request: Region) -> Plan:
        run = self._live.run
        if run.info.files.local is None:
            raise RequestError(f"{run.name} lies in an object store; download the specification and run it.")
        reference = run.spec.reference
        if isinstance(reference, Mapping) and KEY in reference:
            raise RequestError(
                f"the model is the Python object {reference[KEY]}, which running would import; download the "
                "specification and run it yourself."
            )
        plan = make_plan(zoomed(run, request)[0])
        if plan.n_cells > MOST_OF_REGION:
            raise RequestError(
                f"the region has {plan.n_cells} cells; the explorer runs at most {MOST_OF_REGION}: download the "
                "specification and run it yourself."
            )
        return plan

    def _watch(self, job: Job, plan: Plan, path: Path, out: Path) -> None:
        """Run a region's specification in a process of its own; report its progress, and wait for its end."""
        every_s = 0.4  # how often progress is looked at [s]
        words = ["run", str(path), "--out", str(out), *(["--workers", "0"] if plan.n_tasks == 1 else [])]
        job.tell("progress", done=0, total=plan.n_cells, name=out.name)
        with (path.parent / "said").open("w+b") as said, _group(words, path.parent, said) as process:
            done = 0
            while process.poll() is None:
                job.wait(every_s)
                now = _committed(out)
                if now != done:
                    done = now
                    job.tell("progress", done=done, total=plan.n_cells, name=out.name)
            if process.returncode:
                said.seek(0)
                lines = said.read()[-4000:].decode("utf-8", "replace").strip().splitlines()
                why = _one_line(lines[-1])[:300] if lines else f"exit code {process.returncode}"
                raise RequestError(f"the run of the region failed: {why}")
        job.tell("progress", done=plan.n_cells, total=plan.n_cells, name=out.name)
        job.tell("done", name=out.name, cells=plan.n_cells)


def _committed(out: Path) -> int:
    with contextlib.suppress(StoreError, OSError):
        return state(out).n_committed
    return 0


@contextlib.contextmanager
def _group(words: list[str], folder: Path, said: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Start a magpend command in a process group of its own, and end the group with the context."""
    path = os.pathsep.join([str(_PACKAGES), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    process = subprocess.Popen(
        [sys.executable, "-m", "pipeline.cli.main", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        stdin=subprocess.DEVNULL,
        stdout=said,
        stderr=said,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        _end_group(process)


def _end_group(process: subprocess.Popen[bytes]) -> None:
    if process.poll() == 0:
        return
    if process.poll() is None:
        _signal(process, signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(PATIENCE_S)
    _signal(process, getattr(signal, "SIGKILL", signal.SIGTERM))
    process.wait()


def _signal(process: subprocess.Popen[bytes], number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, number)
        elif process.poll() is None:
            process.send_signal(number)
