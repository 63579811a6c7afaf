"""Compare a measured bifurcation diagram with a computed one: distances between section points, periods, and the
frequencies at which regimes (period and class of motion) end.

For two sets of equally many points, Wasserstein-1 is the mean distance in the cheapest pairing, found by
`scipy.optimize.linear_sum_assignment` (a shortest augmenting path: Crouse, IEEE Trans. Aerosp. Electron.
Syst. 52, 2016, p. 1679). For unequal numbers it is the cost of the cheapest transport, a linear programme
that `scipy.optimize.linprog` solves by HiGHS (Huangfu and Hall, Math. Prog. Comp. 10, 2018, p. 119). The
distance of two states is the largest difference of a component in units of the model's scales, with angles on
their circle, as everywhere in `pipeline.analysis`.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.optimize import linear_sum_assignment, linprog
from scipy.sparse import eye_array, kron, vstack

from pipeline.layout.vocabulary import model_of
from pipeline.products.product import Table
from pipeline.results.sets import Geometry
from pipeline.results.sides import flags_of
from pipeline.results.tabular import Row, Words, aligned, counted
from pipeline.rig.measured.computed import Candidate, Computed
from pipeline.rig.measured.diagram import with_sides
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.problems import SpecError

# ---- distances -------------------------------------------------------------------------------------

Floats = npt.NDArray[np.float64]


def wasserstein(a: Floats, b: Floats, geometry: Geometry) -> float:
    """Return the Wasserstein-1 distance, in units of the scales, of points (m, state) and (n, state)."""
    ways = geometry.distance(a[:, None], b[None])
    if len(a) != len(b):
        return _transport(ways)
    rows, columns = linear_sum_assignment(ways)
    return float(ways[rows, columns].mean())


def _transport(ways: Floats) -> float:
    """Return the smallest mean transport distance between two sets, given all pairwise distances."""
    m, n = ways.shape
    if min(m, n) == 1:
        return float(ways.mean())
    leaving, coming = kron(eye_array(m), np.ones((1, n))), kron(np.ones((1, m)), eye_array(n))
    # one constraint is dropped: it follows from the others
    sums = vstack([leaving, coming]).tocsr()[:-1]
    totals = np.concatenate([np.full(m, 1.0 / m), np.full(n, 1.0 / n)])[:-1]
    found = linprog(ways.ravel(), A_eq=sums, b_eq=totals, method="highs")
    if not found.success:
        raise ArithmeticError(f"the distance of {m} from {n} section points: {found.message}")
    return float(found.fun)


@dataclass(frozen=True)
class Cloud:
    """Measured section points at one frequency step, with their noise."""

    # (n, state): states, and the standard deviation of each
    points: Floats
    noise: Floats
    orbit_period: int  # period of the orbit; 0 if it does not close

    @property
    def cycle(self) -> int:
        """Number of section points after which the motion repeats. It is 1 if the motion is aperiodic."""
        return max(self.orbit_period, 1)

    @property
    def size(self) -> int:
        """Number of section points in each half of the measurement. It is a whole number of cycles if the half is long
        enough.

        Otherwise the halves would hold the points of an orbit in unequal numbers, which adds a distance from
        one point of the orbit to another.
        """
        half = len(self.points) // 2
        return half // self.cycle * self.cycle or half

    def halves(self) -> tuple[Floats, Floats]:
        """Return the first and the second half of the section points."""
        return self.points[-2 * self.size : -self.size], self.points[-self.size :]

    def shuffled(self, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Divide the section points into two halves at random, in whole cycles of the orbit."""
        both = self.points[-2 * self.size :]
        length = self.cycle if self.size % self.cycle == 0 else 1
        cycles = both.reshape(-1, length, both.shape[-1])
        order = rng.permutation(len(cycles))
        one, two = np.array_split(cycles[order], 2)
        return one.reshape(-1, both.shape[-1]), two.reshape(-1, both.shape[-1])


def cloud_of(points: Floats, noise: Floats, orbit_period: int) -> Cloud:
    """Return the measured section points of one frequency step. Leave out cycles with a missing point (NaN)."""
    known = np.asarray(np.isfinite(points).all(axis=1), np.bool_)
    last = int(np.flatnonzero(known)[-1]) + 1
    cycle = max(orbit_period, 1)
    if last >= cycle:
        n = last // cycle * cycle
        whole = np.repeat(known[:n].reshape(-1, cycle).all(axis=1), cycle)
        known = np.concatenate([whole, np.zeros(known.size - n, np.bool_)]) if whole.any() else known
    return Cloud(points[known], _scatter(points, noise, orbit_period)[known], orbit_period)


