"""Integrate an initial state live, and send its trajectory, its section points and the attractor on which it ends."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.explorer.data.series import SAMPLES, fixed_points, series
from pipeline.explorer.live.jobs import Job
from pipeline.explorer.live.messages import StartRequest
from pipeline.explorer.live.noisy_starting import noisy_start
from pipeline.explorer.live.settling import LiveFlight, Place, conclude, run_start, system_at
from pipeline.layout.vocabulary import ABSENT

if TYPE_CHECKING:
    from pipeline.explorer.live.live import LiveRun

FIRST_PERIODS, PERIODS = 2, 16
"""Periods of the path that are shown at once, and in all."""

MOST_EVERY_S = 0.03
"""Sections are told at most so often [s]."""


def start(live: LiveRun, job: Job) -> None:
    """Integrate the initial state that a job names; send its trajectory, its section points and its attractor."""
    request = job.request
    assert isinstance(request, StartRequest)
    place = live.place(request.parameters, request.frequency)
    state = live.state(request.state, place)
    if request.noise:
        noisy_start(live, job, place, state)
        return
    path = _Path(live, job, place, state)
    path.show(FIRST_PERIODS)
    sections = _Sections(job)
    flight = LiveFlight(place, live.integration, state[None], job.check)
    if not live.model.autonomous:
        path.show(PERIODS - FIRST_PERIODS)
    block = run_start(flight, live.integration, sections.take, request.periods)
    sections.flush()
    catalog = live.catalog(place)
    begun = sections.done

    def go_on(section: np.ndarray, done: int) -> None:
        sections.take(section, begun + done)

    number = int(conclude(place, live.integration, catalog, block, flight.state, job.check, go_on)[0])
    sections.flush()
    _end(live, job, place, block, number, sections.done)


def _end(live: LiveRun, job: Job, place: Place, block: Block, number: int, periods: int) -> None:
    """Send the name and the colour of the attractor on which an initial state has ended."""
    catalog = live.catalog(place)
    entry, legend = catalog.entry(number), live.legend(catalog)
    line = legend.line(entry)
    # of a start that was run on, the sections kept are those of the way there
    motion = entry.motion if entry.kind != ABSENT else int(catalog.motions(block)[0])
    job.tell(
        "done",
        label=line["label"],
        colour=line["colour"],
        attractor=entry.attractor,
        number=number,
        period=entry.period or int(block.orbit_period[0]),
        status=Status(int(block.status[0])).name.lower(),
        motion=legend.motion(motion) or None,
        periods=periods,
    )


class _Path:
    """Trajectory of an initial state over its first periods, which is sent to the page in parts."""

    def __init__(self, live: LiveRun, job: Job, place: Place, state: np.ndarray) -> None:
        self._live, self._job, self._place = live, job, place
        self._state, self._begin = state, 0.0
        self._period = self._seconds()

    def _seconds(self) -> float:
        """Return the drive period [s] or, for a model with a Poincare section, the mean of the first return times."""
        place = self._place
        if self._live.model.crossing is None:
            return 1.0 / place.frequency
        system = system_at(place, self._live.integration)
        found = run_branches(
            place.parameters.pack()[None, None],
            np.array([[place.frequency]]),
            self._state[None],
            n_transient=0,
            n_keep=4,
            rtol=self._live.integration.rtol,
            atol=self._live.integration.atol,
            system=system,
        )
        assert found.return_time is not None
        times = found.return_time[np.isfinite(found.return_time)]
        return float(times.mean()) if len(times) else 1.0 / place.frequency

    def show(self, n_periods: int) -> None:
        """Integrate the first `n_periods` periods and send them; send nothing if the integration fails."""
        live, place = self._live, self._place
        times = self._period * np.arange(n_periods * SAMPLES + 1) / SAMPLES
        try:
            found = series(
                place.parameters,
                1.0 / self._period,
                self._state,
                times,
                rtol=live.integration.rtol,
                atol=live.integration.atol,
                with_quantities=False,
            )
        except ArithmeticError:
            return
        self._state = found["states"][-1]
        found["time"] = found["time"] + self._begin
        self._begin += float(times[-1])
        self._job.show("path", found, fixed=fixed_points(live.model.flow, place.parameters))


class _Sections:
    """Buffer that collects section points, and sends them to the page at intervals."""

    def __init__(self, job: Job) -> None:
        self._job, self._told = job, time.perf_counter()
        self._kept: list[np.ndarray] = []
        self.done = 0

    def take(self, section: np.ndarray, done: int) -> None:
        """Add section points (k, n_states) to the buffer, and send the buffer if it is time."""
        self._kept.append(section[np.isfinite(section).all(axis=1)])
        self.done = done
        if time.perf_counter() - self._told >= MOST_EVERY_S:
            self.flush()

    def flush(self) -> None:
        section = np.concatenate(self._kept) if self._kept else np.zeros((0, 1))
        self._kept, self._told = [], time.perf_counter()
        if len(section):
            self._job.show("sections", {"section": section}, periods_done=self.done)
