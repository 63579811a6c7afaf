"""Backbone curves against elliptic functions, a harmonic balance of the tests' own, and shooting with scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve
from scipy.special import ellipk

import magpend
from magpend_core.models import load_model
from magpend_core.models.parameters import ParameterError
from pipeline.analysis.branches.lockstep import run_alone
from pipeline.analysis.response.resonance import ModeProblem, mode_family, normal_mode
from pipeline.runs.derive import shown_table
from pipeline.specification.problems import SpecError
from tests.pipeline.analysis.cubes import swept

OMEGA = 2.0 * np.pi


@pytest.fixture(scope="module")
def hardening(tmp_path_factory):
    """x'' + .1 x' + x + .5 x^3 = F cos(w t) at two levels of the force."""
    axes = {"amplitude": [0.1, 0.3], "frequency_hz": (0.5 / OMEGA, 2.0 / OMEGA, 9)}
    out, starts = tmp_path_factory.mktemp("hardening") / "run", {"x": (-3, 3), "v": (-3, 3)}
    return swept("duffing", out, starts, (300, 4), parameters={"preset": "hardening"}, **axes)


@pytest.fixture(scope="module")
def duffing(hardening):
    return hardening.backbone(undamped={"damping": 0.0, "amplitude": 0.0})


@pytest.fixture(scope="module")
def masses(tmp_path_factory):
    """Two masses between springs, one of them cubic: Kerschen et al., Nonlinear normal modes, Part I (2009), eq. 2."""
    model = magpend.model(
        "x1'' = -(2*x1 - x2) - 0.5*x1**3\nx2'' = -(2*x2 - x1)",
        name="masses", quantities={"energy": "x1_dot**2/2 + x2_dot**2/2 + x1**2 + x2**2 - x1*x2 + x1**4/8"},
    )  # fmt: skip
    out = tmp_path_factory.mktemp("masses") / "run"
    return swept(model, out, [(1.0, 0.5, 0.0, 0.0)], (0, 2), section=("x1_dot", "down"))


def curve(ds, i):
    return ds.isel(curve=i, point=slice(0, int(ds["n_points"][i])))


def balanced(force, omega, c, n=9):
    """Frequency and odd harmonics of the hardening oscillator whose first harmonic lags 90 degrees."""
    orders = np.arange(1, 2 * n, 2)
    phases = np.exp(1j * np.outer(np.arange(8 * n) * OMEGA / (8 * n), orders))

    def residual(packed):
        w, c = packed[-1], packed[:n] + 1j * packed[n:-1]
        cubic = (phases.conj().T @ (phases @ c).real ** 3) / (8 * n)
        own = (1.0 - (orders * w) ** 2 + 0.1j * orders * w) * c + cubic
        own[0] -= force
        return np.concatenate([own.real, own.imag, [c[0].real]])

    start = np.zeros(2 * n + 1)
    start[n], start[-1] = c, omega
    found = fsolve(residual, start, xtol=1e-13)
    assert np.abs(residual(found)).max() < 1e-12
    return found[-1], found[:n] + 1j * found[n:-1]


@pytest.mark.slow
def test_phase_resonance__agrees_with_harmonic_balance(duffing):
    one = curve(duffing, 0)
    forces = one["parameter_amplitude"].values
    np.testing.assert_allclose(np.cos(one["phase"].sel(channel="x", harmonic=1)), 0.0, atol=1e-9)
    assert forces[0] == pytest.approx(0.003, abs=1e-4)
    assert duffing.attrs["force"] == "amplitude"
    assert (duffing["kind"] == 0).sum() == 1  # both levels lie on one curve
    for j in range(0, len(forces), 10):
        at = one.isel(point=j)
        amplitudes = at["harmonic_amplitude"].sel(channel="x").values
        omega, c = balanced(forces[j], OMEGA * float(at["frequency"]), -amplitudes[0])
        assert OMEGA * float(at["frequency"]) == pytest.approx(omega, rel=1e-8)
        np.testing.assert_allclose(amplitudes[::2], np.abs(c[:3]), rtol=1e-8, atol=1e-10)
    # the determinant is that of the damping: exp(-0.1 T)
    mu = (one["multiplier_real"] + 1j * one["multiplier_imag"]).values
    np.testing.assert_allclose(np.prod(mu, axis=1), np.exp(-0.1 / one["frequency"].values), rtol=1e-8)


