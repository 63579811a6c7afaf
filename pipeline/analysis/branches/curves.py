"""Continue bifurcations that were located on branches, as curves in the plane of two parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import xarray as xr

from magpend_core.models.model import Model, Parameters
from pipeline.analysis.branches.arclength import Point, Settings, Trace, correct, kernel_of, trace
from pipeline.analysis.branches.bifurcations import KINDS, TORUS, multipliers_of
from pipeline.analysis.branches.following import opposite
from pipeline.analysis.branches.lockstep import Steps, run_together
from pipeline.analysis.branches.problems import FREQUENCY, TESTS, BifurcationProblem, Family
from pipeline.analysis.branches.units import parameter_units, state_units
from pipeline.layout.vocabulary import frequency_of

CURVE = Settings(first_step=2e-3, longest_step=0.02, max_points=400, tolerance=1e-8, max_iterations=8)
"""Settings with longer steps than on a branch, since nothing is located in between. The residual includes the
test function, and is limited by finite differences of monodromy matrices."""

CURVE_ENDS = ("bound", "closed", "resonance", "max_points", "stuck")


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve of bifurcations: its points, the reasons for both ends, the located point it started from."""

    family: Family
    kind: str
    points: list[Point]
    ends: tuple[str, str]
    start: int

    @property
    def values(self) -> np.ndarray:
        """Both parameters at the points, shape (n, 2)."""
        return np.array([self.family.values(p.u) for p in self.points])


def curves_from(
    branches: xr.Dataset,
    parameters: Parameters,
    second: str,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    max_period: int,
    settings: Settings = CURVE,
) -> list[Curve]:
    """Continue the bifurcations located on branches in a second parameter.

    Parameters
    ----------
    branches
        Result of `dataset_of`.
    parameters
        Parameters of the run; the value of `second` is that of the branches.
    second
        Name of the second parameter.
    bounds
        Interval of the branches' parameter, and that of the second.
    max_period
        Longest period of the orbits taken.
    settings
        Settings of the traces; arclengths are in units of the intervals.

    Returns
    -------
    list of Curve
        Curves in the order of the located points they start from, none twice.
    """
    return continue_curves(_starts(branches, parameters, second, bounds, max_period), bounds, settings)


CurveStart = tuple[int, Family, str, np.ndarray]
"""Number of a located point, its family with two free parameters, its kind, its unknowns."""


def continue_curves(
    starts: Sequence[CurveStart], bounds: tuple[tuple[float, float], tuple[float, float]], settings: Settings = CURVE
) -> list[Curve]:
    """Follow each start both ways until a bound, its own start, or a resonance; see `curves_from`."""
    problems = [BifurcationProblem(family, kind) for _, family, kind, _ in starts]
    firsts = run_together(
        [_first(problem, u, settings) for problem, (_, _, _, u) in zip(problems, starts, strict=True)]
    )
    found = [(s, p, f) for s, p, f in zip(starts, problems, firsts, strict=True) if f is not None]
    traces = run_together(
        [_follow(p, way, bounds, settings) for _, p, f in found for way in (opposite(f), f)], "following curves"
    )
    curves: list[Curve] = []
    for i, ((number, family, kind, _), _, first) in enumerate(found):
        back, ahead = traces[2 * i : 2 * i + 2]
        points = [opposite(p) for p in reversed(back.points)] + ahead.points[1:]
        if not any(_passes(curve, kind, family, first) for curve in curves):
            curves.append(Curve(family, kind, points, (back.end, ahead.end), number))
    return curves


def _starts(
    ds: xr.Dataset,
    parameters: Parameters,
    second: str,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    max_period: int,
) -> list[CurveStart]:
    """Return the located points with their two-parameter families and unknowns."""
    first = str(ds.attrs["parameter"])
    scales = tuple(high - low for low, high in bounds)
    found = []
    for k in range(ds.sizes["bifurcation"]):
        branch = int(ds["of_branch"][k])
        period, kind = int(ds["orbit_period"][branch]), KINDS[int(ds["kind"][k])]
        if not 0 < period <= max_period or kind not in TESTS:
            continue
        own = parameters.replace(**{n: float(ds[n][branch]) for n in parameters.names if n in ds})
        frequency = float(ds[FREQUENCY][branch]) if FREQUENCY in ds else frequency_of(parameters.model, {})
        family = Family(parameters.model.system, period, frequency, own.pack(), (first, second), (scales[0], scales[1]))
        here = frequency if second == FREQUENCY else own[second]
        state = np.asarray(ds["bifurcation_section"].values[k, 0])
        found.append((k, family, kind, family.unknowns(state, [float(ds["value"][k]), here])))
    return found


