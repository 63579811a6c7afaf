"""Follow a periodic orbit, stable or not, while the user drags a parameter.

The orbit is a fixed point of the stroboscopic or return map. From one value of the parameter to the next it
is predicted along its tangent and corrected by Newton's method at that value
(`branches.arclength.correct`); a step that fails is halved. At a fold the orbit turns back, so that beyond
it there is none: it is lost. What goes round folds is `magpend analyse branches`.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from magpend_core.orbits import orbit_exponents
from magpend_core.status import Status
from pipeline.analysis.attractors import features
from pipeline.analysis.branches.arclength import Point, Settings, correct
from pipeline.analysis.branches.lockstep import run_alone
from pipeline.analysis.branches.problems import FREQUENCY, Family, OrbitProblem
from pipeline.explorer import RequestError
from pipeline.explorer.data.orbits import attractor_of, fixed_points, orbit_series, parts_of
from pipeline.explorer.live.jobs import Job
from pipeline.explorer.live.messages import CellPoint, FollowRequest
from pipeline.explorer.live.settling import Place, system_at
from pipeline.layout.cells import parameter_axes
from pipeline.layout.vocabulary import PERIODIC_ORBIT, axes_of, axis_name
from pipeline.specification.tables import EXPLICIT, STIFF

if TYPE_CHECKING:
    from pipeline.explorer.live.live import LiveRun


@dataclass(frozen=True)
class FollowSettings:
    """Numbers of following an orbit while a user waits."""

    most_seconds: float = 3.0  # time for one answer [s]; then the orbit is shown as far as it was followed
    # steps of the parameter, in units of its scale; longer ones are faster, and lose orbits that turn
    first_step: float = 0.01
    longest_step: float = 0.05
    shortest_step: float = 1e-6
    longest_move: float = 0.3  # largest change of a state in a step, in units of its scale; a longer one is halved
    # largest angle between the tangents at the ends of a step [rad]: what turns more may be another orbit
    largest_turn: float = 0.3
    near_one: float = 0.15  # distance of a multiplier from 1 at which an orbit that ends has come to a fold
    halved: float = 1e-6  # scaled distance between the halves of an orbit below which they are one


NEWTON = Settings(max_iterations=6, tolerance=1e-9)


@dataclass(frozen=True, eq=False)
class Held:
    """A periodic orbit that a page can refer to: its parameter point, its period and a section point."""

    place: Place
    period: int  # drive periods or returns
    state: np.ndarray  # a section point


@dataclass(frozen=True, eq=False)
class Reached:
    """Result of following an orbit: the parameter value and the orbit that were reached, and why it went no further."""

    value: float  # parameter value that was reached
    point: Point  # the orbit at this value
    sentence: str  # why no farther; empty if it was followed to the value wanted
    lost: bool  # whether there is none beyond, rather than no time


class Follower:
    """Handles a session's requests to follow orbits, and remembers the orbits it has found."""

    def __init__(self, live: LiveRun) -> None:
        self._live, self._lock = live, threading.Lock()
        self._held: OrderedDict[int, Held] = OrderedDict()
        self._next = 0

    def follow(self, job: Job) -> None:
        """Follow the orbit that a job names to another parameter value, and send the orbit that was reached."""
        request = job.request
        assert isinstance(request, FollowRequest)
        if self._live.model.clock.n_neutral:
            raise RequestError(
                f"{self._live.model.name} is a flow seen at even times, where orbits are no points; make a "
                "run with a [section] to follow them."
            )
        held = self._origin(request)
        name = self._name(request.parameter)
        target = self._place_at(held.place, name, request.value)
        family = self._family(held, name, request.value)
        found = _followed(family, held.state, _value(held.place, name), request.value, job)
        value = found.value if found.sentence else request.value
        place = self._place_at(held.place, name, value) if found.sentence else target
        number = self._keep(Held(place, held.period, family.state(found.point.u)))
        arrays, attrs = described(self._live, place, family, found.point)
        job.show(
            "orbit",
            arrays,
            **attrs,
            parameter=request.parameter,
            value=value,
            wanted=request.value,
            lost=found.lost,
            sentence=found.sentence or None,
            orbit=number,
        )

    def _keep(self, held: Held) -> int:
        most = 256  # orbits that a session remembers
        with self._lock:
            number, self._next = self._next, self._next + 1
            self._held[number] = held
            while len(self._held) > most:
                self._held.popitem(last=False)
            return number

    def _origin(self, request: FollowRequest) -> Held:
        origin = request.origin
        if isinstance(origin, CellPoint):
            return cell_orbit(self._live, origin.cell, origin.point)
        with self._lock:
            held = self._held.get(origin.orbit)
        if held is None:
            raise RequestError(f"from.orbit = {origin.orbit}: is no orbit of this page, or one of long ago.")
        return held

    def _name(self, given: str) -> str:
        name = axis_name(given)
        model = self._live.model
        if name not in axes_of(model):
            known = ", ".join(model.parameter_names)
            raise RequestError(f"parameter: {given!r} is no parameter of {model.name}; it has {known}.")
        return name

    def _place_at(self, place: Place, name: str, value: float) -> Place:
        if name == FREQUENCY:
            return self._live.place(place.parameters, value)
        frequency = None if self._live.model.clock.hertz is not None else place.frequency
        return self._live.place({**place.parameters, name: value}, frequency)

    def _family(self, held: Held, name: str, target: float) -> Family:
        place = held.place
        axis = next((a for a in parameter_axes(self._live.spec) if axis_name(a.parameter) == name), None)
        here = _value(place, name)
        scale = max(abs(here), abs(target - here), 1e-9)
        if axis is not None and len(axis.values) > 1:
            scale = float(np.ptp(axis.values))
        own = self._live.integration
        method = STIFF if own.method == STIFF else EXPLICIT  # steps of order 8 are not sampled
        return Family(
            system_at(place, own.model_copy(update={"method": method})),
            held.period,
            place.frequency,
            place.parameters.pack(),
            (name,),
            (scale,),
        )


