"""A virtual rig held against runs: its own model's, and one that is off."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from pipeline.results.ragged import dense
from pipeline.rig.measured.comparison import compare, compare_with
from pipeline.rig.measured.computed import Computed
from pipeline.rig.measured.declaration import SweepOptions
from pipeline.rig.measured.diagram import measure
from pipeline.rig.measured.figures import plot_comparison, plot_measured
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.problems import SpecError

from .conftest import RUN, walked

SWEPT = np.array([2.46, 2.48, 2.5, 2.52, 2.54])
LEFT, RIGHT = 1, 2
WAY = SweepOptions(transient=60)


@pytest.fixture(scope="module")
def measured(swept, pendulum):
    (up, _), (down, _) = swept
    return measure([up, down], WAY, parameters=pendulum)


@pytest.fixture(scope="module")
def compared(measured, run_directory):
    return compare(measured, AnalysedRun.of(run_directory))


def truth(pendulum, start, frequencies):
    """Periods along a sweep without noise, from other code: the engine's closure test on stepped walks."""
    options = {"n_transient": 600, "n_keep": 16, "stop_when_closed": True, "closure_tolerance": 1e-5}
    found = walked(pendulum, frequencies, start, rtol=1e-8, atol=1e-8, **options)
    return found.orbit_period[0]


@pytest.mark.slow
def test_measure__a_sweep_is_recovered(measured, swept, pendulum):
    """Frequencies, duty cycle, period and side of each step; sections as they truly were."""
    f = np.concatenate([SWEPT, SWEPT[::-1]])
    z = (measured["frequency"].values - f) / measured["frequency_error_hz"].values
    assert np.abs(z).max() < 4
    duty = (measured["duty_cycle"].values - pendulum["duty_cycle"]) / measured["duty_cycle_error"].values
    assert np.abs(duty).max() < 4
    assert list(measured["direction"].values) == ["up"] * 5 + ["down"] * 5
    # the right motion going up, the left one going down: told apart at every step
    assert measured["side"].values.tolist() == [RIGHT] * 5 + [LEFT] * 5
    for i, (_, true) in enumerate(zip(f, [*swept[0][1], *swept[1][1]], strict=True)):
        n = int(measured["n_sections"][i])
        # the last edge of a recording has no samples after it
        true = min((true[-n:], true[-n - 1 : -1]), key=lambda t: abs(t - measured["section"].values[i, :n]).sum())
        off = measured["section"].values[i, :n] - true
        noise = measured["section_noise"].values[i, :n].copy()
        # at 2.5 Hz all edges fall on the same place in a sample: half a millisecond may be hidden
        noise[:, :2] = np.hypot(noise[:, :2], true[:, 2:] * float(measured["instant_error_s"][i]))
        assert np.sqrt(((off / noise) ** 2).mean()) < 1.3, i


@pytest.mark.slow
def test_measure__periods_are_those_of_the_motion_without_noise(measured, swept, pendulum):
    """Where the noise-free walk has closed and the rig is sure; next to a bifurcation neither is."""
    periods, sure = measured["orbit_period"].values, measured["confidence"].values > 0.8
    up = truth(pendulum, swept[0][1][0][0], SWEPT)
    down = truth(pendulum, swept[1][1][0][0], SWEPT[::-1])
    true = np.concatenate([up, down])
    known = (true > 0) & sure
    assert known.sum() >= 7
    np.testing.assert_array_equal(periods[known], true[known])


@pytest.mark.slow
def test_compare__the_winner_is_the_attractor_that_the_rig_was_on(compared, run_directory):
    winners = compared["winner"].values
    sides = dense(AnalysedRun.of(run_directory).derive("attractors"), points=True)["side"]
    for step, winner in enumerate(winners):
        of_winner = sides.sel(attractor=winner).values
        assert set(of_winner[of_winner > 0]) == {RIGHT if step < 5 else LEFT}
    assert (compared["same_side"].values == 1).all()
    # the other motion is as far as the sides are apart
    assert (compared["runner_up"].values > 20 * compared["noise_floor"].values).all()


@pytest.mark.slow
def test_compare__the_true_model_is_a_noise_floor_away(compared):
    """Away from the doubling, where both settle slowly: about 1, with the polynomials' bias up to 2."""
    settled = np.isin(np.round(compared["frequency"].values, 2), [2.46, 2.54])
    assert (compared["distance_in_noise"].values[settled] < 2.0).all()
    assert (compared["same_period"].values[settled] == 1).all()


@pytest.mark.slow
def test_compare__window_edges_lie_within_the_step(compared, swept, pendulum):
    """Period 2 ends, going up, where it ends without noise: within a step of the rig's own sweep."""
    assert compared.sizes["edge"] == 2
    for edge, (start, way, sign) in enumerate(((swept[0][1][0][0], "up", 1), (swept[1][1][0][0], "down", -1))):
        fine = np.arange(2.46, 2.5401, 0.005)[::sign]
        periods = truth(pendulum, start, fine)
        first = 2 if sign > 0 else 1
        true = fine[np.flatnonzero(periods == first)[-1]] + 0.0025 * sign
        assert str(compared["edge_direction"].values[edge]) == way
        assert int(compared["edge_before_period"][edge]) == first
        assert abs(float(compared["edge_measured_hz"][edge]) - true) <= 0.02
        shift, error = (float(compared[f"edge_shift{n}_hz"][edge]) for n in ("", "_error"))
        # frequencies are measured to some microhertz
        assert abs(shift) <= error + 1e-5