@pytest.mark.slow
def test_phase_resonance__of_two_linear_masses_is_exact(tmp_path):
    """Quadrature where the real part of the response function vanishes: of x1 also at its antiresonance."""
    model = magpend.model(
        "x1'' = -(2*x1 - x2) - c*(2*x1' - x2') + F*cos(2*pi*f*t)\nx2'' = -(2*x2 - x1) - c*(2*x2' - x1')",
        name="linear", c=0.05, F=0.1, states={name: {"scale": 4.0} for name in ("x1", "x2", "x1_dot", "x2_dot")},
    )  # fmt: skip
    run = swept(model, tmp_path / "run", [(0.0, 0.0, 0.0, 0.0)], (200, 4), frequency_hz=(0.5 / OMEGA, 2.5 / OMEGA, 3))

    def response(omega):
        own = 2.0 + 0.1j * omega - omega**2
        return np.linalg.solve([[own, -1 - 0.05j * omega], [-1 - 0.05j * omega, own]], [1.0, 0.0])

    for c, brackets in ((0, [(0.9, 1.1), (1.2, 1.6), (1.6, 1.9)]), (1, [(0.9, 1.1), (1.6, 1.9)])):
        ds = run.backbone(channel=("x1", "x2")[c], drive_low=0.05)
        exact = [brentq(lambda w, c=c: response(w)[c].real, *ends, xtol=1e-14) for ends in brackets]
        assert ds.sizes["curve"] == len(exact)
        np.testing.assert_allclose(OMEGA * ds["frequency"].min("point"), exact, rtol=1e-8)
        np.testing.assert_allclose(OMEGA * ds["frequency"].max("point"), exact, rtol=1e-8)
        gain = [abs(response(w)[c]) for w in exact]
        own = ds["amplitude"].sel(channel=("x1", "x2")[c]) / ds["F"]
        np.testing.assert_allclose(own.isel(point=-1 - (int(ds["n_points"].max()) - ds["n_points"])), gain, rtol=1e-8)


@pytest.mark.slow
def test_normal_mode__of_duffing_is_exact(duffing):
    """x = A cn(...): w = pi sqrt(1 + b A^2) / (2 K(m)) with m = b A^2 / (2 (1 + b A^2))."""
    one = curve(duffing, 1)
    x = 0.5 * one["section"].sel(state="x").values ** 2
    exact = np.pi * np.sqrt(1.0 + x) / (2.0 * ellipk(x / (2.0 * (1.0 + x))))
    np.testing.assert_allclose(OMEGA * one["frequency"], exact, rtol=1e-9)
    np.testing.assert_allclose(one["amplitude"].sel(channel="x"), one["section"].sel(state="x"), rtol=1e-9)
    assert float(one["frequency"][-1]) == pytest.approx(2.0 / OMEGA, abs=1e-5)  # ends at the run's bound
    assert (one["n_unstable"] == 0).all()


