"""Hold what all live sessions of a run share: compiled code, known attractors with their colours, opened data."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np
import xarray as xr

from magpend_core.equilibria import newton_steps
from magpend_core.models.parameters import ParameterError
from magpend_core.orbits import section_map
from magpend_core.status import Status
from pipeline.explorer import RequestError
from pipeline.explorer.data.colours import rgb
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.orbits import orbit_series
from pipeline.explorer.live.catalog import Catalog, Entry, Known
from pipeline.explorer.live.jobs import PATIENCE_S
from pipeline.explorer.live.settling import LiveFlight, Place
from pipeline.layout.cells import parameter_axes
from pipeline.layout.evaluation import check_states
from pipeline.layout.vocabulary import ABSENT, ATTRACTS, EQUILIBRIUM, STABILITIES, axis_name
from pipeline.plots.palette import COLOURS, GREY_OF, GREYS, OTHERS, cast_of
from pipeline.plots.palette import MOTION_COLOURS as MOTION_COLOURS
from pipeline.results.ragged import dims_of, isel
from pipeline.specification.tables import FREQUENCY
from pipeline.store.run import RunDirectory


class Legend:
    """Names and colours for the entries of a catalog, those of the run's attractors if they are known."""

    def __init__(self, catalog: Catalog, attractors: xr.Dataset | None) -> None:
        self._catalog, self._model = catalog, catalog.model
        self._known = attractors is not None
        ids = [e.attractor for e in catalog.entries if e.attractor is not None]
        self._names: dict[int, str] = {}
        self._colours: dict[int, str] = {}
        if attractors is not None:
            index = catalog.place.index
            part = attractors if index is None else isel(attractors, dict(zip(dims_of(attractors), index, strict=True)))
            cast = cast_of(attractors, part)
            self._names, self._colours = cast.names, cast.colours
        taken = {self._colours[i] for i in ids}
        self._free = [colour for colour in COLOURS if colour not in taken] or [OTHERS]

    def lines(self) -> list[dict[str, Any]]:
        """Return the number, label, colour and attractor id of every catalog entry, sorted by number."""
        new = 0
        found: list[dict[str, Any]] = []
        for entry in sorted(list(self._catalog.entries), key=lambda e: e.number):
            colour = self._colour(entry, new)
            new += entry.attractor is None and entry.kind != ABSENT and entry.stability == ATTRACTS
            name = self.name(entry)
            again = sum(line["label"].partition(" #")[0] == name for line in found)
            found.append(
                {
                    "id": entry.number,
                    "label": f"{name} #{again + 1}" if again else name,
                    "colour": colour,
                    "attractor": entry.attractor,
                }
            )
        return found

    def line(self, entry: Entry) -> dict[str, Any]:
        """Return the number, label, colour and attractor id of one catalog entry."""
        return next(line for line in self.lines() if line["id"] == entry.number)

    def name(self, entry: Entry) -> str:
        """Return the name of a catalog entry, such as ``period 3``."""
        if entry.attractor is not None:
            return self._names[entry.attractor]
        if entry.status:
            return _status_word(entry.status)
        if entry.kind == EQUILIBRIUM:
            told = "at rest"
        elif entry.period:
            told = f"period {entry.period}"
        elif np.isfinite(entry.seconds):
            told = f"limit cycle ({entry.seconds:.4g} s)"
        else:
            told = "not periodic"
        motion = self.motion(entry.motion)
        text = ", ".join(filter(None, (told, motion, _shown(entry.stability))))
        return f"not among the run's: {text}" if self._known and entry.kind != ABSENT else text

    def motion(self, code: int) -> str:
        """Return the name of a class of motion from its code; an empty text if it has none."""
        classifier = self._model.classifier
        if classifier is None or not code or code in classifier.neutral:
            return ""
        return classifier.words[code]

    def _colour(self, entry: Entry, new: int) -> str:
        if entry.status:
            return rgb(GREYS.get(_status_word(entry.status), GREYS["failed"]))
        if entry.kind != ABSENT and entry.stability in GREY_OF:
            return rgb(GREY_OF[entry.stability])
        if entry.attractor is not None:
            return self._colours[entry.attractor]
        if entry.kind != ABSENT:
            return self._free[new % len(self._free)]
        motion = self.motion(entry.motion)
        # paler than any attractor's: a class of cells is none
        return (
            _pale(rgb(MOTION_COLOURS[(entry.motion - 1) % len(MOTION_COLOURS)]))
            if motion
            else rgb(GREYS["not settled"])
        )


