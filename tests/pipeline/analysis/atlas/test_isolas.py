"""An atlas of a map with orbits on which no cell ends: they are stable within a circle of the plane."""

import numpy as np
import pytest

from pipeline.runs.derive import derive
from pipeline.specification.problems import SpecError
from tests.pipeline.analysis.cubes import line, sweep

RADIUS = 0.3
DETACHED = {
    "name": "detached",
    "kind": "map",
    "states": {"x": {"scale": 1.0}},
    "parameters": {"p": 0.5, "q": 0.5, "r": 0.09},
    # fixed points: -2, and both roots of x^2 + (p - .5)^2 + (q - .5)^2 = .09, the upper one stable
    "equations": {"x": "x - 0.1*(x + 2)*(x^2 + (p - 0.5)^2 + (q - 0.5)^2 - r)"},
}
SPEC = {
    **sweep(
        DETACHED,
        {"kind": "random", "n": 4, "seed": 1, "x": [-3.0, -1.2]},
        axes={"p": line(0.0, 1.0, 7), "q": line(0.0, 1.0, 7)},
        lengths=(100, 8),
    ),
    "integration": {"n_transient": 100, "n_keep": 8},
}


def test_orbits_of_an_isola_are_found_where_all_are_searched(computed):
    """The fold is the circle; its region has the area pi r^2, and no cell shows the orbit there."""
    run = computed(SPEC)
    plain = derive(run, "atlas")
    assert (plain.sizes["region"], plain.sizes["curve"]) == (1, 0)
    found = derive(run, "atlas", {"isolas": 9, "curve_period": 1})
    assert found["n_hidden"].values.sum() == found["n_hidden"].values.max() == 1
    assert found["n_orbits"].values[4] == 3
    assert found.sizes["curve"] == 1
    n = int(found["n_points"][0])
    p, q = found["p"].values[0, :n], found["q"].values[0, :n]
    np.testing.assert_allclose(np.hypot(p - 0.5, q - 0.5), RADIUS, atol=1e-7)
    np.testing.assert_allclose(found["area"].values[1], np.pi * RADIUS**2, rtol=2e-3)
    assert found["n_effects"].values[0] == 0
    assert "no cell finds the stable orbit" in str(found["effect"].values[0])


def test_budget__is_spent_on_a_region_that_few_cells_know(computed):
    """The one region has 49 points of 4 cells: 107 starts at its middle make 299, and no round follows."""
    run = computed(SPEC)
    plain, more = derive(run, "atlas"), derive(run, "atlas", {"budget": 1000})
    assert (plain["region_cells"].values.tolist(), plain["is_thin"].values.tolist()) == ([196], [1])
    assert (more["region_cells"].values.tolist(), more["is_thin"].values.tolist()) == ([299], [0])
    assert (plain.sizes["change"], more.sizes["change"]) == (0, 0)
    further = derive(run, "further", {"budget": 1000})
    assert (further["point_cells"].values.tolist(), further["at_node"].values.tolist()) == ([107], [24])
    low = derive(run, "atlas", {"budget": 100})
    assert low["region_cells"].values.tolist() == [196]


def test_further_axes__need_a_value(computed):
    axes = {"p": line(0.0, 1.0, 3), "q": line(0.0, 1.0, 2), "r": line(0.05, 0.09, 2)}
    run = computed({**SPEC, "axes": axes})
    with pytest.raises(SpecError, match=r"also sweeps r \(2 values\); choose one of them: --at r=VALUE"):
        derive(run, "atlas")
    found = derive(run, "atlas", {"at": {"r": 0.09}})
    assert found["region_points"].values.tolist() == [6]
    with pytest.raises(SpecError, match="both p; give two parameters"):
        derive(run, "atlas", {"parameter": "p", "second": "p"})
    with pytest.raises(SpecError, match="a plane needs a sweep over two parameters"):
        derive(computed({**SPEC, "axes": {"p": axes["p"]}}), "atlas")
