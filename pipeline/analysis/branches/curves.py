"""Continue bifurcations that were located on branches, as curves in the plane of two parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Model, Parameters
from pipeline.analysis.branches.arclength import Point, Settings, Trace, correct, crawls, kernel_of, trace
from pipeline.analysis.branches.bifurcations import has_torus
from pipeline.analysis.branches.center_manifold import null_vectors
from pipeline.analysis.branches.codimension_two import (
    BT,
    CHENCINER,
    DEGENERATE,
    DOUBLE_HOPF,
    DOUBLE_TORUS,
    DOUBLING_TORUS,
    FOLD_FLIP,
    FOLD_TORUS,
    GENERALISED,
    GENERALISED_HOPF,
    NONCENTRAL,
    POINT_KINDS,
    R1,
    R2,
    R3,
    R4,
    ZERO_HOPF,
    Detector,
    SpecialPoint,
    merged,
)
from pipeline.analysis.branches.dataset import Columns, column, filled
from pipeline.analysis.branches.equilibrium_curves import (
    EquilibriumCurve,
    EquilibriumDetector,
    frequencies_at,
    kind_of_zero,
)
from pipeline.analysis.branches.exploring import cycle_direction, cycle_family
from pipeline.analysis.branches.following import end_of_crossings, has_halved, opposite
from pipeline.analysis.branches.homoclinic import Loop
from pipeline.analysis.branches.homoclinic_curves import (
    HETEROCLINIC,
    Bounds,
    homoclinic_curves,
    loops_beside,
    loops_of,
    saddle_nodes_of,
    saddle_quantity,
)
from pipeline.analysis.branches.kinds import BRANCH_POINTS, CURVE_KINDS, DOUBLING, FOLD, HOMOCLINIC, HOPF, KINDS, TORUS
from pipeline.analysis.branches.lockstep import Query, Steps, run_together
from pipeline.analysis.branches.normal_forms import critical_vectors
from pipeline.analysis.branches.problems import FREQUENCY, TESTS, BifurcationProblem, Family
from pipeline.layout.conventions import code_flags
from pipeline.layout.own_words import place_in_words
from pipeline.layout.vocabulary import frequency_of, model_attribute, parameter_name, section_attributes
from pipeline.results.tabular import plain

CURVE = Settings(first_step=2e-3, longest_step=0.02, max_points=400, tolerance=1e-8, max_iterations=8)
"""Settings with longer steps than on a branch, since nothing is located in between. The residual includes the
test function, and is limited by finite differences of monodromy matrices."""

REST_CURVE = replace(CURVE, longest_step=0.05, max_points=2000, tolerance=1e-11)
"""Settings of curves of equilibria, which need no integration, and whose states may move far."""

LOCATE = replace(CURVE, tolerance=1e-11, max_iterations=12)
"""Settings for locating points of codimension two, in both parameters to 1e-8."""

FIRST = "finding first points of curves"
"""Name of work in progress reports."""

CURVE_ENDS = (
    *("bound", "closed", "resonance", "max_points", "stuck", "period_halving"),
    *(BT, "equilibrium", "tangent", NONCENTRAL, HETEROCLINIC, "budget"),
)


LOST = "Newton's method finds no curve through it"
UNFOLDED = "the second parameter unfolds it: the branches come apart, and a fold may remain; it has no curve"
OF_ORBITS = "branch points of periodic orbits are not continued, those of equilibria are"
"""Reasons why a located point has no curve."""

SPRINGING = {
    R1: ((FOLD, 1), (TORUS, 1)),
    R2: ((DOUBLING, 1), (TORUS, 1), (TORUS, 2)),
    GENERALISED: ((FOLD, 2),),
    FOLD_FLIP: ((FOLD, 1), (DOUBLING, 1)),
    FOLD_TORUS: ((FOLD, 1), (TORUS, 1)),
    DOUBLING_TORUS: ((DOUBLING, 1), (TORUS, 1)),
    BT: ((FOLD, 0), (HOPF, 0)),
    GENERALISED_HOPF: ((FOLD, 1),),
    ZERO_HOPF: ((FOLD, 0), (HOPF, 0), (TORUS, 1)),
    DOUBLE_HOPF: ((HOPF, 0), (TORUS, 1)),
    DEGENERATE: ((FOLD, 0),),
}
"""Curves through a point of codimension two: the kind, and the period in units of that of the point's orbit; at
equilibria 0 for equilibria, 1 for cycles."""

OTHERS = {
    CHENCINER: ["folds of tori"],
    R3: ["saddle orbits of three times the period"],
    R4: ["orbits of four times the period"],
    DOUBLE_TORUS: ["tori of three frequencies"],
    DOUBLE_HOPF: ["tori of three frequencies"],
}
"""What springs from points of codimension two beside `SPRINGING`, and is never followed from there."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Curve of bifurcations in the plane of two parameters, with its orbits and the reasons for its two ends."""

    family: Family  # family of the curve's orbits, with two free parameters
    kind: str  # kind of bifurcation
    points: list[Point]  # orbits in order
    ends: tuple[str, str]  # reasons for both ends, of `CURVE_ENDS`
    # number of the located bifurcation it started from; -1 if it springs from a point of codimension two, or from an
    # end of a branch (homoclinic orbits, saddle nodes on a circle)
    start: int
    special: list[SpecialPoint] = field(default_factory=list)  # points of codimension two on it
    n_missed: int = 0  # sign changes of their test functions that could not be located

    @property
    def values(self) -> np.ndarray:
        """Values of both parameters at the points of the curve, shape (n, 2)."""
        return np.array([self.family.values(p.u) for p in self.points])


