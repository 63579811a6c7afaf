"""Define the analyses ``manifolds`` and ``tangency`` (homoclinic tangencies) of a run.

The first tangency: over one generation of the unstable manifold, the signed distance of its points from the stable
manifold is computed. All of them lie on one side as long as the manifolds do not touch. The least distance, with the
sign that it has before, changes its sign at the tangency, which is located by Brent's method.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from itertools import product

import numpy as np
import xarray as xr
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq, minimize_scalar

from magpend_core.models.model import Parameters
from magpend_core.orbits import polish_orbits
from pipeline.analysis.branches.declaration import OrbitOptions
from pipeline.analysis.branches.orbit_search import needs_point, point_of
from pipeline.analysis.branches.starting_orbits import parameters_at
from pipeline.analysis.manifolds.declaration import ManifoldOptions, TangencyOptions
from pipeline.analysis.manifolds.growing import Manifold, Resolution, Saddle, stable_manifold, unstable_manifold
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import (
    FREQUENCY_DIM,
    axis_name,
    model_attribute,
    parameter_name,
    parameters_of,
    section_attributes,
)
from pipeline.products.product import Table
from pipeline.products.reporting import track
from pipeline.results.run import OpenRun
from pipeline.results.tabular import Row, aligned, counted, header_of

ENDS = ("length", "most", "generations", "lost")

SIDES = (1.0, -1.0)


FINE = Resolution(chord=0.01, length=6.0)
"""Resolution at which splines through the points are accurate to 1e-8 of the scales."""


Side = tuple[int, bool, float]
"""A manifold's side: the number of its orbit, whether it is the stable one, and its direction."""


def sides(run: OpenRun, options: ManifoldOptions) -> list[Side]:
    """Return the sides that are curves of the manifolds of the saddle orbits that the analysis ``orbits`` finds."""
    return [
        (number, stable, side)
        for number, saddle in _saddles(run, options).items()
        for stable in (False, True)
        if _is_curve(saddle, stable)
        for side in SIDES
    ]


def manifolds(run: OpenRun, options: ManifoldOptions, asked: Sequence[Side]) -> xr.Dataset:
    """Grow sides of the manifolds of saddle orbits."""
    saddles = _saddles(run, options, {number for number, *_ in asked})
    resolution = Resolution(options.chord, options.length, options.most)
    curves = [
        (
            number,
            saddles[number],
            side,
            (stable_manifold if stable else unstable_manifold)(saddles[number], side, resolution),
        )
        for number, stable, side in track(asked, "growing manifolds")
    ]
    return _dataset(curves, parameters_of(run.cube()))


def _saddles(run: OpenRun, options: OrbitOptions, wanted: Collection[int] | None = None) -> dict[int, Saddle]:
    """Refine the saddle orbits that the analysis ``orbits`` finds, all or those with the wanted numbers."""
    base, found = parameters_of(run.cube()), run.derive("orbits", **options.part(OrbitOptions))
    frequency_hz, packed = parameters_at(point_of(run.cube(), options), base)
    saddles = {}
    for number in range(found.sizes["orbit"]) if wanted is None else sorted(wanted):
        one = found.isel(orbit=number)
        multipliers = np.hypot(one["multiplier_real"].values, one["multiplier_imag"].values)
        if not (multipliers > 1.0).any() or not ((multipliers < 1.0) & (multipliers > 0.0)).any():
            continue
        saddle = _saddle(base, frequency_hz, packed, one["section"].values[0], int(one["orbit_period"]))
        if saddle is not None:
            saddles[number] = saddle
    return saddles


def _saddle(base: Parameters, frequency_hz: float, packed: np.ndarray, state: np.ndarray, period: int) -> Saddle | None:
    """Refine a saddle orbit from a section point; None if Newton's method finds no orbit of this period."""
    system = base.model.system
    orbit = polish_orbits(packed[None], np.array([frequency_hz]), state[None], np.array([period]), system=system)
    if not orbit.converged[0] or orbit.orbit_period[0] != period:
        return None
    return Saddle(system, frequency_hz, packed, orbit.section[0], period, orbit.derivative[0])