def _scatter(points: Floats, noise: Floats, orbit_period: int) -> Floats:
    """Return the noise of section points, or the observed scatter of a periodic motion if that is larger."""
    k = orbit_period
    if not k or len(points) <= 2 * k:
        return noise
    second = points[2 * k :] - 2 * points[k:-k] + points[: -2 * k]
    seen = np.sqrt(np.nanmean(second**2, axis=0) / 6)
    return np.asarray(np.maximum(noise, seen))


def floor_of(cloud: Cloud, geometry: Geometry, rng: np.random.Generator) -> float:
    """Return the noise floor of a measurement: Wasserstein-1 distance between the halves of its section points.

    It is the mean over randomly drawn halves. If the first and the second half differ more, as in a recording
    that drifted, it is their distance.
    """
    draws = 8  # number of samples whose distances are averaged
    drawn = [wasserstein(*cloud.shuffled(rng), geometry) for _ in range(draws)]
    return max(float(np.mean(drawn)), wasserstein(*cloud.halves(), geometry))


def distance_to(candidate: Candidate, cloud: Cloud, geometry: Geometry, rng: np.random.Generator) -> float:
    """Return the mean Wasserstein-1 distance between an attractor and the two halves of the measured section points.

    For each half, as many points of the attractor are drawn, and the noise of the sections is added. The distance from
    a correct model then equals that between the halves.
    """
    draws = 8  # number of samples whose distances are averaged
    parts, blur = cloud.halves(), np.median(cloud.noise, axis=0)
    ways = []
    for _ in range(draws // len(parts)):
        for part in parts:
            drawn = _drawn(candidate, len(part), rng)
            ways.append(wasserstein(part, drawn + rng.normal(0.0, 1.0, drawn.shape) * blur, geometry))
    return float(np.mean(ways))


def _drawn(candidate: Candidate, size: int, rng: np.random.Generator) -> Floats:
    """Return at least `size` section points: random ones of an aperiodic set, or whole repetitions of an orbit."""
    points = candidate.points
    if candidate.orbit_period:
        return np.tile(points, (max(1, -(-size // len(points))), 1))
    return np.asarray(points[rng.choice(len(points), size, replace=len(points) < size)])


def geometry_of(names: Sequence[str], model_names: Sequence[str], whole: Geometry) -> Geometry:
    """Return the geometry for distances between section points: scale and angle flag of each recorded state."""
    at = [list(model_names).index(n) for n in names]
    return Geometry(tuple(whole.is_angle[i] for i in at), tuple(whole.scales[i] for i in at))


# ---- windows ---------------------------------------------------------------------------------------

CONFIDENT = 0.8
"""Least confidence of a step's period; other steps do not enter windows."""

Regime = tuple[int, int]
"""Period, 0 if unclosed, and code of the side."""


@dataclass(frozen=True)
class Window:
    """Window: successive frequency steps of one recording, swept in one direction, with the same regime."""

    regime: Regime
    steps: tuple[int, ...]
    recording: int
    direction: str


@dataclass(frozen=True)
class WindowEdge:
    """End of a measured window, with the frequency at which the same regime ends in the model."""

    direction: str
    # regimes on the rig
    before: Regime
    after: Regime
    # middle between the last step before and the first after the edge, and half their distance
    measured_hz: float
    measured_error_hz: float
    # the same in the model, for the attractor that is nearest within the window. NaN if none has that regime, or if the
    # regime continues to the end of the run's axis.
    computed_hz: float
    computed_error_hz: float
    note: str  # reason for a missing number, or a caveat

    @property
    def shift_hz(self) -> float:
        """Frequency at which the regime ends on the rig minus that at which it ends in the model [Hz]."""
        return self.measured_hz - self.computed_hz

    @property
    def shift_error_hz(self) -> float:
        """Bound on the error of the shift [Hz], half of both frequency steps; it is not a standard error."""
        return self.measured_error_hz + self.computed_error_hz


def regime_of(measured: xr.Dataset, step: int) -> Regime:
    """Return the regime of a frequency step: period and class of motion."""
    side = int(measured["side"].values[step]) if "side" in measured else 0
    return int(measured["orbit_period"].values[step]), side


def words_for(regime: Regime, words: tuple[str, ...]) -> str:
    """Return a regime (period and class of motion) in words."""
    period = f"period {regime[0]}" if regime[0] else "unclosed"
    return f"{period}, {words[regime[1]]}" if regime[1] and words else period


def windows_of(measured: xr.Dataset) -> list[Window]:
    """Return the windows of all recordings: runs of consecutive frequency steps with the same regime."""
    keys = list(zip(measured["recording"].values.tolist(), measured["direction"].values.tolist(), strict=True))
    sure = [i for i in range(len(keys)) if measured["confidence"].values[i] >= CONFIDENT]
    labelled = itertools.groupby(sure, key=lambda i: (keys[i], regime_of(measured, i)))
    return [Window(regime, tuple(steps), *key) for (key, regime), steps in labelled]


def window_edges(measured: xr.Dataset, winners: np.ndarray, computed: Computed) -> list[WindowEdge]:
    """Return the ends of the measured windows, each with the frequency at which the same regime ends in the model.

    `winners` are the ids of each step's nearest attractor, -1 for none.
    """
    windows = windows_of(measured)
    found = []
    for one, two in itertools.pairwise(windows):
        if (one.recording, one.direction) != (two.recording, two.direction):
            continue
        f = measured["frequency"].values
        last, first = float(f[one.steps[-1]]), float(f[two.steps[0]])
        computed_hz, error, note = _computed_end(one, measured, winners, computed)
        if not one.regime[0] and not note:
            note = "an unclosed motion may be a transient, which ends by chance"
        found.append(
            WindowEdge(
                one.direction,
                one.regime,
                two.regime,
                0.5 * (last + first),
                0.5 * abs(first - last),
                computed_hz,
                error,
                note,
            )
        )
    return found


def _computed_end(
    window: Window, measured: xr.Dataset, winners: np.ndarray, computed: Computed
) -> tuple[float, float, str]:
    """Return where the regime of a measured window ends in the model, in the direction of the sweep."""
    f = measured["frequency"].values
    with_side = "side" in measured
    chosen = {}
    for step in window.steps:
        place = computed.place(float(f[step]))
        regime = computed.regime(place, int(winners[step])) if place >= 0 and winners[step] >= 0 else None
        if regime is not None and _same(regime, window.regime, with_side):
            chosen[step] = (place, int(winners[step]))
    if not chosen:
        return math.nan, math.nan, "the model's nearest attractor has another regime all along"
    number = Counter(n for _, n in chosen.values()).most_common(1)[0][0]
    middle = window.steps[len(window.steps) // 2]
    start = min((s for s, (_, n) in chosen.items() if n == number), key=lambda s: abs(s - middle))
    place, sign = chosen[start][0], 1 if window.direction != "down" else -1
    return _walk(place, sign, computed, lambda i: _is(computed.regime(i, number), window.regime, with_side))


def _walk(place: int, sign: int, computed: Computed, holds: Callable[[int], bool]) -> tuple[float, float, str]:
    """Follow a regime along computed frequencies; return its end [Hz], half the step there, and a note without one."""
    f = computed.frequencies
    while 0 <= place + sign < f.size:
        if not holds(place + sign):
            return 0.5 * float(f[place] + f[place + sign]), 0.5 * abs(float(f[place + sign] - f[place])), ""
        place += sign
    return math.nan, math.nan, f"in the model it goes on beyond {f[place]:g} Hz"


def _is(regime: Regime | None, wanted: Regime, with_side: bool) -> bool:
    return regime is not None and _same(regime, wanted, with_side)


def _same(a: Regime, b: Regime, with_side: bool) -> bool:
    return a == b if with_side else a[0] == b[0]


# ---- comparison ------------------------------------------------------------------------------------

NOBODY = -1


def compare(measured: xr.Dataset, run: AnalysedRun) -> xr.Dataset:
    """Compare a measured bifurcation diagram with the attractors of a run of the same model over the drive frequency.

    Return `measured` with further variables. By step: ``noise_floor``, Wasserstein-1 between the halves of the step's
    sections; ``winner``, id of the nearest attractor, -1 outside the run's axis; ``distance`` from it and ``runner_up``
    from the next (NaN if there is no other), in units of the states' scales; ``distance_in_noise``, the distance in
    units of the floor; ``computed_period`` (0: a set that does not close) and ``computed_side`` of the winner;
    ``same_period`` and ``same_side``: 1 if they agree, 0 if not, -1 if unknown. By step and attractor: ``distances``.
    By window edge: the fields of `WindowEdge` after ``edge_``.

    Raise `SpecError` if the run is of another model, has no frequency axis, or reaches none of the measured
    frequencies.
    """
    computed = Computed.of(run, model_of(measured))
    return compare_with(with_sides(measured, computed.parameters), computed)


def compare_with(measured: xr.Dataset, computed: Computed) -> xr.Dataset:
    """Compare a measured diagram, whose steps have their class of motion (``side``), with computed attractors."""
    f = measured["frequency"].values
    if not any(computed.place(float(x)) >= 0 for x in f):
        own = computed.frequencies
        raise SpecError(
            f"frequency: measured from {f.min():.4g} to {f.max():.4g} Hz, computed from {own.min():.4g} to "
            f"{own.max():.4g} Hz; the ranges do not overlap: run the model over the measured range."
        )
    ids = computed.attractors["attractor"].values
    distances = np.full((f.size, ids.size), np.nan)
    rows = [_step(measured, i, computed, distances[i]) for i in range(f.size)]
    names = {
        "noise_floor": ("1", "distance of the halves of the sections"),
        "winner": ("1", "nearest attractor"),
        "distance": ("1", "distance from the nearest attractor"),
        "runner_up": ("1", "distance from the next attractor"),
        "distance_in_noise": ("1", "distance in units of the noise floor"),
        "computed_period": ("1", "period of the nearest attractor, 0: a set that does not close"),
        "computed_side": ("1", "side of the nearest attractor"),
        "same_period": ("1", "whether the periods agree"),
        "same_side": ("1", "whether the sides agree"),
    }
    found = measured.assign(
        {
            n: ("step", np.array([row[n] for row in rows]), {"units": u, "long_name": text})
            for n, (u, text) in names.items()
        }
    )
    found = found.assign(distances=(("step", "attractor"), distances, {"units": "1"}))
    found = found.assign_coords(attractor=ids)
    classifier = computed.model.classifier
    if classifier is not None:
        found["computed_side"].attrs.update(flags_of(classifier))
    edges = window_edges(found, found["winner"].values, computed)
    return _with_edges(found, edges).assign_attrs(
        title="measured beside computed", run=computed.title, cube_digest=computed.digest
    )


def _step(measured: xr.Dataset, step: int, computed: Computed, distances: np.ndarray) -> dict[str, float]:
    """Compare one frequency step; write the distances from the attractors, and return the other results."""
    seed = 0  # of the samples drawn from sets that do not close
    states = [str(s) for s in measured["state"].values]
    geometry = geometry_of(states, computed.model.state_names, Geometry.of(computed.model))
    points, noise = measured["section"].values[step], measured["section_noise"].values[step]
    cloud = cloud_of(points, noise, int(measured["orbit_period"].values[step]))
    floor = floor_of(cloud, geometry, np.random.default_rng(seed))
    candidates = computed.candidates(float(measured["frequency"].values[step]), states)
    ids = computed.attractors["attractor"].values.tolist()
    for c in candidates:
        rng = np.random.default_rng([seed, c.attractor])
        distances[ids.index(c.attractor)] = distance_to(c, cloud, geometry, rng)
    row = {"noise_floor": floor, "winner": NOBODY, "distance": np.nan, "runner_up": np.nan}
    row |= {"distance_in_noise": np.nan, "computed_period": NOBODY, "computed_side": 0}
    row |= {"same_period": -1, "same_side": -1}
    if not candidates:
        return row
    ranked = sorted(candidates, key=lambda c: distances[ids.index(c.attractor)])
    best = distances[ids.index(ranked[0].attractor)]
    row |= {"winner": ranked[0].attractor, "distance": best, "distance_in_noise": best / floor}
    if len(ranked) > 1:
        row["runner_up"] = distances[ids.index(ranked[1].attractor)]
    return row | _agreement(measured, step, ranked[0])


def _agreement(measured: xr.Dataset, step: int, winner: Candidate) -> dict[str, float]:
    side = int(measured["side"].values[step]) if "side" in measured else 0
    return {
        "computed_period": winner.orbit_period,
        "computed_side": winner.side,
        "same_period": int(winner.orbit_period == int(measured["orbit_period"].values[step])),
        "same_side": int(winner.side == side) if side and winner.side else -1,
    }


def _with_edges(found: xr.Dataset, edges: list[WindowEdge]) -> xr.Dataset:
    plain = [asdict(e) | {"shift_hz": e.shift_hz, "shift_error_hz": e.shift_error_hz} for e in edges]
    hz = ("measured_hz", "measured_error_hz", "computed_hz", "computed_error_hz", "shift_hz", "shift_error_hz")
    columns: dict[str, tuple[str, np.ndarray]] = {
        f"edge_{n}": ("edge", np.array([p[n] for p in plain], np.float64)) for n in hz
    }
    for n in ("before", "after"):
        for k, what in enumerate(("period", "side")):
            columns[f"edge_{n}_{what}"] = ("edge", np.array([p[n][k] for p in plain], np.int64))
    for n in ("direction", "note"):
        columns[f"edge_{n}"] = ("edge", np.array([p[n] for p in plain], str))
    found = found.assign(columns)
    for n in hz:
        found[f"edge_{n}"].attrs["units"] = "Hz"
    return found


def words_of(measured: xr.Dataset) -> tuple[str, ...]:
    """Return the labels of the model's motion classifier, or an empty tuple if the model has no classifier."""
    classifier = model_of(measured).classifier
    return classifier.words if classifier is not None else ()


def edges_table(compared: xr.Dataset) -> Table:
    """Return a table of the frequencies at which regimes end on the rig and in the model."""
    words = words_of(compared)
    rows: list[Row] = []
    for k in range(compared.sizes.get("edge", 0)):
        one = compared.isel(edge=k)
        row: Row = {"direction": str(one["edge_direction"].values)}
        for n in ("before", "after"):
            row[n] = words_for((int(one[f"edge_{n}_period"]), int(one[f"edge_{n}_side"])), words)
        for n in ("measured", "computed", "shift"):
            row |= {f"{n}_hz": float(one[f"edge_{n}_hz"]), f"{n}_error_hz": float(one[f"edge_{n}_error_hz"])}
        rows.append(row | {"note": str(one["edge_note"].values)})
    return Table(rows, [counted(len(rows), "window edge"), *aligned([_edge_words(r) for r in rows])])


def _edge_words(row: Row) -> Words:
    return {
        "way": row["direction"],
        "from": row["before"],
        "to": row["after"],
        "measured Hz": _between(row, "measured"),
        "computed Hz": _between(row, "computed"),
        "shift Hz": _between(row, "shift"),
        "note": row["note"],
    }


def _between(row: Row, name: str) -> str:
    value, error = row[f"{name}_hz"], row[f"{name}_error_hz"]
    return "-" if math.isnan(value) else f"{value:.4f} ± {error:.4f}"


def summary_lines(compared: xr.Dataset) -> list[str]:
    """Return a printed summary of the comparison of a measured with a computed diagram."""
    limit = 5.0  # distance in noise floors above which the nearest attractor is not the rig's
    covered = compared["winner"].values >= 0
    sure = covered & (compared["confidence"].values >= CONFIDENT)
    d = compared["distance_in_noise"].values[covered]
    lines = [
        f"{int(covered.sum())} of {covered.size} steps lie on the run's axis; distance from the nearest "
        f"attractor: median {np.median(d):.2f}, 90 % below {np.quantile(d, 0.9):.2f} noise floors"
    ]
    for name, what in (("same_period", "periods"), ("same_side", "sides")):
        known = sure & (compared[name].values >= 0)
        if known.any():
            share = compared[name].values[known].mean()
            lines.append(f"{what} agree at {100 * share:.0f} % of the {int(known.sum())} steps that are sure")
    far = int((d > limit).sum())
    if far:
        lines.append(
            f"at {far} steps the nearest attractor is more than {limit:g} noise floors away: the model is off, "
            "or the run did not find the attractor, which more initial conditions may"
        )
    return lines