def _value(place: Place, name: str) -> float:
    return place.frequency if name == FREQUENCY else place.parameters[name]


def cell_orbit(live: LiveRun, cell: int, point: int) -> Held:
    """Return the periodic orbit of a cell: its parameter point, its period and one of its stored section points.

    Raise RequestError if there is no such cell or point, or the cell is on no closed orbit.
    """
    status = live.cube["status"]
    if cell >= status.size:
        raise RequestError(f"from.cell = {cell}: the cube has {status.size} cells.")
    at = dict(zip(map(str, status.dims), map(int, np.unravel_index(cell, status.shape)), strict=True))
    one = live.cube.isel(at)
    section = one["section"].transpose("period_index", "state").values
    if point >= len(section):
        raise RequestError(f"from.point = {point}: a cell has {len(section)} sections.")
    dims = [axis_name(name) for name in live.spec.axes]
    values = {n: float(live.cube[d].values[at[d]]) for n, d in zip(live.spec.axes, dims, strict=True)}
    frequency = values.pop(next((n for n in values if axis_name(n) == FREQUENCY), ""), None)
    place = live.place(values, frequency)
    if not np.isfinite(section[point]).all():
        word = Status(int(one["status"].values)).sentence
        raise RequestError(f"cell {cell} has no orbit to follow: {word}.")
    period = int(one["orbit_period"].values) or _period_of_attractor(live, at)
    if not period:
        raise RequestError(
            f"cell {cell} has no orbit to follow: its sections close on none; take a point of a periodic motion."
        )
    return Held(place, period, section[point])


def _period_of_attractor(live: LiveRun, at: Mapping[str, int]) -> int:
    """Return the period of the stored attractor on which a cell ends; 0 if that is no periodic orbit."""
    here = attractor_of(live.attractors, at)
    return 0 if here is None or int(here["kind"]) != PERIODIC_ORBIT else int(here["orbit_period"])