def _is_curve(saddle: Saddle, stable: bool) -> bool:
    try:
        saddle.direction(stable)
    except ValueError:
        return False
    return True


def _dataset(curves: list[tuple[int, Saddle, float, Manifold]], base: Parameters) -> xr.Dataset:
    system, model = base.model.system, base.model
    n = max((len(curve.points) for *_, curve in curves), default=0)
    points, times = np.full((len(curves), n, system.n_states), np.nan), np.full((len(curves), n), np.nan)
    for i, (*_, curve) in enumerate(curves):
        points[i, : len(curve.points)], times[i, : len(curve.points)] = curve.points, curve.time

    ends = np.array([ENDS.index(c.end) for *_, c in curves], np.int8)
    return xr.Dataset(
        {
            "section": (("curve", "point", "state"), points),
            "generation": (("curve", "point"), times),
            "n_points": ("curve", np.array([len(c.points) for *_, c in curves], np.int32)),
            "stable": ("curve", np.array([c.stable for *_, c in curves], np.int8)),
            "direction": ("curve", np.array([side for _, _, side, _ in curves], np.int8)),
            "orbit": ("curve", np.array([number for number, *_ in curves], np.int32)),
            "orbit_period": ("curve", np.array([saddle.period for _, saddle, *_ in curves], np.int32)),
            "end": ("curve", ends, code_flags(ENDS)),
        },
        coords={"state": list(system.state_names)},
        attrs={"model": model_attribute(model), **section_attributes(model.crossing)},
    )


def manifolds_table(ds: xr.Dataset) -> Table:
    """Return the table of manifolds. Each row has the orbit, the kind, the side, the number of points and the reason
    for the end.
    """
    rows: list[Row] = [
        {
            "orbit": int(one["orbit"]),
            "period": int(one["orbit_period"]),
            "manifold": "stable" if int(one["stable"]) else "unstable",
            "direction": int(one["direction"]),
            "n_points": int(one["n_points"]),
            "generations": float(np.nanmax(one["generation"].values)),
            "end": ENDS[int(one["end"])],
        }
        for one in (ds.isel(curve=i) for i in range(ds.sizes["curve"]))
    ]
    words = [{k: f"{v:.2f}" if isinstance(v, float) else str(v) for k, v in row.items()} for row in rows]
    nothing = "" if rows else "no saddle orbit with a manifold that is a curve; see `magpend analyse orbits`."
    return Table(rows, [counted(len(rows), "curve"), "", *aligned(words, "")], nothing)


# ---- tangencies --------------------------------------------------------------------------------


def needs_tangency(run: OpenRun, options: TangencyOptions) -> None:
    """Raise ValueError if tangencies cannot be searched along the chosen parameter from the chosen parameter point."""
    from pipeline.specification.problems import unknown_name

    needs_point(run, options)
    base = parameters_of(run.cube())
    if axis_name(options.parameter) != FREQUENCY_DIM and options.parameter not in base.names:
        raise ValueError(unknown_name("parameter", options.parameter, (*base.names, FREQUENCY_DIM)))
    if not options.low < options.high:
        raise ValueError(f"the interval {options.low:g} to {options.high:g} is empty; --from must be less than --to.")
    n_states = base.model.system.n_states
    if n_states != 2:
        raise ValueError(f"{base.model.name} has {n_states} states; tangencies are located for two.")


Pair = tuple[int, float, float]
"""Number of a saddle orbit, with the sides of its unstable and of its stable manifold."""


def pairs_of_sides(run: OpenRun, options: TangencyOptions) -> list[Pair]:
    """Return all pairs of sides of the manifolds of saddle orbits of which both are curves."""
    saddles = _saddles(run, options)
    whole = [number for number, one in saddles.items() if _is_curve(one, True) and _is_curve(one, False)]
    return list(product(whole, SIDES, SIDES))


