"""Draws of the parameters carried through the branches of a run, on an oscillator with closed forms."""

import numpy as np
import pytest
import xarray as xr

from pipeline.analysis.branches.bands import GRID, moving_of, orbit_data, place_variables
from pipeline.analysis.branches.carrying import Along
from pipeline.plots.bifurcation import draw_bands
from pipeline.plots.labels import Measure
from pipeline.plots.style import WIDE, new_figure
from pipeline.results.draws import LEVELS, stretches
from pipeline.runs.derive import derive, shown_table, stored
from pipeline.runs.drawing import figure
from pipeline.specification.problems import SpecError
from pipeline.store.run import open_run
from tests.pipeline.bautin import SWEEP
from tests.pipeline.declared import complaints

pytestmark = pytest.mark.usefixtures("long_steps_of_a_file")


def write_draws(path, g, h):
    """Draws of g and h; m and w are those of the identification, which a run may change."""
    names = ["m", "g", "h", "w"]
    values = np.column_stack([np.full(len(g), 7.0), g, h, np.full(len(g), 60.0)])
    about = {"identified": "g h", "tied": ""}
    xr.Dataset({"value": (("draw", "parameter"), values)}, {"parameter": names}, about).to_netcdf(path, engine="scipy")


@pytest.fixture(scope="module")
def bench(tmp_path_factory, computed):
    folder = tmp_path_factory.mktemp("bands")
    directory = computed(SWEEP)
    random = np.random.default_rng(3)
    g, h = 1.2 + 0.1 * random.standard_normal(60), 0.05 + 0.01 * random.standard_normal(60)
    (folder / "fit").mkdir()
    write_draws(folder / "fit" / "posterior.nc", g, h)
    return folder, directory, g, h, derive(directory, "bands", {"posterior": str(folder / "fit")})


@pytest.mark.slow
def test_bands__bifurcations_are_those_of_the_closed_form(bench):
    _, _, g, h, found = bench
    words = str(found["kind"].attrs["flag_meanings"]).split()
    by_kind = {words[int(c)]: found["bifurcation_value"].values[:, k] for k, c in enumerate(found["kind"].values)}
    fold = h - 1 / (4 * g)
    np.testing.assert_allclose(by_kind["fold"], fold, atol=1e-6)
    np.testing.assert_allclose(by_kind["hopf"], h, atol=1e-6)
    row = next(row for row in shown_table("bands", found).rows if row["type"] == "fold")
    np.testing.assert_allclose([row["low"], row["median"], row["high"]], np.quantile(fold, LEVELS), atol=1e-6)
    assert (row["n_draws"], row["share"]) == (60, 1.0)
    assert row["value"] == pytest.approx(0.05 - 1 / 4.8, abs=1e-7)
    _, _, g, h, found = bench
    assert found.sizes["orbit"] > GRID
    is_stable = found["is_stable"].values
    everywhere = np.flatnonzero(found["share"].values == 1.0)
    for k in everywhere:
        m = float(found["parameter_value"][k])
        root = np.sqrt(1 + 4 * g * (m - h)) * (1 if is_stable[k] else -1)
        expected = np.quantile(np.sqrt((1 + root) / (2 * g)), LEVELS)
        np.testing.assert_allclose(found["section_level"].sel(state="x").values[:, k, 0], expected, atol=1e-6)
    assert {bool(s) for s in is_stable[everywhere]} == {True, False}
    assert not list(complaints(found, "bands", open_run(bench[1])))
    # left of the fold of half of the draws there is no band
    for _, _, chosen in stretches(found):
        assert found["parameter_value"].values[chosen].min() > np.median(h - 1 / (4 * g)) - 0.5 / (GRID - 1)


def test_orbit_data__a_branch_that_turns_back_is_cut_there():
    """A branch over [0, 1] and back, stable all the way: two stretches, not one that mixes both."""
    x = np.concatenate([np.linspace(-0.01, 1.0, 50), np.linspace(0.99, -0.01, 50)])
    branches = xr.Dataset(
        {
            "n_points": ("branch", [100]),
            "orbit_period": ("branch", [1]),
            "parameter": (("branch", "point"), x[None]),
            "n_unstable": (("branch", "point"), np.zeros((1, 100), int)),
            "section": (("branch", "point", "phase", "state"), np.linspace(0.0, 1.0, 100)[None, :, None, None]),
        }
    )
    data, guesses, places = orbit_data(Along(None, "m", 0.0, 0.9), branches)
    assert len(data) == 2 * GRID
    np.testing.assert_allclose([g[-1] for g in guesses], [d.value for d in data])
    found = [chosen for _, _, chosen in stretches(xr.Dataset(place_variables(data, places, np.ones(len(data)))))]
    assert [len(chosen) for chosen in found] == [GRID, GRID]
    sizes = np.array([g[0] for g in guesses])
    assert (np.diff(sizes[found[0]]) > 0.0).all()
    assert (np.diff(sizes[found[1]]) < 0.0).all()