def _followed(
    family: Family,
    state: np.ndarray,
    begin: float,
    target: float,
    job: Job,
    settings: FollowSettings = FollowSettings(),
) -> Reached:
    """Follow a periodic orbit from one parameter value towards another, as far as the orbit exists and time allows."""
    problem, scale = OrbitProblem(family), family.scales[0]
    normal = np.zeros(problem.size)
    normal[-1] = 1.0
    here = run_alone(correct(problem, family.unknowns(state, [begin]), normal, NEWTON))
    if here is None:
        raise RequestError("the point is too far from a closed orbit for Newton's method to find one.")
    until, step = time.perf_counter() + settings.most_seconds, settings.first_step
    goal = target / scale
    while here.u[-1] != goal:
        job.check()
        if time.perf_counter() > until:
            reached = float(here.u[-1] * scale)
            return Reached(reached, here, f"followed to {reached:.6g} in the time; ask again to go on.", False)
        left = goal - here.u[-1]
        move = left if abs(left) <= step else np.copysign(step, left)
        there = _step(problem, here, move, normal, settings)
        if there is None:
            step = 0.5 * abs(move)
            if step < settings.shortest_step:
                return Reached(float(here.u[-1] * scale), here, _why(here, family, target, settings), True)
            continue
        if move == left:
            there.u[-1] = goal
        here, step = there, min(1.5 * step, settings.longest_step) if there.n_iterations <= 3 else step
    return Reached(target, here, "", False)


def _step(
    problem: OrbitProblem, here: Point, move: float, normal: np.ndarray, settings: FollowSettings
) -> Point | None:
    """Follow an orbit over one step `move` of the parameter; None if it cannot be followed that far."""
    slope = here.tangent / here.tangent[-1] if abs(here.tangent[-1]) > 1e-6 else normal
    ahead = move * slope
    if np.abs(ahead[:-1]).max(initial=0.0) > settings.longest_move:
        return None
    there = run_alone(correct(problem, here.u + ahead, normal, NEWTON))
    if there is None:
        return None
    corrected = np.abs((there.u - here.u - ahead)[:-1]).max(initial=0.0)
    turned = float(here.tangent @ there.tangent) < np.cos(settings.largest_turn)
    if corrected > 0.5 * np.abs(ahead).max() or turned or _has_halved(problem.family, there, settings):
        return None
    return there


def _has_halved(family: Family, point: Point, settings: FollowSettings) -> bool:
    if family.period % 2:
        return False
    half = family.mismatch(point.u, point.value.images[family.period // 2 - 1])
    return bool(np.abs(half).max() < settings.halved)


def _why(point: Point, family: Family, target: float, settings: FollowSettings) -> str:
    value = float(point.u[-1] * family.scales[0])
    multipliers = np.linalg.eigvals(point.value.monodromy)
    name = family.free[0]
    if np.abs(multipliers - 1.0).min() < settings.near_one:
        half = ", or joins that of half its period" if family.period % 2 == 0 else ""
        return (
            f"lost at {name} = {value:.7g} on the way to {target:.6g}: a multiplier is near 1, as at a fold, "
            f"where an orbit turns back{half}."
        )
    return f"lost at {name} = {value:.7g} on the way to {target:.6g}: Newton's method finds no orbit beyond."


def described(
    live: LiveRun, place: Place, family: Family, point: Point
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return a followed orbit for the page, with its multipliers, stability and exponents."""
    model, has_returns = live.model, live.model.crossing is not None
    seconds = point.value.seconds
    images = point.value.images
    clock = family.period / seconds if has_returns else place.frequency
    arrays = orbit_series(place.parameters, clock, images[-1], family.period, seconds)
    arrays["section"] = np.ascontiguousarray(images)
    angles = np.flatnonzero(model.is_angle)
    turned = (arrays["states"][-1] - arrays["states"][0])[angles]
    turns = np.round(turned / (2.0 * np.pi)).astype(np.int64)
    multipliers = np.linalg.eigvals(point.value.monodromy)
    multipliers = multipliers[np.argsort(-np.abs(multipliers), kind="stable")]
    code = int(features.sides_of(images[None], turns[None], place.frequency, place.parameters)[0])
    words = model.classifier.words if model.classifier is not None else ()
    known = bool(words and code)
    attrs: dict[str, Any] = {
        "cell": None,
        "parameters": {k: v for k, v in place.parameters.items()},
        "frequency": place.frequency if model.clock.hertz is None else None,
        "status": Status.PERIODIC.name.lower(),
        "period": family.period,
        "seconds": seconds,
        "motion": words[code] if known else None,
        "attractor": None,
        "share": None,
        "stable": bool(np.abs(multipliers).max() < 1.0),
        "multipliers": parts_of(multipliers),
        "exponents": [float(x) for x in orbit_exponents(multipliers, seconds, has_returns)],
        "seeds": [],
        "at": None,
        "start": None,
        "fixed": fixed_points(model.flow, place.parameters),
    }
    return arrays, attrs


__all__ = ["Follower", "cell_orbit", "described"]
