"""First tangencies of manifolds that are known curves, and what is said of them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from pipeline.analysis.manifolds import analysis
from pipeline.analysis.manifolds.analysis import (
    ENDS,
    _extremes,
    _first_maximum,
    _Line,
    _oriented,
    first_tangency,
    gap,
    manifolds_table,
    needs_tangency,
    tangency_table,
)
from pipeline.analysis.manifolds.declaration import TangencyOptions
from pipeline.analysis.manifolds.growing import Manifold
from pipeline.layout.conventions import code_flags
from tests.pipeline.analysis.manifolds.test_growing import linear


def test_line__signed_distances_from_a_circle() -> None:
    angle = np.linspace(0.0, 1.5 * np.pi, 200)
    line = _Line(2.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    for radius in (0.5, 1.9, 2.0, 2.1, 2.5, 5.0, 20.0):
        point = radius * np.array([np.cos(1.0), np.sin(1.0)])
        # positive on the left of a turn to the left: inside
        assert line.signed_distance(point) == pytest.approx(2.0 - radius, abs=1e-7)


def test_line__points_that_coincide_count_once() -> None:
    line = _Line(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]))
    assert line.signed_distance(np.array([1.5, 0.25])) == pytest.approx(0.25)
    assert line.places[-1] == 3.0


def test_first_maximum__where_the_manifold_turns_back() -> None:
    assert _first_maximum(np.array([0.0, 1.0, 3.0, 2.0, 5.0, 4.0])) == 2
    with pytest.raises(ValueError, match="does not turn back"):
        _first_maximum(np.arange(5.0))


def arches(height: float) -> tuple[Manifold, Manifold]:
    """Return an unstable manifold y = height - x^2 that turns back at x = 2.5, and the line y = 0 as the stable one."""
    x = np.linspace(-2.0, 2.0, 161)
    unstable = np.stack([x, height - x**2], axis=-1)
    line = np.linspace(-4.0, 4.0, 401)[:, None] * [1.0, 0.0]
    return Manifold(unstable, np.linspace(0.0, 1.0, 161), False), Manifold(line, np.linspace(0.0, 1.0, 401), True)


@pytest.mark.parametrize(("height", "largest"), [(-0.3, -0.3), (0.0123, 0.0123)])
def test_extremes__of_an_arch_over_a_line(height, largest) -> None:
    unstable, stable = arches(height)
    saddle = SimpleNamespace(scales=np.ones(2), state=np.array([0.0, -10.0]))
    least, most = _extremes(unstable, stable, saddle)
    assert most == pytest.approx(largest, abs=1e-9)
    assert least == pytest.approx(height - 4.0, abs=1e-3)


def test_extremes__count_in_scales() -> None:
    unstable, stable = arches(0.3)
    scales = np.array([1.0, 0.5])
    wide = [Manifold(m.points * scales, m.time, m.stable) for m in (unstable, stable)]
    saddle = SimpleNamespace(scales=scales, state=np.array([0.0, -5.0]))
    assert _extremes(*wide, saddle)[1] == pytest.approx(0.3, abs=1e-9)


def test_first_tangency__is_the_root_of_the_gap(monkeypatch) -> None:
    """The largest distance of an arch that rises as p^3 - 2 changes its sign at the cube root of 2."""
    monkeypatch.setattr(analysis, "gap", lambda p, sides, resolution: (-4.0, p**3 - 2.0))
    assert first_tangency(lambda p: p, 1.0, 1.5, (1.0, 1.0)) == pytest.approx(2.0 ** (1.0 / 3.0), abs=1e-8)
    # the same with the other sign: distances are positive while the manifolds are apart
    monkeypatch.setattr(analysis, "gap", lambda p, sides, resolution: (2.0 - p**3, 4.0))
    assert first_tangency(lambda p: p, 1.0, 1.5, (1.0, 1.0)) == pytest.approx(2.0 ** (1.0 / 3.0), abs=1e-8)


@pytest.mark.parametrize(("low", "high", "words"), [(0.5, 1.0, "are apart"), (1.5, 2.0, "cross")])
def test_first_tangency__needs_one_value_apart_and_one_across(monkeypatch, low, high, words) -> None:
    monkeypatch.setattr(analysis, "gap", lambda p, sides, resolution: (-4.0, p**3 - 2.0))
    with pytest.raises(ValueError, match=f"the manifolds {words} at both {low:g} and {high:g}"):
        first_tangency(lambda p: p, low, high, (1.0, 1.0))


def test_gap__refuses_maps_of_more_states() -> None:
    with pytest.raises(ValueError, match="has 3 states"):
        gap(SimpleNamespace(scales=np.ones(3)), (1.0, 1.0))


def test_oriented__side_one_points_to_larger_values_of_the_first_state() -> None:
    saddle = linear([[3.0, 1.0], [0.0, 0.25]])
    for stable in (False, True):
        for side in (1.0, -1.0):
            sign = _oriented(saddle, side, stable)
            assert np.sign(sign * saddle.direction(stable)[1][0]) == side


def test_needs_tangency__names_the_problem() -> None:
    def run_of(name: str) -> SimpleNamespace:
        model = load_model(name)
        parameters = "\n".join(f"{k} = {v!r}" for k, v in model.load().items())
        status = {"status": ("initial_condition", np.zeros(2, np.int8))}
        cube = xr.Dataset(status, {"frequency": 1.0}, {"model": name, "parameters": parameters})
        return SimpleNamespace(cube=lambda: cube, model=model)

    plane = run_of("duffing")
    options = {"low": 0.1, "high": 0.2}
    needs_tangency(plane, TangencyOptions(parameter="amplitude", **options))
    for run, changes, words in (
        (plane, {"parameter": "b"}, "unknown parameter 'b'"),
        (plane, {"parameter": "amplitude", "high": 0.05}, "interval 0.1 to 0.05 is empty"),
        (run_of("lorenz"), {"parameter": "rho"}, "has 3 states"),
    ):
        with pytest.raises(ValueError, match=words):
            needs_tangency(run, TangencyOptions(**{**options, **changes}))


def test_tangency_table__rows_of_tangencies_and_lines_of_the_others() -> None:
    columns = {
        "orbit": [0, 0],
        "orbit_period": [1, 1],
        "unstable_side": [1, -1],
        "stable_side": [1, 1],
        "value": [0.25, np.nan],
        "why_not": ["", "the manifolds cross at both 1 and 2."],
    }
    ds = xr.Dataset({k: ("tangency", np.array(v)) for k, v in columns.items()}, attrs={"parameter": "frequency"})
    table = tangency_table(ds)
    assert table.rows == [{"orbit": 0, "period": 1, "unstable_side": 1, "stable_side": 1, "frequency_hz": 0.25}]
    assert table.lines[-1] == "orbit 0, sides -1, +1: none, the manifolds cross at both 1 and 2."


def test_manifolds_table__a_row_per_curve() -> None:
    generation = np.array([[0.0, 1.5, 3.25], [0.0, 0.5, np.nan]])
    columns = {"orbit": [2, 2], "orbit_period": [1, 1], "stable": [0, 1], "direction": [1, -1], "n_points": [3, 2]}
    variables = {name: ("curve", np.array(v, np.int32)) for name, v in columns.items()}
    variables["end"] = ("curve", np.array([ENDS.index("length"), ENDS.index("lost")], np.int8), code_flags(ENDS))
    rows = manifolds_table(xr.Dataset({**variables, "generation": (("curve", "point"), generation)})).rows
    assert [(r["manifold"], r["direction"], r["n_points"], r["end"]) for r in rows] == [
        ("unstable", 1, 3, "length"),
        ("stable", -1, 2, "lost"),
    ]
    assert [r["generations"] for r in rows] == [3.25, 0.5]