@pytest.mark.slow
def test_bands__are_kept_and_depend_on_the_draws(bench, tmp_path):
    folder, directory, g, h, found = bench
    with pytest.raises(SpecError, match=r"has no posterior.nc"):
        derive(directory, "bands", {"posterior": str(tmp_path)})
    xr.testing.assert_equal(stored(directory, "bands"), found)
    write_draws(tmp_path / "posterior.nc", g[:10], h[:10])
    other = derive(directory, "bands", {"posterior": str(tmp_path)})
    np.testing.assert_array_equal(other["bifurcation_value"], found["bifurcation_value"][:10])
    some = derive(directory, "bands", {"posterior": str(folder / "fit"), "draws": 10})
    np.testing.assert_array_equal(other["bifurcation_value"], some["bifurcation_value"])
    with xr.open_dataset(folder / "fit" / "posterior.nc", engine="scipy") as ds:
        draws = ds.load()
    draws.assign_coords(parameter=["a", "b", "c", "d"]).to_netcdf(tmp_path / "other.nc", engine="scipy")
    with pytest.raises(SpecError, match=r"has the parameters a, b, c, d: another model's"):
        derive(directory, "bands", {"posterior": str(tmp_path / "other.nc")})


@pytest.mark.slow
def test_bands__along_an_identified_parameter_carry_the_others(computed, tmp_path):
    """Along g the fold lies at g = 1/(4 (h - m)), whatever g was drawn."""
    parameters = {name: {"value": v} for name, v in {"m": -0.1, "g": 1.2, "h": 0.05, "w": 6.0}.items()}
    model = {**SWEEP["model"], "parameters": parameters}
    directory = computed({**SWEEP, "model": model, "axes": {"g": {"start": 1.0, "stop": 2.0, "num": 5}}})
    random = np.random.default_rng(4)
    h = 0.05 + 0.01 * random.standard_normal(20)
    write_draws(tmp_path / "posterior.nc", 1.2 + 0.3 * random.standard_normal(20), h)
    found = derive(directory, "bands", {"posterior": str(tmp_path)})
    assert found.attrs["identified"] == "h"
    words = str(found["kind"].attrs["flag_meanings"]).split()
    k = [words[int(c)] for c in found["kind"].values].index("fold")
    np.testing.assert_allclose(found["bifurcation_value"].values[:, k], 1 / (4 * (h + 0.1)), atol=1e-6)


def test_moving_of__the_axis_replaces_the_value_that_was_drawn():
    drawn = xr.Dataset(attrs={"identified": "amplitude k", "tied": "c"})
    assert moving_of(drawn, "amplitude") == ["k", "c"]
    assert moving_of(drawn, "frequency") == ["amplitude", "k", "c"]
    assert moving_of(xr.Dataset(attrs={"identified": "amplitude"}), "amplitude") == []


@pytest.mark.parametrize(
    ("half", "told"), [(1e-4, "95 % of the orbits, at most 0.0002 m wide"), (0.1, "95 % of the orbits")]
)
def test_draw_bands__axes_hold_them_and_a_hairline_has_its_width(half, told):
    grid = np.linspace(0.0, 2.0, GRID)
    levels = np.stack([grid - half, grid, grid + half])[:, :, None, None]
    bands = xr.Dataset(
        {
            "section_level": (("level", "orbit", "phase", "state"), levels),
            "parameter_value": ("orbit", grid),
            "share": ("orbit", np.ones(GRID)),
            "bifurcation_value": (("draw", "bifurcation"), np.array([[2.4], [2.5], [2.6]])),
            "bifurcation_section": (("bifurcation", "phase", "state"), [[[3.0]]]),
            "is_border": ("bifurcation", [True]),
            "orbit_period": ("bifurcation", [1]),
            **{name: ("orbit", v) for name, v in (("branch", 0 * grid), ("run", 0 * grid), ("is_stable", grid > -1.0))},
            "step": ("orbit", np.arange(GRID)),
        },
        {"state": ["x"]},
        {"parameter_units": "1"},
    )
    ax = new_figure(3.0, bands, WIDE).add_subplot()
    ax.set_xlim(0.5, 1.5)
    ax.set_ylim(0.6, 1.4)
    labels = [str(handle.get_label()) for handle in draw_bands(ax, bands, Measure("x", "x", "m"))]
    assert labels == [told, "95 % of bifurcations"]
    assert ax.get_xlim()[0] < 0.0
    assert ax.get_xlim()[1] > 2.59
    assert ax.get_ylim()[0] < 0.0
    assert ax.get_ylim()[1] > 3.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["branches", "bifurcation"])
def test_figure__shades_the_bands_and_draws_the_intervals(bench, name):
    folder, directory, g, h, found = bench
    drawn = figure(directory, name, posterior=str(folder / "fit"))
    ax = drawn.axes[0]
    shades = [c for c in ax.collections if c.get_gid() == "band"]
    assert len(shades) == len(list(stretches(found))) > 1
    bars = [line.get_xdata() for line in ax.lines if line.get_gid() == "interval"]
    assert any(np.allclose(bar, np.quantile(h - 1 / (4 * g), [0.025, 0.975]), atol=1e-6) for bar in bars)
    assert "section_level_bands" in drawn.data
    assert "95 % of the orbits" in [t.get_text() for legend in drawn.legends for t in legend.get_texts()]
