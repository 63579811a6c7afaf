"""Frequency responses against closed forms, a harmonic balance of the tests' own, and scipy."""

from __future__ import annotations

import re

import numpy as np
import pytest
from matplotlib.text import Text
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import magpend
from magpend_core.models import load_model
from pipeline.analysis.response.orbits import Orbit, lags_of, measures_of
from pipeline.runs.derive import shown_table
from pipeline.specification.problems import SpecError
from tests.pipeline.analysis.cubes import swept

pytestmark = pytest.mark.usefixtures("long_steps_of_a_file")

OMEGA = 2.0 * np.pi

MEASURED = ((0.1, 0.1, 0.2, 0.1), (0.3, 0.2, 0.9, 0.4), (0.25, 0.15, 0.5, 0.2))
"""Levels of the force, frequencies, amplitudes and phases of measured points; one level was not computed."""


@pytest.fixture(scope="module")
def hardening(tmp_path_factory):
    """Response of x'' + .1 x' + x + x^3 = F cos(w t) at two levels of the force, with a quantity."""
    model = magpend.model(
        "x'' = -0.1*x' - x - b*x**3 + F*cos(2*pi*f*t)",
        name="hardening", b=1.0, F=0.3, quantities={"energy": "x_dot**2/2 + x**2/2 + b*x**4/4"},
    )  # fmt: skip
    out, starts = tmp_path_factory.mktemp("hardening") / "run", {"x": (-3, 3), "x_dot": (-3, 3)}
    return swept(model, out, starts, (300, 4), F=[0.1, 0.3], frequency_hz=(0.5 / OMEGA, 2.0 / OMEGA, 9))


@pytest.fixture(scope="module")
def response(hardening):
    return hardening.response(parameter="frequency_hz")


def points_of(ds):
    """Indices (branch, point) of a few orbits of all branches."""
    return [(i, j) for i in range(ds.sizes["branch"]) for j in range(0, int(ds["n_points"][i]), 10)]


def balanced(force, omega, guess, n=9):
    """Complex amplitudes of the odd harmonics up to 2n - 1 of the hardening oscillator, by harmonic balance."""
    orders = np.arange(1, 2 * n, 2)
    phases = np.exp(1j * np.outer(np.arange(8 * n) * OMEGA / (8 * n), orders))

    def residual(packed):
        c = packed[:n] + 1j * packed[n:]
        x = (phases @ c).real
        cubic = 2.0 * (phases.conj().T @ x**3) / len(x)
        own = (1.0 - (orders * omega) ** 2 + 0.1j * orders * omega) * c + cubic
        own[0] -= force
        return np.concatenate([own.real, own.imag])

    start = np.zeros(n, complex)
    start[: len(guess)] = guess
    found, _, flag, message = fsolve(residual, np.concatenate([start.real, start.imag]), xtol=1e-13, full_output=True)
    assert flag == 1, message
    return found[:n] + 1j * found[n:]


@pytest.mark.slow
def test_duffing__agrees_with_harmonic_balance(response):
    for i, j in points_of(response):
        one = response.isel(branch=i, point=j).sel(channel="x")
        omega = OMEGA * float(one["frequency"])
        first = float(one["harmonic_amplitude"][0]) * np.exp(-1j * float(one["phase"][0]))
        c = balanced(float(response["F"][i]), omega, [first])
        np.testing.assert_allclose(one["harmonic_amplitude"][::2], np.abs(c[:3]), rtol=1e-6, atol=1e-10)
        assert float(one["phase"][0]) == pytest.approx(-np.angle(c[0]), abs=1e-7)
        t = np.linspace(0.0, OMEGA, 40_000)
        x = (np.exp(1j * np.outer(t, np.arange(1, 18, 2))) @ c).real
        assert float(one["amplitude"]) == pytest.approx(np.ptp(x) / 2.0, rel=1e-6)
        assert float(one["rms"]) == pytest.approx(np.sqrt(np.sum(np.abs(c) ** 2) / 2.0), rel=1e-6)