def curves_from(
    branches: xr.Dataset,
    parameters: Parameters,
    second: str,
    bounds: Bounds,
    max_period: int,
    generations: int = 3,
    left_out: dict[int, str] | None = None,
    lost: list[Loop] | None = None,
) -> list[Curve]:
    """Continue the bifurcations located on branches as curves in the plane of the branches' parameter and a second one.

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
        Longest period of the orbits; 0 takes the longest of the branches.
    generations
        Number of generations of curves that spring from points of codimension two.
    left_out
        Gets the number of each located point that has no curve, with the reason.
    lost
        Gets the approximate homoclinic orbits that Newton's method did not refine.

    Returns
    -------
    list of Curve
        Curves in the order of the located points they start from, none twice; then those of homoclinic orbits.
    """
    longest = max_period or int(branches["orbit_period"].values.max(initial=0))
    left_out = {} if left_out is None else left_out
    starts = _starts(branches, parameters, second, bounds, longest, left_out)
    nodes = saddle_nodes_of(branches, parameters, second, bounds, longest)
    starts += [(-1, family, FOLD, EquilibriumCurve(family, FOLD).start(u)) for family, u in nodes]
    found = continue_curves(starts, bounds, CURVE, longest, generations, left_out)
    takens = [p for p in merged({i: c.special for i, c in enumerate(found)}) if p.kind == BT]
    beside = [loop for point in takens for loop in loops_beside(point)]
    loops = loops_of(branches, parameters, second, bounds, longest) + beside
    return found + [
        Curve(c.family, HOMOCLINIC, c.points, c.ends, -1, c.special, c.n_missed)
        for c in homoclinic_curves(loops, bounds, lost=lost)
    ]


CurveStart = tuple[int, Family, str, np.ndarray]
"""Number of a located point, its family with two free parameters, its kind, its unknowns."""


def continue_curves(
    starts: Sequence[CurveStart],
    bounds: Bounds,
    settings: Settings = CURVE,
    max_period: int = 0,
    generations: int = 3,
    left_out: dict[int, str] | None = None,
    known: Sequence[Curve] = (),
) -> list[Curve]:
    """Follow each bifurcation in both directions in the parameter plane, until a bound, its own start or a resonance.

    Curves that spring from the points of codimension two are followed as well, up to orbits of `max_period`. Starts
    without a curve go to `left_out`, with the reason. No curve of `known` is followed again, nor are those returned.
    """
    left_out = {} if left_out is None else left_out
    problems = [_problem_of(family, kind) for _, family, kind, _ in starts]
    firsts = run_together([_first(p, u, settings) for p, (_, _, _, u) in zip(problems, starts, strict=True)], FIRST)
    ready = [(s[0], p, f) for s, p, f in zip(starts, problems, firsts, strict=True) if f is not None]
    left_out |= {s[0]: LOST for s, f in zip(starts, firsts, strict=True) if f is None}
    curves = list(known)
    seen = merged({i: curve.special for i, curve in enumerate(curves)})
    for generation in range(1 + generations):
        what = f"following curves{f' that spring from others, round {generation}' if generation else ''}"
        _follow_all(ready, curves, bounds, settings, left_out, what)
        points = merged({i: curve.special for i, curve in enumerate(curves)})
        fresh = [one for one in points if not any(one.point is other.point for other in seen)]
        seen += fresh
        sprung = [steps for one in fresh for steps in _springing(one, max_period)]
        ready = [(-1, *pair) for pair in run_together(sprung, FIRST) if pair is not None]
        if not ready:
            break
    return curves[len(known) :]


