"""Atlases of maps and of a cusp: every change of attractors against orbits that are followed by numpy alone."""

import numpy as np
import pytest

from tests.core.flows import table
from tests.pipeline.analysis.atlas.judge import Orbits, Rest, curve_errors, judged
from tests.pipeline.analysis.cubes import line, sweep


def iterated(model, starts, axes):
    """Return a sweep over a map, from random starts."""
    spec = sweep(model, {"kind": "random", "seed": 1, **starts}, axes=axes, lengths=(600, 20))
    return {**spec, "integration": {"n_transient": 600, "n_keep": 20}}


CUSP = sweep(
    table("cusp", {"x": "a + b*x - x^3"}, {"a": 0.0, "b": 0.5}),
    {"kind": "random", "n": 12, "seed": 1, "x": [-1.5, 1.5]},
    axes={"a": line(-0.5, 0.5, 20), "b": line(-0.38, 1.0, 22)},
    section={"of": "x", "value": 0.0, "direction": "up", "longest": 50.0},
    lengths=(100, 8),
)
CUBIC = iterated(
    {
        "name": "cubic",
        "kind": "map",
        "states": {"x": {}},
        "parameters": {"a": 0.1, "b": 0.5},
        "equations": {"x": "a + b*x - x^3"},
    },
    {"n": 8, "x": [-1.0, 1.0]},
    {"a": line(-0.31, 0.71, 10), "b": line(0.22, 1.52, 10)},
)


def right(report):
    """Raise unless an atlas contradicts nothing that was followed here."""
    assert not report.wrong, "\n".join(report.wrong)
    assert not report.missing, "\n".join(report.missing)
    assert not report.doubtful, "\n".join(report.doubtful)


def cusp(x, p):
    """Rates, and the map of the same right side."""
    return [p[0] + p[1] * x[0] - x[0] ** 3]


def test_cusp(computed):
    """Folds 4 b^3 = 27 a^2; two equilibria in the wedge, whose area in closed form is that of its region."""
    ds, report = judged(computed(CUSP), lambda *_: Rest(cusp))
    right(report)
    assert report.row["orbits_not_explained"] == 0
    is_point = np.arange(ds.sizes["point"]) < ds["n_points"].values[:, None]
    a, b = ds["a"].values[is_point], ds["b"].values[is_point]
    np.testing.assert_allclose(4.0 * b**3, 27.0 * a**2, atol=1e-9)
    # the wedge leaves the plane through b = 1, at a = .3849
    wedge = 2.0 * np.sqrt(4.0 / 27.0) * 0.4 / 1.38
    areas = dict(zip(ds["region_label"].values.tolist(), ds["area"].values.tolist(), strict=True))
    assert areas["rest + rest"] == pytest.approx(wedge, abs=2e-3)


def test_cubic_map(computed):
    """Orbits up to long periods, two sheets with their own cascades."""
    orbits = Orbits.of_map(cusp)
    ds, report = judged(computed(CUBIC), lambda kind, n, *_: orbits.period(n) if n else None)
    right(report)
    assert report.row["orbits_not_explained"] == 0
    assert max(curve_errors(ds, lambda kind, n: orbits.period(n), every=4).values()) < 1e-6
    number = np.flatnonzero((ds["orbit_period"].values == 1) & (ds["n_points"].values > 0))
    kinds = set(np.array(ds["kind"].attrs["flag_meanings"].split())[ds["kind"].values[number]])
    assert {"fold", "period_doubling"} <= kinds


def test_judge(computed):
    """A kind that is exchanged, a place that is shifted and a change that is left out are found out."""
    rest = Rest(cusp)

    def contradictions(change):
        _, report = judged(computed(CUSP), lambda *_: rest, change=change)
        return len(report.wrong), len(report.missing)

    def exchanged(ds):
        words = ds["what"].attrs["flag_meanings"].split()
        codes = ds["what"].values.copy()
        codes[np.flatnonzero(codes == words.index("fold"))[3]] = words.index("hopf")
        return ds.assign(what=ds["what"].copy(data=codes))

    def shifted(ds):
        k = np.flatnonzero(ds["on_curve"].values >= 0)[5]
        return ds.assign_coords(change_a=ds["change_a"] + 1e-5 * (np.arange(ds.sizes["change"]) == k))

    def without(ds):
        k = np.flatnonzero(ds["on_curve"].values >= 0)[7]
        return ds.isel(change=np.arange(ds.sizes["change"]) != k)

    assert contradictions(exchanged) == (1, 0)
    assert contradictions(shifted) == (1, 0)
    assert contradictions(without) == (0, 1)