def _status_word(status: int) -> str:
    if status in (Status.STEP_LIMIT, Status.STEP_UNDERFLOW, Status.UNREACHED):
        return "failed"
    return Status(status).name.lower().replace("_", " ")


def _shown(stability: int) -> str:
    return "" if stability in (0, ATTRACTS) else STABILITIES[stability].replace("_", " ")


def _pale(colour: str) -> str:
    parts = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return "#" + "".join(f"{(part + 2 * 235) // 3:02x}" for part in parts)


LOG = logging.getLogger(__name__)


CLOSING_S = PATIENCE_S + 2.0
"""Time that all jobs have to end when the run is closed [s]."""


def live_problem(run: RunDirectory) -> str | None:
    """Return the reason why trajectories of a run cannot be computed live; None if they can."""
    if problem := run.spec.motion.refusal("a live trajectory"):
        return f"{run.name}: {problem}"
    try:
        run.model.flow.system  # noqa: B018
    except (ParameterError, ImportError) as error:
        return str(error)
    return None


class Session(Protocol):
    """The methods that a run needs of its live sessions. A session is one open page that computes."""

    @property
    def is_over(self) -> bool:
        """Whether the session is closed and none of its jobs runs."""

    def close(self) -> None:
        """Cancel all jobs of the session."""

    def join(self, timeout: float) -> None:
        """Wait until the session has no running job, at most `timeout` seconds."""