CurveProblem = BifurcationProblem | EquilibriumCurve
"""The problems with two free parameters, whose solutions are curves of bifurcations."""


def _problem_of(family: Family, kind: str) -> CurveProblem:
    return BifurcationProblem(family, kind) if family.period else EquilibriumCurve(family, kind)


Ready = tuple[int, CurveProblem, Point]
"""Number of a located point (-1: none), the problem of its curve, and the curve's first point."""


def _follow_all(
    ready: Sequence[Ready], curves: list[Curve], bounds: Bounds, settings: Settings, left_out: dict[int, str], what: str
) -> None:
    """Follow bifurcation curves in both directions from their first orbits, and append the new ones to `curves`."""
    ready = [r for r in ready if not any(_passes(curve, r[1], r[2]) for curve in curves)]
    traces = run_together([_follow(p, way, bounds, settings) for _, p, f in ready for way in (opposite(f), f)], what)
    for i, (number, problem, first) in enumerate(ready):
        (back, before, missed_before), (ahead, after, missed_after) = traces[2 * i : 2 * i + 2]
        points = [opposite(p) for p in reversed(back.points)] + ahead.points[1:]
        if not all(_persists(problem, point) for point in points):
            left_out[number] = UNFOLDED
            continue
        is_known = any(_passes(curve, problem, first) for curve in curves)
        if not is_known and (number >= 0 or len(points) > 2):
            ends = back.end, ahead.end
            n_missed = missed_before + missed_after
            curves.append(Curve(problem.family, problem.kind, points, ends, number, before + after, n_missed))


def _springing(one: SpecialPoint, max_period: int) -> list[Steps[tuple[CurveProblem, Point] | None]]:
    """Return the searches for a first orbit on each curve that may start at a point of codimension two."""
    family, kinds = one.family, SPRINGING.get(one.kind, ())
    if family.period:
        periods = [(kind, n * family.period) for kind, n in kinds if n == 1 or n * family.period <= max_period]
        return [_sprung(BifurcationProblem(replace(family, period=p), kind), one) for kind, p in periods]
    found = [_rest_sprung(EquilibriumCurve(family, kind), one) for kind, n in kinds if not n]
    for kind in (kind for kind, n in kinds if n):
        for omega in frequencies_at(one):
            cycles = cycle_family(family, one.point, omega)
            if cycles is not None:
                found.append(_cycles_sprung(BifurcationProblem(cycles, kind), one, omega))
    return found


def _rest_sprung(problem: EquilibriumCurve, at: SpecialPoint) -> Steps[tuple[CurveProblem, Point] | None]:
    """Find the first equilibrium of a curve through a point of codimension two; at a double Hopf point that of the
    other pair.
    """
    omegas = frequencies_at(at) or [0.0]
    own = 2.0 * np.pi / at.point.value.seconds
    omega = omegas[0] if len(omegas) == 1 else max(omegas, key=lambda one: abs(one - own))
    u = problem.start(at.point.u, omega)
    if at.kind == DEGENERATE:
        right, _ = null_vectors(at.family.scaled(at.point.value.monodromy))
        return (yield from _first_beside(problem, u, right))
    if problem.kind == FOLD:
        value = yield Query(problem, u)
        problem = EquilibriumCurve(problem.family, kind_of_zero(problem.family, u, value))
        u = problem.start(u)
    found = yield from _first(problem, u, CURVE)
    return None if found is None else (problem, found)


def _cycles_sprung(
    problem: BifurcationProblem, at: SpecialPoint, omega: float
) -> Steps[tuple[CurveProblem, Point] | None]:
    """Find a first small cycle on a curve of bifurcations of cycles that starts at a point of codimension two."""
    n = problem.family.system.n_states
    direction = cycle_direction(problem.family, at.point, omega)
    assert direction is not None
    return (yield from _first_beside(problem, np.concatenate([at.point.u[:n], at.point.u[-2:]]), direction))