def _first(problem: BifurcationProblem, u: np.ndarray, settings: Settings) -> Steps[Point | None]:
    normal = np.zeros(problem.size)
    normal[-1] = 1.0
    found = yield from correct(problem, u, normal, settings)
    if found is None:
        return None
    tangent = kernel_of(found.value)
    return replace(found, tangent=tangent * (1.0 if tangent[-1] >= 0.0 else -1.0))


def _follow(
    problem: BifurcationProblem,
    start: Point,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    settings: Settings,
) -> Steps[Trace]:
    """Follow a curve one way, and drop the point beyond a bound."""

    def stop(points: list[Point]) -> str:
        here = points[-1]
        values = problem.family.values(here.u)
        if any(not low <= v <= high for v, (low, high) in zip(values, bounds, strict=True)):
            return "bound"
        if problem.kind == TORUS and not _has_torus(here):
            return "resonance"
        step = np.linalg.norm(here.u - points[-2].u)
        if len(points) > 5 and np.linalg.norm(here.u - points[0].u) < 0.7 * step:
            return "closed"
        return ""

    found = yield from trace(problem, start, settings, stop, _anything)
    if found.end in ("bound", "resonance"):
        found.points.pop()
    return found


def _anything(a: Point, b: Point) -> Steps[bool]:
    return True
    yield  # a computation that asks for nothing


def _has_torus(point: Point) -> bool:
    multipliers = multipliers_of(point)
    pairs = multipliers[multipliers.imag > 0.0]
    return bool(len(pairs)) and bool(np.abs(np.abs(pairs) - 1.0).min() < 1e-4)


def _passes(curve: Curve, kind: str, family: Family, start: Point) -> bool:
    """Return whether a curve passes through a start, within the accuracy of its chords."""
    if curve.kind != kind or curve.family.period != family.period:
        return False
    u = np.array([p.u for p in curve.points])
    for a, b in pairwise(u):
        chord = b - a
        length = float(np.linalg.norm(chord))
        offset = np.append(family.mismatch(a, family.state(start.u)), start.u[-2:] - a[-2:])
        share = float(offset @ chord) / length**2
        if -0.01 <= share <= 1.01 and np.linalg.norm(offset - share * chord) < 0.02 * length + 1e-6:
            return True
    return False


def curves_dataset(curves: Sequence[Curve], first: str, second: str, model: Model | None = None) -> xr.Dataset:
    """Return curves as a dataset: dims ``curve``, ``point`` (NaN beyond a curve's own) and ``state``.

    Parameters
    ----------
    curves
        From `curves_from`; if there are none, so are the dataset's.
    first, second
        Names of the two parameters.
    model
        Tells names and units.
    """
    names = curves[0].family.system.state_names if curves else (model.state_names if model else ())
    n = max((len(c.points) for c in curves), default=0)
    values = np.full((len(curves), n, 2), np.nan)
    section = np.full((len(curves), n, len(names)), np.nan)
    residual = np.full((len(curves), n), np.nan)
    for i, curve in enumerate(curves):
        values[i, : len(curve.points)] = curve.values
        section[i, : len(curve.points)] = [curve.family.state(p.u) for p in curve.points]
        residual[i, : len(curve.points)] = [p.residual for p in curve.points]
    kinds = {"flag_values": np.arange(len(KINDS), dtype=np.int8), "flag_meanings": " ".join(KINDS)}
    ends = {"flag_values": np.arange(len(CURVE_ENDS), dtype=np.int8), "flag_meanings": " ".join(CURVE_ENDS)}
    dims = ("curve", "point")
    one, units = {"units": "1"}, state_units(model)

    def codes(i: int) -> np.ndarray:
        return np.array([CURVE_ENDS.index(c.ends[i]) for c in curves], np.int8)

    def numbers(values: list[int]) -> np.ndarray:
        return np.array(values, np.int32)

    return xr.Dataset(
        {
            "first": (dims, values[..., 0], {"units": parameter_units(first, model), "long_name": first}),
            "second": (dims, values[..., 1], {"units": parameter_units(second, model), "long_name": second}),
            "section": ((*dims, "state"), section, {"units": units, "long_name": "a section point"}),
            "residual": (dims, residual, {**one, "long_name": "largest residual, test function included"}),
            "kind": ("curve", np.array([KINDS.index(c.kind) for c in curves], np.int8), {**one, **kinds}),
            "orbit_period": ("curve", numbers([c.family.period for c in curves]), one),
            "start": ("curve", numbers([c.start for c in curves]), {**one, "long_name": "located point"}),
            "n_points": ("curve", numbers([len(c.points) for c in curves]), one),
            "first_end": ("curve", codes(0), {**one, **ends}),
            "last_end": ("curve", codes(1), {**one, **ends}),
        },
        coords={"state": list(names)},
        attrs={"first_parameter": first, "second_parameter": second},
    )