class LiveRun:
    """A run for which `live_problem` has nothing to say, with the state that all its live sessions share."""

    def __init__(self, run: RunDirectory) -> None:
        most = 8
        problem = live_problem(run)
        if problem is not None:
            raise RequestError(problem)
        self.run, self.model, self.spec = ExploredRun.open(run), run.model, run.spec
        self.integration = run.spec.integration
        self.threads = max(1, min(os.cpu_count() or 1, most))
        self.pool = ThreadPoolExecutor(self.threads, "magpend-live")
        self.region_lock = threading.Lock()
        self._lock = threading.Lock()
        self._catalogs: OrderedDict[tuple[float, ...], Catalog] = OrderedDict()
        self._attractors: xr.Dataset | None = None
        self._sessions: set[Session] = set()
        self._warming = Warming(self)

    def close(self) -> None:
        """Cancel all jobs of all sessions, and wait until they have ended."""
        with self._lock:
            sessions = list(self._sessions)
        for session in sessions:
            session.close()
        until = time.monotonic() + CLOSING_S
        for session in sessions:
            session.join(max(0.0, until - time.monotonic()))
        self.pool.shutdown(wait=False, cancel_futures=True)

    def enter(self, session: Session) -> None:
        """Add a session, so that it is closed with the run."""
        with self._lock:
            self._sessions.add(session)

    def leave(self, session: Session) -> None:
        """Remove a session, and every other session that is over."""
        with self._lock:
            self._sessions = {s for s in self._sessions if s is not session and not s.is_over}

    def warm(self, tell: Callable[[int, int], None] | None = None) -> None:
        """Start to compile the code for live jobs in the background; `tell` is called with the progress."""
        self._warming.begin(tell)

    def is_warm(self, what: str) -> bool:
        """Return whether a step of the compilation is done: ``series``, ``sections``, ``maps`` or ``attractors``."""
        return self._warming.has_done(what)

    # ---- parameter points --------------------------------------------------------------------

    def place(self, values: Mapping[str, float], frequency: float | None) -> Place:
        """Return the parameter point for given values; the other values are those of the run.

        Raise RequestError or ParameterError if a name is unknown, or a value out of bounds.
        """
        parameters = self.spec.values.replace(**values)
        hertz = self._frequency(frequency)
        index = self._index(parameters, hertz)
        if index is not None:  # use the cube's exact value: the request may have lost the last digit
            for axis, i in zip(parameter_axes(self.spec), index, strict=True):
                if axis.parameter == FREQUENCY:
                    hertz = float(axis.values[i])
                else:
                    parameters = parameters.replace(**{axis.parameter: float(axis.values[i])})
        return Place(parameters, hertz, index)

    def _frequency(self, given: float | None) -> float:
        far = 10.0  # how many times higher or lower than the run's own a drive frequency may be
        if self.model.clock.hertz is not None:
            return self.model.clock.hertz
        axis = self.spec.axes.get(FREQUENCY)
        own = self.spec.frequency_hz
        if given is None:
            if own is None:
                raise RequestError(f"frequency: the run sweeps it; give one of {self.model.name}'s drive [Hz].")
            return own
        values = np.array([own]) if axis is None else axis.array()
        low, high = float(values.min()) / far, float(values.max()) * far
        if not low <= given <= high:
            raise RequestError(f"frequency = {given:g} Hz: must be from {low:g} to {high:g} Hz here.")
        return given

    def _index(self, parameters: Mapping[str, float], frequency: float) -> tuple[int, ...] | None:
        axes = parameter_axes(self.spec)
        swept = {axis.parameter for axis in axes}
        own = self.spec.values
        if any(not _same(parameters[n], own[n]) for n in own if n not in swept):
            return None
        fixed = self.spec.frequency_hz
        if FREQUENCY not in swept and fixed is not None and not _same(frequency, fixed):
            return None
        found = []
        for axis in axes:
            value = frequency if axis.parameter == FREQUENCY else parameters[axis.parameter]
            i = int(np.abs(axis.values - value).argmin())
            if not _same(value, float(axis.values[i])):
                return None
            found.append(i)
        return tuple(found)

    def state(self, values: Mapping[str, float], place: Place) -> np.ndarray:
        """Return an initial state from values by name, 0 for other states; raise RequestError for an unknown name."""
        names = self.model.state_names
        unknown = [name for name in values if name not in names]
        if unknown:
            known = ", ".join(names)
            raise RequestError(f"{unknown[0]!r} is no state of {self.model.name}; it has {known}.")
        state = np.array([float(values.get(name, 0.0)) for name in names])
        self.check_states(state[None], place)
        return state

    def check_states(self, states: np.ndarray, place: Place) -> None:
        """Raise SpecError if the model's equations are undefined at a state."""
        point = {**place.parameters, FREQUENCY: place.frequency}
        check_states(self.model.flow, states, [point])

    # ---- attractors --------------------------------------------------------------------------

    @property
    def attractors(self) -> xr.Dataset | None:
        """Attractors that an analysis of the run has stored; None if there are none."""
        with self._lock:
            if self._attractors is None:
                self._attractors = self.run.kept("attractors")
            return self._attractors

    def catalog(self, place: Place) -> Catalog:
        """Return the catalog of known attractors at a parameter point; each point has one catalog."""
        most = 64  # parameter points of which the attractors are remembered
        known = self._known(place)
        key = (float(known.attractors is not None), *place.key)
        with self._lock:
            found = self._catalogs.get(key)
        if found is None:
            found = Catalog(place, known, self.integration.closure_tolerance)
        with self._lock:
            found = self._catalogs.setdefault(key, found)
            self._catalogs.move_to_end(key)
            while len(self._catalogs) > most:
                self._catalogs.popitem(last=False)
        return found

    def _known(self, place: Place) -> Known:
        attractors = self.attractors
        if attractors is None or place.index is None:
            return Known(attractors)
        dims = [axis_name(name) for name in self.spec.axes]
        cells = self.cube.isel(dict(zip(dims, place.index, strict=True)))
        return Known(attractors, cells, place.index)

    @property
    def cube(self) -> xr.Dataset:
        """Result cube of the run, opened once."""
        return self.run.cube()

    def legend(self, catalog: Catalog) -> Legend:
        """Return the names and colours of the attractors of a catalog."""
        return Legend(catalog, self.attractors)

    def first_start(self) -> tuple[Place, np.ndarray]:
        """Return the parameter point and the initial state of the run's first cell."""
        cells = self.run.plan.cells
        block = tuple(slice(0, 1) if i != cells.path else slice(0, n) for i, n in enumerate(cells.shape))
        inputs = cells.inputs(block)
        values = dict(zip(self.spec.values.names, map(float, inputs.parameters[0, 0]), strict=True))
        frequency = None if self.model.clock.hertz is not None else float(inputs.frequency_hz[0, 0])
        return self.place(values, frequency), inputs.initial_states[0]