def _first_beside(
    problem: CurveProblem, u: np.ndarray, direction: np.ndarray
) -> Steps[tuple[CurveProblem, Point] | None]:
    """Find a first point of a curve at some small distance from unknowns, along a direction of the states."""
    normal = np.append(direction, np.zeros(len(u) - len(direction)))
    for amplitude in CURVE.amplitudes:
        guess = u + amplitude * normal
        found = yield from correct(problem, guess, normal / np.linalg.norm(normal), _own(CURVE, problem))
        if found is not None and not (problem.family.period and end_of_crossings(problem.family, found)):
            return problem, found
    return None


def _sprung(problem: BifurcationProblem, at: SpecialPoint) -> Steps[tuple[CurveProblem, Point] | None]:
    """Find a first orbit on a bifurcation curve that starts at a point of codimension two; None if there is no such
    curve.
    """
    if problem.family.period == at.family.period:
        found = yield from _first(problem, at.point.u, CURVE)
        return None if found is None else (problem, found)
    _, q, _ = critical_vectors(at.family.scaled(at.point.value.monodromy), DOUBLING)
    return (yield from _first_beside(problem, at.point.u, q.real))


def _starts(
    ds: xr.Dataset, parameters: Parameters, second: str, bounds: Bounds, max_period: int, left_out: dict[int, str]
) -> list[CurveStart]:
    """Select the located bifurcations to continue. Each comes with its family of orbits and its start in scaled
    unknowns.
    """
    first = str(ds.attrs["parameter"])
    scales = tuple(high - low for low, high in bounds)
    found = []
    for k in range(ds.sizes["bifurcation"]):
        branch = int(ds["of_branch"][k])
        period, kind = int(ds["orbit_period"][branch]), KINDS[int(ds["kind"][k])]
        if period > max_period:
            continue
        if period and kind not in TESTS:
            left_out[k] = OF_ORBITS
            continue
        own = parameters.replace(**{n: float(ds[n][branch]) for n in parameters.names if n in ds})
        frequency = float(ds[FREQUENCY][branch]) if FREQUENCY in ds else frequency_of(parameters.model, {})
        family = Family(parameters.model.system, period, frequency, own.pack(), (first, second), (scales[0], scales[1]))
        here = frequency if second == FREQUENCY else own[second]
        state = np.asarray(ds["bifurcation_section"].values[k, 0])
        u = family.unknowns(state, [float(ds["value"][k]), here])
        found.append((k, family, kind, u if period else EquilibriumCurve(family, kind).start(u)))
    return found


def _own(settings: Settings, problem: CurveProblem) -> Settings:
    return settings if problem.family.period else REST_CURVE


def _first(problem: CurveProblem, u: np.ndarray, settings: Settings) -> Steps[Point | None]:
    value = yield Query(problem, u)
    found = (yield from correct(problem, u, kernel_of(value), _own(settings, problem))) if value.is_finite else None
    if found is None:
        return None
    tangent = kernel_of(found.value)
    return replace(found, tangent=tangent * (1.0 if tangent[-1] >= 0.0 else -1.0))


def _persists(problem: CurveProblem, point: Point) -> bool:
    """Return False at an imperfect branch point: one that a change of the second parameter has broken up."""
    persists = 1e-7  # largest imperfection beta that counts as none
    return problem.kind not in BRANCH_POINTS or abs(float(point.u[problem.family.system.n_states])) < persists