def swing(state, seconds):
    """Return the state and the derivative of the flow of the two masses after a time."""

    def rates(t, y):
        x, phi = y[:4], y[4:].reshape(4, 4)
        slope = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-2 - 1.5 * x[0] ** 2, 1, 0, 0], [1, -2, 0, 0]])
        own = [x[2], x[3], -2 * x[0] + x[1] - 0.5 * x[0] ** 3, x[0] - 2 * x[1]]
        return np.concatenate([own, (slope @ phi).ravel()])

    start = np.concatenate([state, np.eye(4).ravel()])
    end = solve_ivp(rates, (0.0, seconds), start, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    return end[:4], end[4:].reshape(4, 4)


@pytest.mark.slow
def test_normal_modes__of_two_masses_agree_with_shooting(masses):
    ds = masses.backbone(reach=16.0)
    np.testing.assert_allclose(OMEGA * ds["linear_frequency"], [1.0, np.sqrt(3.0)], rtol=1e-10)
    for i, sign in enumerate((1.0, -1.0)):
        one = curve(ds, i)
        assert (np.sign(one["section"].values[:, 1]) == sign).all()  # in phase, out of phase
        for j in np.linspace(10, one.sizes["point"] - 1, 6).astype(int):
            at = one.isel(point=j)
            x1, x2 = at["section"].values[:2]

            def residual(free, x1=x1):
                # from rest, both masses rest again after half a period
                return swing(np.array([x1, free[0], 0.0, 0.0]), 0.5 * free[1])[0][2:]

            found, seconds = fsolve(residual, [x2 * (1 + 1e-4), 1.0001 / float(at["frequency"])], xtol=1e-12)
            assert float(at["frequency"]) == pytest.approx(1.0 / seconds, rel=1e-8)
            energy = x1**2 + found**2 - x1 * found + x1**4 / 8
            assert float(at["mean"].sel(channel="energy")) == pytest.approx(energy, rel=1e-8)
            mu = np.linalg.eigvals(swing(np.array([x1, found, 0.0, 0.0]), seconds)[1])
            mu = np.delete(mu, np.argsort(np.abs(mu - 1.0))[:2])
            assert int(at["n_unstable"]) == (np.abs(mu) > 1.0 + 1e-4).sum()
            own = (at["multiplier_real"] + 1j * at["multiplier_imag"]).values[:2]
            np.testing.assert_allclose(np.sort(np.abs(own)), np.sort(np.abs(mu)), rtol=1e-5)
    # beyond an energy the mode in phase is unstable; its frequency stays below sqrt(2), that of the first mass held
    assert set(curve(ds, 0)["n_unstable"].values.tolist()) == {0, 1}
    assert OMEGA * float(curve(ds, 0)["frequency"].max()) < np.sqrt(2.0)


@pytest.mark.slow
def test_normal_mode__of_a_pendulum_softens_towards_its_upper_rest(tmp_path):
    """th'' = -sin th: w = pi / (2 K(sin^2(A/2))); the upper rest is a saddle and has no mode."""
    model = magpend.model(
        "th'' = -sin(th) - c*th'", name="swing", states={"th": {"unit": "rad", "on_circle": True}}, c=0.1
    )
    run = swept(model, tmp_path / "run", [(1.0, 0.0), (3.1, 0.0)], (0, 2), section=("th_dot", "down"))
    ds = run.backbone(undamped={"c": 0.0}, low=0.06)
    (one,) = (curve(ds, i) for i in range(ds.sizes["curve"]))
    amplitude = one["section"].sel(state="th").values
    np.testing.assert_allclose(OMEGA * one["frequency"], np.pi / (2 * ellipk(np.sin(amplitude / 2) ** 2)), rtol=1e-9)
    assert amplitude[-1] > 3.0
    assert float(one["frequency"][-1]) == pytest.approx(0.06, abs=1e-5)
    # with damping there is none, and the table says why
    assert "grows or decays at the rate -0.05 1/s; see --undamped" in shown_table("backbone", run.backbone()).nothing
    assert run.plot.backbone(undamped={"c": 0.0}, low=0.06).get_xlabel() == "frequency [Hz]"


@pytest.mark.slow
def test_normal_mode__needs_orbits_that_close():
    """Cubic damping leaves imaginary eigenvalues, and no orbit."""
    base = load_model(magpend.model("x'' = -x - d*x'**3", name="cubic", d=0.1)).load(None)
    for value, found in ((0.1, False), (0.0, True)):
        own = base.replace(d=value)
        problem = ModeProblem(mode_family(own, 1.0 / OMEGA), own, np.zeros(2), ((0.1, 0.3), (0.0, 0.1)))
        assert (run_alone(normal_mode(problem, np.array([1.0, 0.0]))) is not None) == found


@pytest.mark.slow
def test_figure__shows_both_curves_over_the_response(hardening, duffing):
    ax = hardening.plot.backbone(undamped={"damping": 0.0, "amplitude": 0.0})
    lines = [line.get_xydata() for line in ax.get_lines() if line.get_linestyle() == "-"]
    for i in range(2):
        own = np.column_stack([curve(duffing, i)["frequency"], curve(duffing, i)["amplitude"].sel(channel="x")])
        assert any(len(line) == len(own) and (line == own).all() for line in lines)
    texts = {text.get_text() for text in ax.figure.legends[0].get_texts()}
    assert {"phase resonance", "normal mode", "response, amplitude = 0.1"} <= texts, texts


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"channel": "y"}, "'y'.*energy"),
        ({"drive": "gain"}, "'gain'"),
        ({"drive_low": 1.0, "drive_high": 0.5}, "drive_low=1"),
        ({"undamped": {"c": 0.0}}, "'c'.*damping"),
        ({"undamped": {"damping": 0.0}}, "sweeps amplitude.*undamped="),
        ({"undamped": {"amplitude": 0.2}}, "system without drive"),
        ({"undamped": {"damping": -1.0, "amplitude": 0.0}}, "damping"),
    ],
)
def test_options__are_refused_before_anything_is_computed(hardening, options, named):
    with pytest.raises((SpecError, ParameterError), match=named):
        hardening.backbone(**options)