@pytest.mark.slow
def test_compare__a_model_that_is_off_is_far_and_its_windows_shift(measured, compared, computed):
    """With 10 % more inertia of a link the doublings lie 30 mHz lower, and distances far above the noise."""
    off = computed(f"{RUN}\n[parameters]\noverrides = {{ J2 = 0.015739 }}\n")
    found = compare(measured, AnalysedRun.of(off))
    assert np.median(found["distance_in_noise"].values) > 5.0
    assert np.median(found["distance"].values / compared["distance"].values) > 3.0
    shifts = found["edge_shift_hz"].values
    errors = found["edge_shift_error_hz"].values
    assert (shifts > errors).all()
    np.testing.assert_allclose(shifts, 0.03, atol=errors.max())


@pytest.mark.slow
def test_compare__does_not_depend_on_the_order_of_the_recordings(swept, pendulum, run_directory, compared):
    (up, _), (down, _) = swept
    other = compare(measure([down, up], WAY, parameters=pendulum), AnalysedRun.of(run_directory))
    order = [*range(5, 10), *range(5)]
    for name in ("winner", "distance", "noise_floor", "orbit_period", "confidence"):
        np.testing.assert_array_equal(other[name].values[order], compared[name].values)


@pytest.mark.slow
def test_compare__angles_alone_are_compared_with_angles(swept, run_directory, pendulum):
    """A recording of one link: its angle and the rate of it; no side can be told."""
    part = swept[0][0].drop_vars("psi2")
    found = compare(measure([part], WAY, parameters=pendulum), AnalysedRun.of(run_directory))
    assert list(found["state"].values) == ["psi1", "psi1_dot"]
    assert "side" not in found
    assert (found["same_side"].values == -1).all()
    assert (found["distance_in_noise"].values[[0, 4]] < 2.0).all()


@pytest.mark.slow
def test_candidates__orbits_are_interpolated_between_frequencies(run_directory, pendulum):
    """Halfway between two frequencies of the run: against the orbit that the engine settles on there."""
    computed = Computed.of(AnalysedRun.of(run_directory), "pendulum")
    right = next(c for c in computed.candidates(2.545, pendulum.model.state_names) if c.side == RIGHT)
    exact = walked(pendulum, [2.545], right.points[0], n_transient=2000, n_keep=1).section[0, 0]
    nearest = computed.candidates(2.54, pendulum.model.state_names)
    off = np.abs(right.points - exact).max()
    assert off < 2e-4
    plain = next(c for c in nearest if c.side == RIGHT)
    assert off < 0.2 * np.abs(plain.points - exact).max()


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["side", "over"])
def test_figures__carry_what_they_draw(compared, run_directory, layout):
    computed = Computed.of(AnalysedRun.of(run_directory), "pendulum")
    measured = plot_measured(compared, computed.cube, layout=layout, degrees=True)
    assert {"value", "x_diagram", "y_diagram"} <= set(measured.data.variables)
    assert len({(ax.get_xlim(), ax.get_ylim()) for ax in measured.axes}) == 1
    drawn = plot_comparison(compared, computed).data["distance_in_noise"]
    np.testing.assert_array_equal(drawn, compared["distance_in_noise"])


@pytest.mark.slow
def test_compare__steps_off_the_runs_axis_have_no_winner(measured, run_directory):
    computed = Computed.of(AnalysedRun.of(run_directory), "pendulum")
    moved = measured.assign_coords(frequency=measured["frequency"] + 0.05)
    found = compare_with(moved, computed)
    assert (found["winner"].values[3:5] == -1).all()
    assert np.isnan(found["distance"].values[3:5]).all()


@pytest.mark.slow
def test_compare__frequencies_that_do_not_overlap_are_refused(measured, run_directory):
    other = measured.assign_coords(frequency=measured["frequency"] + 0.5)
    with pytest.raises(SpecError, match=r"measured from 2\.96 to 3\.04 Hz, computed from 2\.44 to 2\.56 Hz"):
        compare(other, AnalysedRun.of(run_directory))


@pytest.mark.slow
def test_measure__recordings_that_do_not_fit_are_refused(swept):
    (up, _), (down, _) = swept
    with pytest.raises(SpecError, match="their models are duffing, pendulum"):
        measure([up, down.assign_attrs(model="duffing")], WAY)
    with pytest.raises(SpecError, match="different states"):
        measure([up, down.drop_vars("psi2")], WAY)
    with pytest.raises(SpecError, match="no drive channel"):
        measure([up.drop_vars("drive")], WAY)
    with pytest.raises(SpecError, match="no edges"):
        measure([up.assign(drive=xr.ones_like(up["drive"]))], WAY)