def _follow(
    problem: CurveProblem, start: Point, bounds: Bounds, settings: Settings
) -> Steps[tuple[Trace, list[SpecialPoint], int]]:
    """Follow a bifurcation curve in one direction, and locate its points of codimension two; stay within the bounds.

    A Neimark-Sacker curve ends at the resonance R1 or R2 where its pair of multipliers becomes real, and a Hopf curve
    at the Bogdanov-Takens point where its pair of eigenvalues does.
    """

    def is_inside(u: np.ndarray) -> bool:
        pairs = zip(problem.family.values(u), bounds, strict=True)
        return all(low <= value <= high for value, (low, high) in pairs)

    def stop(points: list[Point]) -> str:
        here = points[-1]
        if not is_inside(here.u):
            return "bound"
        if problem.kind == TORUS and not has_torus(here):
            return "resonance"
        if problem.kind == HOPF and not np.isfinite(here.value.seconds):
            return BT
        if not _persists(problem, here) or crawls(points):
            return "stuck"
        if has_halved(problem.family, points):
            return "period_halving"
        if problem.family.period and (end := end_of_crossings(problem.family, here)):
            return end
        step = np.linalg.norm(here.u - points[-2].u)
        if len(points) > 5 and np.linalg.norm(here.u - points[0].u) < 0.7 * step:
            return "closed"
        return ""

    detector: Detector
    if isinstance(problem, EquilibriumCurve):
        detector = EquilibriumDetector(problem, (LOCATE, CURVE))
    else:
        detector = Detector(problem, (LOCATE, CURVE))
    found = yield from trace(problem, start, _own(settings, problem), stop, detector.between)
    special = [one for one in detector.found if is_inside(one.point.u)]
    if found.end == "period_halving":  # coefficients of twice the period vanish where the orbit is that of one
        last, before = (p.u for p in found.points[:-3:-1])
        special = [one for one in special if np.linalg.norm(one.point.u - last) > np.linalg.norm(before - last)]
    if found.end in ("bound", "resonance", BT):
        found.points.pop()
    if found.end in ("resonance", BT):
        found.points += [one.point for one in special if one.kind in (R1, R2, BT)][-1:]
    return found, special, detector.n_missed


def _passes(curve: Curve, problem: CurveProblem, start: Point) -> bool:
    """Return whether a bifurcation curve passes through an orbit, at any of the orbit's section points.

    Two curves of Hopf points that cross at a double Hopf point differ in the period of their cycles.
    """
    # square of the dimensionless frequency of a Hopf point below which it is a Bogdanov-Takens point
    no_frequency = 1e-6
    # largest relative difference of the periods of the small cycles of neighbouring Hopf points of one curve
    same_period = 0.1
    family, points, seconds = problem.family, curve.points, start.value.seconds
    if problem.kind == HOPF and start.u[family.system.n_states] > no_frequency:
        points = [point for point in points if abs(point.value.seconds / seconds - 1.0) < same_period]
    is_alike = curve.kind == problem.kind and curve.family.period == family.period
    return is_alike and lies_on(points, family, start)


def lies_on(points: Sequence[Point], family: Family, start: Point) -> bool:
    """Return whether a curve in two parameters passes through an orbit, at any of the orbit's section points."""
    n = family.system.n_states  # of a Hopf point an unknown stands between the states and the parameters
    for a, b in pairwise([np.concatenate([p.u[:n], p.u[-2:]]) for p in points]):
        chord = b - a
        length = float(np.linalg.norm(chord))
        if not length:
            continue
        for image in start.value.images:
            offset = np.append(family.mismatch(a, image), start.u[-2:] - a[-2:])
            share = float(offset @ chord) / length**2
            if -0.01 <= share <= 1.01 and np.linalg.norm(offset - share * chord) < 0.02 * length + 1e-6:
                return True
    return False