@pytest.mark.slow
def test_duffing__has_the_folds_and_the_landings_of_an_independent_integration(response):
    jumps = response.sizes["jump"]
    assert jumps == 4  # up and down at each of the two levels
    for k in range(jumps):
        event = int(response["jump_bifurcation"][k])
        force = float(response["F"][int(response["of_branch"][event])])
        omega = OMEGA * float(response["jump_beyond"][k])

        def rates(t, y, force=force, omega=omega):
            return [y[1], -0.1 * y[1] - y[0] - y[0] ** 3 + force * np.cos(omega * t)]

        # two starts: the amplitude beyond is that of the only orbit there
        for start in ([0.0, 0.0], [2.0, 0.0]):
            settled = solve_ivp(rates, (0.0, 160 * OMEGA / omega), start, rtol=1e-9, atol=1e-9).y[:, -1]
            period = solve_ivp(
                rates, (0.0, OMEGA / omega), settled, rtol=1e-10, atol=1e-10, t_eval=np.linspace(0, OMEGA / omega, 4001)
            ).y[0]
            assert float(response["jump_amplitude"][k, 0]) == pytest.approx(np.ptp(period) / 2.0, rel=1e-4)
        rises = bool(response["jump_rises"][k])
        assert (float(response["jump_beyond"][k]) > float(response["bifurcation_frequency"][event])) == rises
        down = float(response["jump_amplitude"][k, 0]) < float(response["bifurcation_amplitude"][event, 0])
        assert down == rises  # a hardening spring falls off as the frequency rises
    lines = "\n".join(shown_table("response", response).lines)
    assert lines.count("rises") == lines.count("falls") == 2


@pytest.mark.slow
def test_duffing__has_a_response_without_a_bifurcation_to_a_force_called_amplitude(tmp_path):
    axes = {"amplitude": [0.01, 0.02], "frequency_hz": (0.1, 0.13, 3)}
    run = swept("duffing", tmp_path / "run", [(0.0, 0.0)], (100, 4), parameters={"preset": "hardening"}, **axes)
    ds = run.response(parameter="frequency_hz")
    assert (ds.sizes["bifurcation"], ds.sizes["branch"]) == (0, 2)
    largest = ds["amplitude"].sel(channel="x").max("point")
    np.testing.assert_allclose(largest / ds["parameter_amplitude"], largest[0] / 0.01, rtol=1e-2)
    row = shown_table("response", ds).rows[0]
    assert row["parameter_amplitude"] == 0.01
    assert row["amplitude"] == float(ds["amplitude"][0, 0, 0])


@pytest.mark.slow
def test_quantities__are_measured_like_states(response):
    i, j = points_of(response)[2]
    one = response.isel(branch=i, point=j)
    c = balanced(float(response["F"][i]), OMEGA * float(one["frequency"]), [
        float(one["harmonic_amplitude"][0, 0]) * np.exp(-1j * float(one["phase"][0, 0]))
    ])  # fmt: skip
    t, orders = np.linspace(0.0, OMEGA, 20_000, endpoint=False), np.arange(1, 18, 2)
    waves, omega = np.exp(1j * np.outer(t, orders)), OMEGA * float(one["frequency"])
    x, v = (waves @ c).real, (waves @ (1j * orders * omega * c)).real
    energy = v**2 / 2 + x**2 / 2 + x**4 / 4
    own = one.sel(channel="energy")
    assert float(own["mean"]) == pytest.approx(energy.mean(), rel=1e-7)
    assert float(own["amplitude"]) == pytest.approx(np.ptp(energy) / 2.0, rel=1e-6)
    assert float(own["dominant_order"]) == 2.0


@pytest.mark.slow
def test_linear__is_exact():
    """x'' + 2 z x' + x = F sin(w t): amplitude and lag in closed form, whatever the drive's phase."""
    model = load_model(magpend.model("x'' = -2*z*x' - x + F*sin(2*pi*f*t)", name="linear", z=0.05, F=1.5))
    base = model.load(None)
    omega = np.array([0.4, 0.99, 1.0, 2.5])
    answer = 1.5 / (1.0 - omega**2 + 0.1j * omega)
    starts = np.stack([(answer * -1j).real, (1j * omega * answer * -1j).real], axis=1)
    orbits = [Orbit(base, state, OMEGA / w, 1) for state, w in zip(starts, omega, strict=True)]
    found = measures_of(orbits, 3)
    np.testing.assert_allclose(found.amplitude[:, 0], np.abs(answer), rtol=1e-9)
    np.testing.assert_allclose(found.amplitude[:, 1], np.abs(omega * answer), rtol=1e-9)
    np.testing.assert_allclose(found.rms[:, 0], np.abs(answer) / np.sqrt(2.0), rtol=1e-10)
    np.testing.assert_allclose(np.abs(found.harmonics[:, 0, 0]), np.abs(answer), rtol=1e-10)
    np.testing.assert_allclose(found.mean[:, 0], 0.0, atol=1e-10)
    lags = lags_of(orbits, found.harmonics)
    np.testing.assert_allclose(lags[:, 0, 0], -np.angle(answer), atol=1e-9)
    assert np.isnan(lags[:, 0, 1:]).all()  # harmonics that vanish have no phase


