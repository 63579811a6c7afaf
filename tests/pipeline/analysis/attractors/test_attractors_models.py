"""Attractors of another model: two states, no angles, no words for its motions, other units."""

import numpy as np
import pytest

import magpend
from magpend_core import load_model, sections
from pipeline.analysis.attractors import analysis
from pipeline.analysis.attractors.analysis import attractors_table
from pipeline.analysis.attractors.portraits import portraits
from pipeline.analysis.attractors.settling import settling_table
from pipeline.analysis.basins.analysis import basins_of
from pipeline.analysis.chaos.analysis import chaos_of
from pipeline.layout.vocabulary import ATTRACTS, CHAOTIC_SET
from tests.pipeline.analysis.cubes import WELLS, attributes_of, cube_of
from tests.pipeline.analysis.dense_sets import identify, match, rows_of

DUFFING = load_model("duffing")
FREQUENCY = 1.0 / (2.0 * np.pi)


def cube(preset, n, n_transient, n_keep, **overrides):
    """Cells of a Duffing oscillator on a grid of starts, as a run stores them."""
    parameters = DUFFING.load(preset, **overrides)
    axis = np.linspace(-2.0, 2.0, n)
    starts = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    found = sections(parameters, FREQUENCY, starts, n_transient=n_transient, n_keep=n_keep, rtol=1e-9, atol=1e-9)
    coords = {"x_0": axis, "v_0": axis, "frequency": FREQUENCY, "state_units": ("state", ["m", "m/s"])}
    ds = cube_of(found, ["x", "v"], ("x_0", "v_0"), (n, n), **coords).drop_vars("turns")
    flags = {"flag_values": np.arange(3, dtype=np.int8), "flag_meanings": "pending periodic bounded"}
    ds["status"].attrs = flags
    return ds.assign_attrs(attributes_of(parameters), rtol=1e-9, atol=1e-9)


@pytest.fixture(scope="module")
def chaotic():
    return cube("twin-well", 5, 200, 300)


@pytest.fixture(scope="module")
def strange(chaotic):
    return identify(chaotic)


@pytest.fixture(scope="module")
def two():
    return cube("twin-well-periodic", 6, 400, 16)


@pytest.mark.slow
def test_attractors__of_a_run_without_a_swept_parameter_have_exponents(tmp_path):
    """Ueda's attractor: the mean of its trajectories' exponents, near Sprott's .1034 (appendix A.4.5)."""
    spec = magpend.Spec("sweep", "x'' = 7.5*cos(omega*t) - .05*x' - x**3").with_parameters(omega=1.0)
    spec = spec.with_start_random(n=4, x=(-3.0, 3.0), x_dot=(-5.0, 5.0)).with_integration(n_transient=50, n_keep=200)
    run = magpend.run(spec.with_lyapunov(n_transient=50, n_periods=500), tmp_path / "ueda", workers=0)
    found, exponents = run.attractors(), run.cube()["lyapunov"].isel(exponent=0)
    assert found["kind"].values.tolist() == [CHAOTIC_SET]
    assert found["lyapunov_max"].item() == pytest.approx(exponents.mean().item(), rel=1e-12)
    assert found["lyapunov_max"].item() == pytest.approx(0.1034, abs=0.01)


@pytest.mark.slow
def test_attractors__of_two_sections_that_do_not_close_yet(tmp_path):
    """A damped oscillator of which each cell keeps two points; the tail decided on an empty half."""
    spec = magpend.Spec("sweep", "x'' = cos(omega*t) - 0.2*x' - 2*x").with_parameters(omega=1.0)
    spec = spec.with_start_random(n=4, x=(-3.0, 3.0), x_dot=(-3.0, 3.0)).with_integration(n_transient=10, n_keep=2)
    found = magpend.run(spec, tmp_path / "linear", workers=0).attractors()
    assert found["orbit_period"].values.tolist() == [1]


@pytest.mark.slow
def test_identify__chaos_without_angles(chaotic, strange, monkeypatch):
    """Grouping sets took the largest difference of no rotations."""
    assert strange["kind"].values.tolist() == [CHAOTIC_SET]
    assert strange["n_cells"].values.tolist() == [chaotic["status"].size]
    # x(t) -> -x(t + T/2) maps the one attractor on itself
    assert strange["mirror_partner"].values.tolist() == [0]
    assert {"rotation", "side"}.isdisjoint(strange.data_vars)
    assert strange["energy_min"].attrs["units"] == "J/kg"
    matched = match(strange)
    text = "\n".join(attractors_table(rows_of(matched)).lines)
    assert "rotation" not in text
    assert "side" not in text
    assert strange["stability"].values.tolist() == [ATTRACTS]
    assert strange["n_left"].values.tolist() == [0]
    # the sample stayed for ten times the 300 periods that the cube tells of
    least = strange["lifetime_low"].item()
    assert least >= 3000.0
    assert f"stayed, lifetime above {least:.0f} (95 %)" in text
    # the table of many points has the least of their bounds below it
    monkeypatch.setattr(analysis, "FEW_POINTS", 0)
    lines = attractors_table(rows_of(matched)).lines
    assert f"sets that attract by staying: lifetimes above {least:.0f} drive periods (95 %)" in lines
    # 0.158 per unit time (ChaosTools.jl, issue 301)
    assert strange["lyapunov_low"].item() < 0.158 < strange["lyapunov_high"].item()
    table = settling_table(rows_of(strange.expand_dims("frequency")))
    assert "chaotic set  attracts" in table.lines[2]


def test_identify__two_published_orbits(two):
    """Section points and multipliers, DynamicalSystemsBase.jl, issue 139; recomputed independently."""
    found = identify(two)
    assert found["orbit_period"].values.tolist() == [1, 1]
    points = found["attractor_points"].values[:, 0]
    assert points == pytest.approx(WELLS, abs=1e-9)
    multipliers = found["multiplier_real"].values + 1j * np.abs(found["multiplier_imag"].values)
    assert multipliers == pytest.approx(np.full((2, 2), -0.226806 + 0.581567j), abs=1e-6)
    assert found["mirror_partner"].values.tolist() == [1, 0]
    assert found["mirror_distance"].values.max() < 1e-7
    assert found["lyapunov_max"].values == pytest.approx(np.log(0.624230) * FREQUENCY, rel=1e-5)
    fractions = basins_of(two, rows_of(found))["fraction"].values
    assert fractions.sum() == pytest.approx(1.0)


def test_chaos__by_the_zero_one_test(chaotic, strange):
    found = chaos_of(chaotic, rows_of(strange))
    assert found["nature"].attrs["flag_meanings"].split()[found["nature"].item()] == "chaotic"
    assert found["median_zero_one"].item() > 0.95
    # 1.37 from 1e4 points
    assert found["attractor_correlation"].item() == pytest.approx(1.35, abs=0.15)
    found = portraits(strange, n_periods=2)
    assert found["orbit"].shape == (1, 513, 2)
    assert "points" not in found