def curves_dataset(curves: Sequence[Curve], first: str, second: str, model: Model | None = None) -> xr.Dataset:
    """Return bifurcation curves as a dataset with the dims ``curve``, ``point``, ``state`` and ``special`` (points of
    codimension two).

    ``special`` counts the points of codimension two: ``special_kind``, ``special_first`` and ``special_second``
    with their errors ``..._error``, ``special_period``, ``special_section`` and the curve on which each was found;
    of equilibria also the coefficients of the normal forms, such as ``special_lyapunov2`` (see `center_manifold`).

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
    points = [((i, j), (c, point)) for i, c in enumerate(curves) for j, point in enumerate(c.points)]
    shape = (len(curves), max((len(c.points) for c in curves), default=0))
    columns: Columns = {
        "first": ((), lambda c, point: c.family.values(point.u)[0]),
        "second": ((), lambda c, point: c.family.values(point.u)[1]),
        "section": (("state",), lambda c, point: c.family.state(point.u)),
        "residual": ((), lambda _, point: point.residual),
        "saddle_quantity": (
            (),
            lambda c, point: saddle_quantity(point.value.monodromy) if c.kind == HOMOCLINIC else np.nan,
        ),
    }
    variables = filled(("curve", "point"), shape, points, {"state": len(names)}, columns)
    ends = [[CURVE_ENDS.index(c.ends[i]) for c in curves] for i in (0, 1)]
    kinds = [CURVE_KINDS.index(c.kind) for c in curves]
    of_curves = {
        "kind": column(kinds, "int8", **code_flags(CURVE_KINDS)),
        "orbit_period": column([c.family.period for c in curves], "int32"),
        "start": column([c.start for c in curves], "int32"),
        "n_missed": column([c.n_missed for c in curves], "int32"),
        "n_points": column([len(c.points) for c in curves], "int32"),
        "first_end": column(ends[0], "int8", **code_flags(CURVE_ENDS)),
        "last_end": column(ends[1], "int8", **code_flags(CURVE_ENDS)),
    }
    variables |= {name: ("curve", *own) for name, own in of_curves.items()}
    told = {} if model is None else {"model": model_attribute(model), **section_attributes(model.crossing)}
    return xr.Dataset(
        variables | _special_points(curves, len(names)),
        coords={"state": list(names)},
        attrs={"first_parameter": first, "second_parameter": second, **told},
    )


def not_followed(ds: xr.Dataset, word: str = parameter_name(FREQUENCY)) -> list[str]:
    """Return a text line for each point of codimension two from which curves spring that were not followed.

    A curve counts as followed if one of its kind and period comes near the point. The rate has the specification's
    `word`.
    """
    largest = 0.05  # distance of a curve from a point of codimension two from which it springs, in units of the ranges
    roles, lines = ("first", "second"), list[str]()
    if not ds.sizes["curve"]:
        return lines
    ranges = np.array([np.nanmax(ds[role].values) - np.nanmin(ds[role].values) for role in roles])
    ranges[ranges == 0.0] = 1.0
    points = np.stack([ds[role].values for role in roles], axis=-1) / ranges
    for k in range(ds.sizes["special"]):
        kind, period = POINT_KINDS[int(ds["special_kind"][k])], int(ds["special_period"][k])
        at = [float(ds[f"special_{role}"][k]) for role in roles]
        near = np.nanmin(np.linalg.norm(points - np.array(at) / ranges, axis=-1), axis=1) < largest
        known = {
            (CURVE_KINDS[int(one)], int(n))
            for one, n in zip(ds["kind"].values[near], ds["orbit_period"].values[near], strict=True)
        }
        wanted = [(one, n * period if period else n) for one, n in SPRINGING.get(kind, ())]
        missing = [
            f"{plain(one)} of {f'period {n}' if n else 'equilibria'}" for one, n in wanted if (one, n) not in known
        ]
        if kind == BT and HOMOCLINIC not in {one for one, _ in known}:
            missing.append("homoclinic orbits")
        missing += OTHERS.get(kind, [])
        if missing:
            place = ", ".join(
                place_in_words(ds.attrs[f"{role}_parameter"], word, x) for role, x in zip(roles, at, strict=True)
            )
            lines.append(f"{plain(kind)} at {place}: not followed from there: {', '.join(missing)}")
    return lines


def _special_points(curves: Sequence[Curve], n_states: int) -> dict[str, Any]:
    """Return the points of codimension two on all curves as dataset variables, each point once."""
    found = merged({i: curve.special for i, curve in enumerate(curves)})
    kinds = [POINT_KINDS.index(one.kind) for one in found]
    codes = {
        "special_kind": column(kinds, "int8", **code_flags(POINT_KINDS)),
        "special_curve": column([one.curve for one in found], "int32"),
        "special_period": column([one.family.period for one in found], "int32"),
    }
    columns: dict[str, Any] = {"special_section": (("state",), lambda one: one.family.state(one.point.u))}
    for i, role in enumerate(("first", "second")):
        columns[f"special_{role}"] = ((), lambda one, i=i: one.values[i])
        columns[f"special_{role}_error"] = ((), lambda one, i=i: one.bracket[i])
    for name in sorted({name for one in found for name in one.coefficients}):
        columns[f"special_{name}"] = ((), lambda one, name=name: one.coefficients.get(name, np.nan))
    items = [((k,), (one,)) for k, one in enumerate(found)]
    return {name: ("special", *own) for name, own in codes.items()} | filled(
        ("special",), (len(found),), items, {"state": n_states}, columns
    )