def tangency(run: OpenRun, options: TangencyOptions, pairs: Sequence[Pair]) -> xr.Dataset:
    """Locate the parameter value at which each unstable manifold of a saddle orbit first touches a stable one of it."""
    base, saddles = parameters_of(run.cube()), _saddles(run, options, {number for number, *_ in pairs})
    resolution = Resolution(options.chord, options.length)
    rows = []
    for number, one, other in track(pairs, "locating tangencies"):
        at = _followed(saddles[number], base, axis_name(options.parameter), options)
        try:
            value, why = first_tangency(at, options.low, options.high, (one, other), resolution), ""
        except ValueError as problem:
            value, why = np.nan, str(problem)
        rows.append((number, saddles[number].period, one, other, value, why))
    names = ("orbit", "orbit_period", "unstable_side", "stable_side", "value", "why_not")
    columns = zip(*rows, strict=True) if rows else ([] for _ in names)
    return xr.Dataset(
        {name: ("tangency", np.array(list(values))) for name, values in zip(names, columns, strict=True)},
        attrs={"parameter": axis_name(options.parameter), "model": model_attribute(base.model)},
    )


def _followed(saddle: Saddle, base: Parameters, parameter: str, options: TangencyOptions) -> Callable[[float], Saddle]:
    """Return a function that computes the saddle orbit at any parameter value, from the nearest value already
    computed.
    """
    here = saddle.frequency_hz if parameter == FREQUENCY_DIM else saddle.packed[base.names.index(parameter)]
    known = {float(here): saddle}
    step = (options.high - options.low) / 8.0

    def at(value: float) -> Saddle:
        while value not in known:
            nearest = min(known, key=lambda other: abs(other - value))
            target = value if abs(value - nearest) <= step else nearest + np.sign(value - nearest) * step
            packed, frequency = saddle.packed.copy(), saddle.frequency_hz
            if parameter == FREQUENCY_DIM:
                frequency = target
            else:
                packed[base.names.index(parameter)] = target
            found = _saddle(base, frequency, packed, known[nearest].state, saddle.period)
            if found is None:
                raise ValueError(f"the orbit cannot be followed to {parameter_name(parameter)} = {target:g}.")
            known[float(target)] = found
        return known[value]

    return at


def tangency_table(ds: xr.Dataset) -> Table:
    """Return the table of first homoclinic tangencies, with a text line for each pair of manifolds without one."""
    name = parameter_name(str(ds.attrs["parameter"]))

    def row_of(one: xr.Dataset) -> Row:
        sides = {side: int(one[side]) for side in ("unstable_side", "stable_side")}
        return {"orbit": int(one["orbit"]), "period": int(one["orbit_period"]), **sides, name: float(one["value"])}

    ones = [ds.isel(tangency=i) for i in range(ds.sizes["tangency"])]
    every = [{**row_of(one), "why_not": str(one["why_not"].values)} for one in ones]
    rows = [row_of(one) for one in ones if not str(one["why_not"].values)]
    words = [{k: f"{v:.8f}" if isinstance(v, float) else str(v) for k, v in row.items()} for row in rows]
    lines = [f"{len(rows)} first homoclinic tangencies along {name}", "", *aligned(words, "")]
    for row in every:
        if row["why_not"]:
            sides = f"sides {row['unstable_side']:+d}, {row['stable_side']:+d}"
            lines.append(f"orbit {row['orbit']}, {sides}: none, {row['why_not']}")
    nothing = "" if every else "no saddle orbit with two manifolds that are curves."
    return Table(rows, lines, nothing, header=header_of(ds, "tangency", row_of))


def first_tangency(
    saddle_at: Callable[[float], Saddle],
    low: float,
    high: float,
    sides: tuple[float, float],
    resolution: Resolution = FINE,
    tolerance: float = 1e-8,
) -> float:
    """Locate the parameter value at which the unstable and the stable manifold of a saddle orbit first touch, on one
    side of each.

    Parameters
    ----------
    saddle_at
        Returns the saddle orbit at a value of the parameter.
    low, high
        Values between which the manifolds begin to touch, in either order of sides.
    sides
        Sides of the unstable and of the stable manifold: 1 or -1, by the sign of the eigenvectors' first component.
    resolution
        Resolution of both manifolds; they must be long enough to meet.
    tolerance
        Absolute tolerance of the value.

    Raises
    ------
    ValueError
        If the section map has not two states, or the manifolds are apart, or cross, at both values.
    """
    ends = {value: gap(saddle_at(value), sides, resolution) for value in (low, high)}
    apart = [value for value in (low, high) if ends[value][0] * ends[value][1] > 0.0]
    if len(apart) != 1:
        state = "are apart" if apart else "cross"
        raise ValueError(
            f"the manifolds {state} at both {low:g} and {high:g}; the first tangency lies between a value at which "
            "they are apart and one at which they cross."
        )
    sign = float(np.sign(ends[apart[0]][0]))

    def least(value: float) -> float:
        smallest, largest = ends[value] if value in ends else gap(saddle_at(value), sides, resolution)
        return smallest if sign > 0.0 else -largest

    return float(brentq(least, low, high, xtol=tolerance))