def _same(a: float, b: float) -> bool:
    rounding = 1e-12  # relative difference at which a value is that of the cube
    return abs(a - b) <= rounding * max(abs(a), abs(b))


class Warming:
    """Thread that compiles the code for live jobs in advance, so that the first job need not wait."""

    def __init__(self, live: LiveRun) -> None:
        self._live, self._lock = live, threading.Lock()
        self._thread: threading.Thread | None = None
        self._done, self._listeners = 0, list[Callable[[int, int], None]]()
        # the orbit behind a point is usually requested first
        self._steps = (self._series, self._sections, self._maps, self._attractors)

    def begin(self, tell: Callable[[int, int], None] | None) -> None:
        """Start to compile, unless this has begun already; call `tell` after every step."""
        with self._lock:
            if tell is not None and self._done < len(self._steps):
                self._listeners.append(tell)
            done, begun = self._done, self._thread is not None
            if not begun:
                self._thread = threading.Thread(target=self._run, name="magpend-warm", daemon=True)
                self._thread.start()
        if tell is not None:
            tell(done, len(self._steps))

    def has_done(self, what: str) -> bool:
        """Return whether a step of the compilation has ended, with or without success."""
        with self._lock:
            return f"_{what}" in [step.__name__ for step in self._steps[: self._done]]

    def _run(self) -> None:
        for step in self._steps:
            try:
                step()
            except Exception as error:  # the job that needs it will report the error
                LOG.info("warming: %s", error)
            with self._lock:
                self._done += 1
                listeners = list(self._listeners)
            for tell in listeners:
                tell(self._done, len(self._steps))
        with self._lock:
            self._listeners.clear()

    def _sections(self) -> None:
        live = self._live
        place, start = live.first_start()
        flight = LiveFlight(place, live.integration, start[None], lambda: None)
        flight.advance(1)
        if live.model.clock.has_equilibria:  # where it rests is told at its end
            newton_steps(live.model.system, start[None], place.parameters.pack())

    def _series(self) -> None:
        live = self._live
        place, start = live.first_start()
        rtol, atol = live.integration.rtol, live.integration.atol
        seconds = 0.01 / place.frequency if live.model.clock.is_continuous else 1.0
        orbit_series(place.parameters, place.frequency, start, 1, seconds, rtol=rtol, atol=atol)

    def _maps(self) -> None:
        place, start = self._live.first_start()
        packed, frequency = place.parameters.pack()[None], np.array([place.frequency])
        section_map(packed, frequency, start[None], 1, system=self._live.model.system)

    def _attractors(self) -> None:
        place, _ = self._live.first_start()
        self._live.catalog(place)