@pytest.mark.slow
def test_subharmonics__and_turning_angles():
    """A pendulum that turns, and one with period 2, against scipy's dense output."""
    model = load_model(
        magpend.model(
            "th'' = -c*th' - sin(th) + b + A*cos(2*pi*f*t)",
            name="turning",
            states={"th": {"unit": "rad", "on_circle": True}},
            c=0.25,
            b=0.6,
            A=1.0,
        )
    )
    base = model.load(None)
    orbits, dense = [], []
    for omega, amplitude in ((1.2, 1.0), (0.9, 0.4)):

        def rates(t, y, omega=omega, amplitude=amplitude):
            return [y[1], -0.25 * y[1] - np.sin(y[0]) + 0.6 + amplitude * np.cos(omega * t)]

        settings = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}
        seconds = OMEGA / omega
        states = [solve_ivp(rates, (0.0, 400 * seconds), [0.3, 0.0], **settings).y[:, -1]]
        for _ in range(8):
            states.append(solve_ivp(rates, (0.0, seconds), states[-1], **settings).y[:, -1])
        away = [abs(np.angle(np.exp(1j * (s[0] - states[0][0])))) + abs(s[1] - states[0][1]) for s in states[1:]]
        period = 1 + int(np.flatnonzero(np.array(away) < 1e-7)[0])
        t = np.linspace(0.0, period * seconds, 8192 * period + 1)
        th = solve_ivp(rates, (0.0, t[-1]), states[0], t_eval=t, **settings).y[0]
        turns = round((th[-1] - th[0]) / OMEGA)
        dense.append((period, turns, th - OMEGA * turns * t / t[-1]))
        orbits.append(Orbit(base.replace(A=amplitude), states[0], period * seconds, period))
    assert any(turns for _, turns, _ in dense)
    for orbit, (period, _, th) in zip(orbits, dense, strict=True):
        found = measures_of([orbit], 4)
        parts = 2.0 * np.fft.rfft(th[:-1]) / (len(th) - 1)
        np.testing.assert_allclose(found.harmonics[0, 0], parts[period * np.arange(1, 5)], atol=1e-8)
        assert found.amplitude[0, 0] == pytest.approx(np.ptp(th) / 2.0, rel=1e-7)
        assert found.dominant[0, 0] == pytest.approx((1 + np.abs(parts[1:100]).argmax()) / period)
        assert found.error[0, 0] < 1e-7


def test_flow__has_the_harmonics_of_its_orbit():
    """Van der Pol's limit cycle; its amplitude is the published 2.0086198608748 at mu = 1 (A. C. Fowler's table)."""
    model = load_model(magpend.model("x' = v\nv' = mu*(1 - x**2)*v - x", name="vdp", mu=1.0))
    base = model.load(None)

    def rates(t, y):
        return [y[1], (1.0 - y[0] ** 2) * y[1] - y[0]]

    def upward(t, y):
        return y[1]

    upward.direction = -1.0  # at the maxima of x
    settled = solve_ivp(rates, (0.0, 200.0), [1.0, 0.0], events=upward, method="DOP853", rtol=1e-12, atol=1e-12)
    start, seconds = settled.y_events[0][-1], float(np.diff(settled.t_events[0])[-1])
    found = measures_of([Orbit(base, start, seconds, 1)], 3)
    assert found.amplitude[0, 0] == pytest.approx(start[0], rel=1e-8)
    t = np.linspace(0.0, seconds, 4096, endpoint=False)
    x = solve_ivp(rates, (0.0, seconds), start, t_eval=t, method="DOP853", rtol=1e-12, atol=1e-12).y[0]
    np.testing.assert_allclose(found.harmonics[0, 0], (2.0 * np.fft.rfft(x) / len(x))[1:4], atol=1e-8)


def cycles_run(folder):
    """A run along mu of r' = r (mu + r^2 - r^4): cycles of r^2 = (1 +- sqrt(1 + 4 mu)) / 2, which fold at -1/4."""
    model = magpend.model(
        "x' = x*g - 2*y\ny' = y*g + 2*x\ng = mu + x**2 + y**2 - (x**2 + y**2)**2", name="cycles", mu=0.1
    )
    return swept(model, folder / "run", [(1.0, 0.0)], (200, 4), section=("y", "up"), mu=(-0.3, 0.2, 6))


