"""One trajectory to a series on disk, under the model's drive or a recorded one, and whether it has closed."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from magpend_core import load_preset, run_branches, trajectory
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from pipeline.compute.simulate import TOLERANCE, closing_of, simulate
from pipeline.runs.exporting import save
from pipeline.specification.problems import SpecError
from pipeline.specification.recorded_drive import load_drive
from tests.pipeline.factories import edges

START = (0.2, 0.1, 0.0, 0.0)


@pytest.fixture(scope="module")
def series():
    return simulate(2.2, START, overrides={"q": 1.5}, n_transient=1, n_periods=2, samples_per_period=20)


def test_simulate__is_the_cores_trajectory(series):
    expected = trajectory(load_preset(q=1.5), 2.2, np.array(START), series.time.values)
    assert len(series.time) == 41
    assert series.time.values[0] == 1 / 2.2
    assert (series.psi1.values == expected[:, 0]).all()
    assert (series.psi2_dot.values == expected[:, 3]).all()
    # the high state lasts for duty_cycle = 0.4927 of a period
    assert (series.drive_torque.values[1:9] > 0).all()
    assert (series.drive_torque.values[11:19] < 0).all()
    assert all(series[name].attrs["units"] for name in (*series.data_vars, "time"))


def test_series__csv_and_netcdf_read_back(series, tmp_path):
    table = np.genfromtxt(save(series, tmp_path / "a.csv"), delimiter=",", names=True)
    states = ("psi1_rad", "psi2_rad", "psi1_dot_rad_per_s", "psi2_dot_rad_per_s")
    assert table.dtype.names[:7] == ("time_s", *states, "energy_J", "power_in_W")
    assert len(table.dtype.names) == 1 + len(series.data_vars)
    assert (table["psi1_rad"] == series.psi1.values).all()
    with xr.open_dataset(save(series, tmp_path / "a.nc"), engine="scipy") as read:
        assert read.attrs["frequency_hz"] == 2.2
        assert (read.psi2.values == series.psi2.values).all()


def test_simulate__all_problems_at_once():
    with pytest.raises(SpecError) as caught:
        simulate(
            float("nan"),
            (float("inf"), 0, 0, 0),
            overrides={"qq": 1},
            n_transient=-1,
            n_periods=0,
            samples_per_period=0,
            rtol=float("nan"),
            atol=-1,
            method="dop853",
        )
    starts = (
        "method = 'dop853': must be dopri5 or rodas5p",
        "frequency_hz",
        "rtol",
        "atol",
        "psi1",
        "n_transient",
        "n_periods",
        "samples",
        "'qq'",
    )
    assert len(caught.value.problems) == len(starts)
    for start in starts:
        assert any(p.startswith(start) for p in caught.value.problems)


@pytest.mark.parametrize(
    ("name", "value"), [("rtol", 1.0), ("rtol", 1e-14), ("atol", 1.0), ("atol", 0.0), ("n_transient", 10**9)]
)
def test_simulate__has_the_bounds_of_specifications(name, value):
    from pydantic import ValidationError

    from pipeline.specification.tables import Integration

    with pytest.raises(ValidationError):
        Integration(**{name: value})
    with pytest.raises(SpecError, match=f"{name} = "):
        simulate(2.2, (0.1, 0.0, 0.0, 0.0), **{name: value})


# ---- under a recorded drive ------------------------------------------------------------------------------

HZ, SWINGING = 2.2, (0.3, -0.1, 0.0, 0.0)


@pytest.fixture
def even(tmp_path):
    """A drive file of eight equal periods from 1.5 s on."""
    path = tmp_path / "even.csv"
    path.write_text(edges(8, HZ, start=1.5), "utf-8")
    return path


@pytest.fixture
def torque(tmp_path):
    """A torque that takes other values from sample to sample, and has three rising edges."""
    times = np.linspace(0, 2, 81)
    level = np.sign(np.sin(2 * np.pi * (times - 0.1) / 0.55)) + 0.2 * np.cos(31 * times)
    rows = [f"{t!r},{x!r}" for t, x in zip(times.tolist(), level.tolist(), strict=True)]
    path = tmp_path / "torque.csv"
    path.write_text("time_s,drive\n" + "\n".join(rows) + "\n", "utf-8")
    return path


def test_simulate__equal_periods_are_the_ordinary_series(even):
    plain = simulate(HZ, SWINGING, n_transient=2, n_periods=6, samples_per_period=20)
    found = simulate(None, SWINGING, drive=even, n_transient=2, n_periods=6, samples_per_period=20)
    assert list(found.data_vars) == list(plain.data_vars)
    np.testing.assert_allclose(found.time, 1.5 + plain.time, atol=1e-12)
    for name in plain.data_vars:
        # at the flank of the drive times that differ in their last digit differ in torque
        np.testing.assert_allclose(found[name], plain[name], atol=1e-6, err_msg=name)
    np.testing.assert_allclose(found.section_times, 1.5 + np.arange(2, 9) / HZ)
    assert found.attrs["drive"] == "edges"
    assert found.attrs["frequency_hz"] == pytest.approx(HZ)


@pytest.mark.slow
def test_simulate__goes_over_the_whole_drive(even, torque):
    whole = simulate(None, SWINGING, drive=even, samples_per_period=10)
    assert whole.sizes["time"] == 81
    assert (float(whole.time[0]), float(whole.time[-1])) == (1.5, 1.5 + 8 / HZ)
    whole = simulate(None, SWINGING, drive=torque, samples_per_period=50)
    assert (float(whole.time[0]), float(whole.time[-1])) == (0.0, 2.0)


def test_simulate__part_is_of_the_whole(torque):
    drive = load_drive(torque)
    assert drive.n_periods == 4
    part = simulate(None, SWINGING, drive=torque, n_transient=2, n_periods=1, samples_per_period=40, rtol=1e-11)
    assert float(part.time[0]) == pytest.approx(drive.sections_s[1])
    assert float(part.time[-1]) == pytest.approx(drive.sections_s[2])
    whole = simulate(None, SWINGING, drive=torque, samples_per_period=2000, rtol=1e-11)
    np.testing.assert_allclose(part.psi1, np.interp(part.time, whole.time, whole.psi1), atol=1e-5)


def test_simulate__quantities_are_of_the_recorded_torque(torque):
    without_magnets = {"alpha1": 0.0, "alpha2": 0.0}
    found = simulate(None, SWINGING, drive=torque, overrides=without_magnets, samples_per_period=333)
    time, level = np.loadtxt(torque, delimiter=",", skiprows=1).T
    np.testing.assert_allclose(found.drive_torque, np.interp(found.time, time, level), atol=1e-9)
    # what the drive puts in and friction takes out is what the energy changes by
    power = (found.power_in - found.power_dissipated).values
    given = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(found.time))])
    np.testing.assert_allclose(found.energy - found.energy[0], given, atol=2e-4)


def test_simulate__section_is_that_of_a_run(even):
    found = simulate(None, SWINGING, drive=even, samples_per_period=1, rtol=1e-11, atol=1e-11)
    packed = load_preset().pack().reshape(1, 1, -1)
    options = {"n_transient": 0, "n_keep": 8, "rtol": 1e-11, "atol": 1e-11}
    expected = run_branches(packed, np.array([[HZ]]), np.array([SWINGING]), system=PENDULUM_FITTED, **options).section[
        0, 0
    ]
    wrapped = np.angle(np.exp(1j * found.psi2.values[1:]))
    np.testing.assert_allclose(wrapped, expected[:, 1], atol=1e-7)
    np.testing.assert_allclose(found.psi1_dot[1:], expected[:, 2], atol=1e-7)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"frequency_hz": 2.0}, "frequency_hz = 2.0: the recorded drive"),
        ({"n_periods": 9}, "n_transient = 0 and n_periods = 9 are 9 drive periods, and even.csv has 8"),
        ({"n_transient": 8}, "n_transient = 8 and n_periods = 1 are 9 drive periods"),
        ({"n_periods": 0}, "n_periods = 0: must be at least 1"),
        ({"model": "duffing"}, "measured edges need a model with a parameter duty_cycle"),
    ],
)
def test_simulate__refuses(even, options, words):
    own = {"frequency_hz": None, **options}
    state = (0.3, 0.0) if "model" in options else SWINGING
    with pytest.raises(SpecError) as caught:
        simulate(initial_state=state, drive=even, **own)
    assert words in str(caught.value)
    assert len(caught.value.problems) == 1


def test_simulate__needs_a_frequency_or_a_drive():
    with pytest.raises(SpecError, match="frequency_hz = None: must be a finite number"):
        simulate(None, SWINGING)


# ---- whether a motion has closed: sections whose approach is known on paper ------------------------------

PLANE = SimpleNamespace(is_angle=(True, False), scales=(1.0, 10.0))
ORBITS = json.loads((Path(__file__).parents[2] / "core" / "data" / "orbits.json").read_text("utf-8"))


def approach(multiplier, n=129, start=1e-2, period=1):
    """Sections that come closer to an orbit by a factor in each period, from `start`."""
    k = np.arange(n)
    orbit = 0.3 * (k % period)
    return np.stack([3.1 + orbit + start * multiplier**k, np.zeros(n)], axis=1)


@pytest.mark.parametrize("period", [1, 2, 3])
@pytest.mark.parametrize("multiplier", [0.97, 0.99])
def test_closing_of__the_periods_to_go_are_those_of_the_multiplier(multiplier, period):
    """From 0.01 the distance is `TOLERANCE` after log(1e-4)/log(multiplier) periods."""
    n = 129
    found = closing_of(approach(multiplier, n, period=period), PLANE)
    expected = math.log(TOLERANCE / 1e-2) / math.log(multiplier) - (n - 1)
    assert found.period == period
    assert not found.is_closed
    # the bound is that of the last quarter's first pair: its age is what the time is too long by, at most
    assert expected - 1 <= found.to_go <= expected + n / 4 + period
    assert f"--transient {300 + math.ceil(found.to_go)}" in found.sentence(300)


@pytest.mark.parametrize("period", [1, 2, 6])
def test_closing_of__a_closed_motion_has_its_smallest_period(period):
    for sections in (approach(0.8, period=period), approach(-0.85, start=0.1, period=period)):
        found = closing_of(sections, PLANE)
        assert found.is_closed
        assert found.period == period
        assert "closed: the motion repeats after" in found.sentence(0)


def test_closing_of__angles_are_on_the_circle():
    turning = approach(0.5)
    turning[:, 0] += 2 * np.pi * np.arange(len(turning))
    assert closing_of(turning, PLANE).is_closed


def test_closing_of__neither_chaos_nor_a_torus_is_given_a_time():
    k = np.arange(129)
    torus = np.stack([np.cos(k), np.sin(k)], axis=1)
    logistic = [0.4]
    for _ in range(5000):
        logistic.append(4.0 * logistic[-1] * (1.0 - logistic[-1]))
    clouds = [np.stack([logistic[i : i + 129], np.zeros(129)], axis=1) for i in range(0, 4800, 100)]
    for sections in (torus, *clouds):
        found = closing_of(sections, PLANE)
        assert math.isinf(found.to_go)
        assert "does not shrink steadily" in found.sentence(0)


def test_closing_of__nothing_is_said_of_too_few_sections():
    assert closing_of(approach(0.5, n=7), PLANE) is None


def test_simulate__says_that_the_left_orbit_is_closed():
    """The orbit comes from another integrator (tests/core/data); a start on it has closed at once."""
    orbit = next(o for o in ORBITS if o["frequency_hz"] == 2.2 and o["section"][0] < 0.0)
    ds = simulate(2.2, orbit["section"], n_transient=100, n_periods=2, samples_per_period=20)
    assert ds.attrs["orbit_period"] == 1
    assert ds.attrs["closing"].startswith("closed: the motion repeats after 1 drive period (")


@pytest.mark.slow
def test_simulate__says_that_300_periods_are_too_few_and_that_1000_will_do():
    start = (0.0, math.radians(20.0), 0.0, 0.0)
    early, late = (simulate(2.48, start, n_transient=n, n_periods=4, samples_per_period=20) for n in (300, 1000))
    assert early.attrs["orbit_period"] == 0
    assert early.attrs["closing"].startswith("not closed")
    assert late.attrs["orbit_period"] == 2
    # independent of the sentence: two periods later the last section is there again
    last = np.stack([late[name].values[::20] for name in ("psi1", "psi2")])
    assert np.abs(last[:, 4] - last[:, 2]).max() < TOLERANCE < np.abs(last[:, 4] - last[:, 3]).max()


@pytest.mark.slow
def test_simulate__by_the_stiff_method_what_no_explicit_one_reaches():
    equations = {"x": "v", "v": "mu*(1 - x**2)*v - x"}
    model = {"name": "relaxation", "states": {"x": {}, "v": {}}, "parameters": {"mu": 1000.0}, "equations": equations}
    options = {"model": model, "n_periods": 1, "samples_per_period": 50}
    found = simulate(1.0 / 1500.0, (2.0, 0.0), method="rodas5p", **options)
    from scipy.integrate import solve_ivp

    def rates(t, y):
        return y[1], 1000.0 * (1.0 - y[0] ** 2) * y[1] - y[0]

    own = solve_ivp(rates, (0.0, 1500.0), (2.0, 0.0), "Radau", found.time.values, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found.x.values, own.y[0], atol=1e-5)
