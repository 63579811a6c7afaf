"""Compare a measured bifurcation diagram with a computed one: distances between section points, periods, and the
frequencies at which regimes (period and class of motion) end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np
import xarray as xr

from pipeline.analysis.sets import Geometry
from pipeline.analysis.sides import flags_of
from pipeline.layout.vocabulary import model_of
from pipeline.rig.measured.computed import Computed
from pipeline.rig.measured.distances import Candidate, cloud_of, distance_to, floor_of, geometry_of
from pipeline.rig.measured.measuring import with_sides
from pipeline.rig.measured.windows import WindowEdge, window_edges
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.problems import SpecError

NOBODY = -1


def compare(
    measured: xr.Dataset, run: AnalysedRun, *, at: Mapping[str, float] | None = None, seed: int = 0
) -> xr.Dataset:
    """Compare a measured bifurcation diagram with the attractors of a computed run.

    Parameters
    ----------
    measured
        Result of `pipeline.rig.measured.measuring.measure`.
    run
        Run of the same model, with the drive frequency as an axis.
    at
        Values of the run's other axes.
    seed
        Seed of the samples drawn from sets that do not close.

    Returns
    -------
    Dataset
        `measured` with further variables. By step: ``noise_floor``, Wasserstein-1 between the halves of the
        step's sections; ``winner``, id of the nearest attractor, -1 outside the run's axis; ``distance`` from
        it and ``runner_up`` from the next (NaN if there is no other), in units of the states' scales;
        ``distance_in_noise``, the distance in units of the floor; ``computed_period`` (0: a set that does not
        close) and ``computed_side`` of the winner; ``same_period`` and ``same_side``: 1 if they agree, 0 if
        not, -1 if unknown. By step and attractor: ``distances``. By window edge, dim ``edge``:
        ``edge_measured_hz``, ``edge_measured_error_hz``, ``edge_computed_hz``, ``edge_computed_error_hz``,
        ``edge_shift_hz``, ``edge_shift_error_hz``, ``edge_direction``, ``edge_before_period``,
        ``edge_before_side``, ``edge_after_period``, ``edge_after_side``, ``edge_note``.

    Raises
    ------
    SpecError
        If the run is of another model, has no frequency axis, or reaches none of the measured frequencies.
    """
    computed = Computed.of(run, model_of(measured), at)
    return compare_with(with_sides(measured, computed.parameters), computed, seed=seed)


def compare_with(measured: xr.Dataset, computed: Computed, *, seed: int = 0) -> xr.Dataset:
    """Compare a measured diagram with computed attractors. The measured frequency steps must already have their class
    of motion (``side``).
    """
    f = measured["frequency"].values
    if not any(computed.place(float(x)) >= 0 for x in f):
        own = computed.frequencies
        raise SpecError(
            f"frequency: measured from {f.min():.4g} to {f.max():.4g} Hz, computed from {own.min():.4g} to "
            f"{own.max():.4g} Hz; the ranges do not overlap: run the model over the measured range."
        )
    ids = computed.attractors["attractor"].values
    distances = np.full((f.size, ids.size), np.nan)
    rows = [_step(measured, i, computed, distances[i], seed) for i in range(f.size)]
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


def _step(measured: xr.Dataset, step: int, computed: Computed, distances: np.ndarray, seed: int) -> dict[str, float]:
    """Compare the measurement with the model at one frequency step. Write the distance from each attractor into
    `distances`, and return the other results by name.
    """
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