@pytest.mark.slow
def test_flow__cycles_in_closed_form_that_end_at_a_fold(tmp_path):
    ds = cycles_run(tmp_path).response(parameter="mu")
    cycle = ds["orbit_period"].values.tolist().index(1)
    one = ds.isel(branch=cycle, point=slice(0, int(ds["n_points"][cycle])))
    stable = one["n_unstable"].values == 0
    mu = one["mu"].values[stable]
    exact = np.sqrt((1.0 + np.sqrt(1.0 + 4.0 * mu)) / 2.0)
    np.testing.assert_allclose(one["amplitude"].values[stable, 0], exact, rtol=1e-7, atol=0.0)
    np.testing.assert_allclose(one["harmonic_amplitude"].values[stable, 0, 0], exact, rtol=1e-7, atol=0.0)
    (jump,) = range(ds.sizes["jump"])
    assert float(ds["bifurcation_mu"][ds["jump_bifurcation"][jump]]) == pytest.approx(-0.25, abs=1e-7)
    assert not ds["jump_rises"][jump]
    # beyond, trajectories spiral to rest
    assert (ds["jump_amplitude"][jump] < 1e-6).all()
    assert re.search(r"^ *-0\.25 +LP +falls .* rest$", "\n".join(shown_table("response", ds).lines), re.MULTILINE)


@pytest.mark.slow
def test_figure__shows_levels_and_measured_points(hardening, response, tmp_path):
    file = tmp_path / "measured.csv"
    file.write_text("F,omega,amplitude,phase\n" + "".join(f"{f},{OMEGA * h!r},{a},{p}\n" for f, h, a, p in MEASURED))
    upper, lower = hardening.plot.response(parameter="frequency_hz", points=str(file))
    drawn = [line for line in upper.get_lines() if line.get_linestyle() == "-"]
    assert len({line.get_color() for line in drawn}) == 2
    solid = np.concatenate([line.get_xydata() for line in drawn])
    stable = (response["n_unstable"] == 0).values
    own = response["amplitude"].sel(channel="x").values[stable]
    assert set(own).issubset(set(solid[:, 1]))
    points = [line for line in lower.get_lines() if line.get_marker() == "o" and line.get_linestyle() == "None"]
    np.testing.assert_allclose(np.concatenate([line.get_xdata() for line in points]), [0.1, 0.2, 0.15], rtol=1e-12)
    assert [list(line.get_ydata()) for line in points] == [[0.1], [0.4], [0.2]]
    # of a level that was computed in its colour, of another one black
    colours = {line.get_markerfacecolor() for line in points}
    assert colours == {line.get_color() for line in drawn} | {"black"}
    assert [text.get_text() for text in upper.figure.legends[0].get_texts()][-3:] == [
        "measured, F = 0.1", "measured, F = 0.3", "measured at other levels",
    ]  # fmt: skip


@pytest.mark.slow
def test_figure__shows_the_level_that_is_asked_for(hardening):
    upper, _ = hardening.plot.response(parameter="frequency_hz", at={"F": 0.3})
    assert set(upper.figure.data["F"].values.tolist()) == {0.3}
    assert "F = 0.3" in " ".join(text.get_text() for text in upper.figure.findobj(Text))
    assert upper.figure.data.sizes["branch"] < hardening.response(parameter="frequency_hz").sizes["branch"]
    both = hardening.plot.sensitivities(parameter="frequency_hz")
    names = [ax.get_title(loc="left") for ax in both]
    assert all("F = 0.3" in name or "F = 0.1" in name for name in names)
    one = hardening.plot.sensitivities(parameter="frequency_hz", at={"F": 0.3}, shown=1)
    assert one[0].figure.data.sizes["bifurcation"] < both[0].figure.data.sizes["bifurcation"]
    assert "1 of 2 bifurcations" in one[0].figure.get_suptitle()
    with pytest.raises((SpecError, ValueError), match=r"F = 0\.2"):
        hardening.plot.response(parameter="frequency_hz", at={"F": 0.2})


@pytest.mark.slow
def test_figure__lags_in_degrees_and_no_harmonic_that_was_not_computed(hardening):
    _, lower = hardening.plot.response(parameter="frequency_hz", degrees=True)
    assert "deg" in lower.get_ylabel()
    with pytest.raises(SpecError, match="harmonic"):
        hardening.plot.response(parameter="frequency_hz", harmonic=6)