def gap(saddle: Saddle, sides: tuple[float, float], resolution: Resolution = FINE) -> tuple[float, float]:
    """Compute the least and the largest signed distance from the stable manifold along a piece of the unstable
    manifold.

    Both have one sign if the manifolds are apart, and two if they cross.
    """
    if len(saddle.scales) != 2:
        raise ValueError(f"the section map has {len(saddle.scales)} states; tangencies are located for two.")
    unstable = unstable_manifold(saddle, _oriented(saddle, sides[0], False), resolution)
    stable = stable_manifold(saddle, _oriented(saddle, sides[1], True), resolution)
    return _extremes(unstable, stable, saddle)


def _oriented(saddle: Saddle, side: float, stable: bool) -> float:
    """Return the sign of a saddle's eigenvector for which side 1 points to larger values of the first state."""
    _, vector = saddle.direction(stable)
    return side * float(np.sign(vector[0]))


def _extremes(unstable: Manifold, stable: Manifold, saddle: Saddle) -> tuple[float, float]:
    curve, target = _Line(unstable.points / saddle.scales), _Line(stable.points / saddle.scales)
    away = np.linalg.norm((unstable.points - saddle.state) / saddle.scales, axis=1)
    far = _first_maximum(away)
    domain = np.flatnonzero(np.abs(unstable.time - unstable.time[far]) <= 0.5)
    distances = np.array([target.signed_distance(point) for point in curve.points[domain]])

    def at(place: float) -> float:
        return target.signed_distance(curve.spline(place))

    found = []
    for sign in (1.0, -1.0):
        k = int(np.argmin(sign * distances))
        low, high = curve.places[domain[max(k - 1, 0)]], curve.places[domain[min(k + 1, len(domain) - 1)]]
        best = minimize_scalar(lambda place, sign=sign: sign * at(place), bounds=(low, high), method="bounded")
        found.append(sign * min(float(best.fun), float(sign * distances[k])))
    return found[0], found[1]


def _first_maximum(values: np.ndarray) -> int:
    """Return the index of the first maximum of distances along the unstable manifold, where the manifold first turns
    back.
    """
    falling = np.flatnonzero(np.diff(values) < 0.0)
    if not len(falling):
        raise ValueError("the unstable manifold does not turn back; it needs a greater length.")
    return int(falling[0])


class _Line:
    """Cubic spline through points (n, 2), as a function of the length along their chords."""

    def __init__(self, points: np.ndarray) -> None:
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        kept = np.concatenate([[True], steps > 0.0])
        self.points = points
        self.places = np.concatenate([[0.0], np.cumsum(steps)])
        self.spline = CubicSpline(self.places[kept], points[kept])
        self.slope, self.bend = self.spline.derivative(), self.spline.derivative(2)

    def signed_distance(self, point: np.ndarray) -> float:
        """Return the distance of a point from the spline, positive on the left of its direction."""
        k = int(np.argmin(((self.points - point) ** 2).sum(axis=1)))
        place = self.places[k]
        for _ in range(20):
            away, tangent = point - self.spline(place), self.slope(place)
            step = float(away @ tangent / max(tangent @ tangent - away @ self.bend(place), 0.1 * tangent @ tangent))
            place = float(np.clip(place + step, self.places[0], self.places[-1]))
            if abs(step) < 1e-12:
                break
        away, tangent = point - self.spline(place), self.slope(place)
        return float((tangent[0] * away[1] - tangent[1] * away[0]) / np.linalg.norm(tangent))
