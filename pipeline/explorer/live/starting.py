"""Integrate an initial state live; send its trajectory, its section points and the attractor on which it ends.

A trajectory with white noise settles on no attractor, so none is named at its end.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from magpend_core.disturbance import Disturbance
from magpend_core.models.model import Model
from magpend_core.models.noisy import NoisyModel, noisy
from magpend_core.noisy import NoisySections, cell_words, noisy_sections
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.explorer import RequestError
from pipeline.explorer.data.orbits import SAMPLES_PER_PERIOD, fixed_points, series
from pipeline.explorer.live.jobs import Job
from pipeline.explorer.live.messages import StartRequest
from pipeline.explorer.live.settling import LiveFlight, Place, conclude, run_start, system_at
from pipeline.layout.vocabulary import ABSENT
from pipeline.specification.noise import STEPS_PER_PERIOD

if TYPE_CHECKING:
    from pipeline.explorer.live.live import LiveRun


LARGEST_CHANGE = 0.01
"""Largest change within a period when the steps are halved, in units of the scales; as that of a run's noise."""


def noisy_states(model: Model) -> list[str]:
    """Return the names of the states whose equations get noise: the rates of other states, or all states."""
    rates = {state.rate for state in model.states if state.rate}
    return [name for name in model.state_names if name in rates or not rates]


def noisy_start(live: LiveRun, job: Job, place: Place, state: np.ndarray) -> None:
    """Integrate an initial state with the noise that a job asks for; send its section points piece by piece."""
    usual, piece = 400, 16  # periods of a noisy start, and those that are integrated and sent at once
    request = job.request
    assert isinstance(request, StartRequest)
    path = _NoisyPath(live, place, state, request.noise, request.seed)
    path.choose_steps(job)
    periods, found, error = request.periods or usual, None, 0.0
    while path.done < periods and (found is None or found.status[0] == Status.BOUNDED):
        job.check()
        found = path.advance(min(piece, periods - path.done))
        error = max(error, float(np.nan_to_num(found.strong_error[0])))
        if error > LARGEST_CHANGE:
            raise RequestError(_too_long(path.steps))
        section = found.section[0][np.isfinite(found.section[0]).all(axis=1)]
        if len(section):
            job.show("sections", {"section": section}, periods_done=path.done)
    assert found is not None
    job.tell(
        "done",
        noise=request.noise,
        noisy_states=path.states,
        seed=request.seed,
        steps_per_period=path.steps,
        step_error=error,
        status=Status(int(found.status[0])).name.lower(),
        periods=path.done,
        label=None,
        colour=None,
        attractor=None,
        number=None,
        period=None,
        motion=None,
    )


def _too_long(steps: int) -> str:
    return (
        f"noise: {steps} steps in a period are too few for this motion; take a weaker noise, or make a run with "
        "[noise] and a shorter step."
    )


class _NoisyPath:
    """Trajectory with noise that is integrated a few periods at a time, with the bits of a cell of a noisy run."""

    def __init__(self, live: LiveRun, place: Place, state: np.ndarray, strength: float, seed: int) -> None:
        model, self.states = live.model, noisy_states(live.model)
        if not model.clock.is_continuous:
            raise RequestError(f"noise: {model.name} is a map, and noise acts on the rates of a flow.")
        if model.crossing is not None:
            raise RequestError("noise: sections of this run are crossings, and a noisy state crosses infinitely often.")
        # strengths are parameters: one compilation serves all of them
        self._model: NoisyModel = noisy(model, Disturbance(tuple((name, 1.0) for name in self.states)))
        own = [
            strength * scale for name, scale in zip(model.state_names, model.units, strict=True) if name in self.states
        ]
        self._packed = np.concatenate([place.parameters.pack(), own, [0.0]])[None]
        self._frequency, self._seed = np.array([place.frequency]), seed
        self._state = np.array(state, np.float64)[None]
        self._words = cell_words(self._packed, self._frequency, self._state)
        self.steps, self.done = STEPS_PER_PERIOD, 0

    def choose_steps(self, job: Job) -> None:
        """Double the steps until those of the first period are short enough; raise RequestError if none are."""
        most_steps = 64 * STEPS_PER_PERIOD  # most steps per period that are tried
        while True:
            job.check()
            found = self._call(1)
            if not found.strong_error[0] > LARGEST_CHANGE:  # a start that diverges at once has no error
                return
            if self.steps >= most_steps:
                raise RequestError(_too_long(self.steps))
            self.steps *= 2

    def advance(self, n: int) -> NoisySections:
        """Integrate `n` periods further."""
        found = self._call(n)
        self._state, self.done = found.section[:, -1], self.done + int(found.n_periods[0])
        return found

    def _call(self, n: int) -> NoisySections:
        try:
            system, noise = self._model.system, self._model.noise
        except ValueError as error:  # impacts, or a drive that jumps
            raise RequestError(f"noise: {error}") from None
        return noisy_sections(
            self._packed,
            self._frequency,
            self._state,
            system=system,
            noise=noise,
            seed=self._seed,
            steps_per_period=self.steps,
            n_transient=0,
            n_keep=n,
            first_period=self.done,
            words=self._words,
        )


def start(live: LiveRun, job: Job) -> None:
    """Integrate the initial state that a job names; send its trajectory, its section points and its attractor."""
    first, whole = 2, 16  # periods of the path that are shown at once, and in all
    request = job.request
    assert isinstance(request, StartRequest)
    place = live.place(request.parameters, request.frequency)
    state = live.state(request.state, place)
    if request.noise:
        noisy_start(live, job, place, state)
        return
    path = _Path(live, job, place, state)
    path.show(first)
    sections = _Sections(job)
    flight = LiveFlight(place, live.integration, state[None], job.check)
    if not live.model.clock.has_equilibria:
        path.show(whole - first)
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
        samples = live.model.clock.samples(SAMPLES_PER_PERIOD)
        times = self._period * np.arange(n_periods * samples + 1) / samples
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
        every_s = 0.03  # sections are told at most so often [s]
        self._kept.append(section[np.isfinite(section).all(axis=1)])
        self.done = done
        if time.perf_counter() - self._told >= every_s:
            self.flush()

    def flush(self) -> None:
        section = np.concatenate(self._kept) if self._kept else np.zeros((0, 1))
        self._kept, self._told = [], time.perf_counter()
        if len(section):
            self._job.show("sections", {"section": section}, periods_done=self.done)
