"""Fits recover what they were made from, and their errors are what estimates scatter by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

from magpend_core.models.pendulum import magnet_torque as laws
from pipeline.rig.magnet.fitting import (
    errors_by_cluster,
    fit_curve,
    fit_curves,
    fit_dipoles,
    fit_jointly,
    fit_laws,
    solve,
)
from pipeline.rig.magnet.measurement import Curve

from .conftest import TRUE

NOISE = 0.02  # N m
T_95 = 1.96  # 365 degrees of freedom


@pytest.fixture
def measured(fitted):
    return fitted.measured


def with_noise(measured, seed, noise=NOISE):
    rng = np.random.default_rng(seed)
    return replace(measured, torque=measured.torque + rng.normal(0.0, noise, len(measured.torque)))


def near(values):
    """A first guess some way off."""
    factors = dict(zip(values, 1.0 + 0.2 * np.sin(np.arange(len(values))), strict=True))
    return {name: value * factors[name] for name, value in values.items()}


def test_fit_curve__errors_are_what_estimates_scatter_by():
    angle, curve = np.linspace(-0.02, 0.2, 17), Curve(0, 0.1, np.arange(17))
    torque, rng = laws.bump(angle, 1.1, -0.031, 0.052), np.random.default_rng(11)
    fits = [fit_curve(angle, torque + rng.normal(0.0, NOISE, 17), curve) for _ in range(200)]
    for name, truth in {"A": 1.1, "b": -0.031, "c": 0.052}.items():
        values = np.array([f.values[name] for f in fits])
        errors = np.array([f.errors[name] for f in fits])
        # 200 draws tell a standard deviation to 5 %
        assert np.sqrt((errors**2).mean()) == pytest.approx(values.std(), rel=0.16)
        # the quantile of Student's t for 14 degrees of freedom
        covered = np.mean(np.abs(values - truth) < 2.145 * errors)
        assert 0.9 < covered < 0.99


@pytest.mark.parametrize(
    ("torque", "words"),
    [
        (lambda x: -laws.bump(x, 1.0, -0.03, 0.05), "no peak of the expected sign"),
        (lambda x: 0.3 + 2.0 * x, "no peak of the expected sign|did not converge|not determine"),
        (lambda x: 0.0 * x, "no peak of the expected sign|did not converge|not determine"),
    ],
)
def test_fit_curve__what_has_no_peak_is_no_result(torque, words):
    angle = np.linspace(-0.02, 0.2, 17)
    with pytest.raises(ArithmeticError, match=words) as caught:
        fit_curve(angle, torque(angle), Curve(0, np.radians(12.5), np.arange(17)))
    assert "curve psi_rel = 12.5 deg, right" in str(caught.value)


def test_fit_curves__names_every_curve_that_is_no_result(measured):
    torque = measured.torque.copy()
    for curve in (measured.curves[2], measured.curves[11]):
        torque[curve.rows] *= -1.0
    with pytest.raises(ArithmeticError) as caught:
        fit_curves(replace(measured, torque=torque))
    assert len(str(caught.value).splitlines()) == 2


def test_fit_laws__recovers_gaussian_line_and_constant(measured):
    """Readings without the change between the bumps: each side is its bump alone."""
    f = [
        laws.bump(measured.locked, *(TRUE[f"{n}{i}"] for n in ("alpha", "beta", "gamma")))
        * laws.bump(measured.angle, 1.0, TRUE[f"p{i}"] * measured.locked + TRUE[f"r{i}"], TRUE[f"c{i}"])
        for i in (1, 2)
    ]
    found = fit_laws(fit_curves(replace(measured, torque=np.where(measured.side == 0, *f))))
    expected = {name: value for name, value in TRUE.items() if name != "eps_mag"}
    assert found.values == pytest.approx(expected, rel=1e-8, abs=1e-10)
    assert min(found.r2.values()) == pytest.approx(1.0, abs=1e-12)


def test_fit_jointly__holds_what_is_held(measured):
    held = {"eps_mag": TRUE["eps_mag"], "c2": TRUE["c2"]}
    found = fit_jointly(measured, near(TRUE), held)
    assert found.values == pytest.approx(TRUE, rel=1e-8)
    assert found.undetermined == {}
    assert set(found.free) == set(TRUE) - set(held)
    assert found.correlation.shape == (11, 11)
    wrong = fit_jointly(measured, near(TRUE), {"eps_mag": 20.0})
    assert wrong.values["eps_mag"] == 20.0
    assert wrong.quality.rms > 0.005


@pytest.mark.slow
def test_fit_jointly__covers_the_truth_and_scatters_as_its_covariance_says(measured):
    start = fit_laws(fit_curves(measured)).values
    fits = [fit_jointly(with_noise(measured, seed), start) for seed in range(150)]
    names = fits[0].free
    values = np.array([[f.values[n] for n in names] for f in fits])
    errors = np.array([[f.errors[n] for n in names] for f in fits])
    truth = np.array([TRUE[n] for n in names])
    # 150 draws: 5.8 % of a standard deviation, 1.8 % of a coverage; 13 parameters are looked at
    np.testing.assert_allclose(np.sqrt((errors**2).mean(axis=0)), values.std(axis=0), rtol=0.2)
    covered = (np.abs(values - truth) < T_95 * errors).mean(axis=0)
    assert ((covered > 0.88) & (covered < 0.995)).all(), dict(zip(names, covered, strict=True))
    assert 0.93 < covered.mean() < 0.97
    # without any likeness within curves, their jackknife says the same; 17 degrees of freedom
    by_curve = np.array([[f.errors_by_curve[n] for n in names] for f in fits])
    assert 0.93 < (np.abs(values - truth) < 2.11 * by_curve).mean() < 0.97
    # at most 8 % of 1 for each of 78 pairs
    expected = np.mean([f.correlation for f in fits], axis=0)
    np.testing.assert_allclose(np.corrcoef(values, rowvar=False), expected, rtol=0, atol=0.28)
    rms = np.mean([f.quality.rms for f in fits])
    assert rms == pytest.approx(NOISE * np.sqrt((378 - 13) / 378), rel=0.01)


def test_fit_jointly__is_the_optimum_of_another_method(measured):
    """Trust regions with slopes by differences and no scaling, from another start."""
    noisy = with_noise(measured, 5)
    found = fit_jointly(noisy, TRUE)

    def law(at, *values):
        return laws.magnet_moment(*at, dict(zip(laws.FITTED, values, strict=True)))

    start = [1.05 * TRUE[name] for name in laws.FITTED]
    at = np.stack([noisy.angle, noisy.locked])
    values, covariance = curve_fit(law, at, noisy.torque, start, method="trf", x_scale=np.abs(start))
    # differences of first order leave some 1e-4 of an error
    errors = np.sqrt(np.diag(covariance))
    assert (np.abs(values - [found.values[n] for n in laws.FITTED]) < 1e-3 * errors).all()
    assert errors == pytest.approx([found.errors[n] for n in laws.FITTED], rel=1e-3)


def test_errors_by_cluster__are_the_jackknife_of_a_line():
    """For a linear fit the first order is all: leave out each cluster, fit again."""
    rng = np.random.default_rng(8)
    x = rng.uniform(-1, 1, 24)
    design, y = np.stack([np.ones(24), x], axis=-1), 1.0 + 2.0 * x + rng.normal(0, 0.3, 24)
    clusters = np.split(np.arange(24), 6)
    all_of_it = solve(lambda v: y - design @ v, lambda v: -design, (0.0, 0.0), "line")
    without = np.array([np.linalg.lstsq(np.delete(design, c, 0), np.delete(y, c), rcond=None)[0] for c in clusters])
    expected = np.sqrt(((without - all_of_it.x) ** 2).sum(axis=0) * 5 / 6)
    np.testing.assert_allclose(errors_by_cluster(all_of_it, clusters), expected, rtol=1e-9)
    one_decides = [np.arange(23), np.array([23])]
    design[:23, 1] = 0.0
    again = solve(lambda v: y - design @ v, lambda v: -design, (0.0, 0.0), "line")
    assert np.isnan(errors_by_cluster(again, one_decides)).all()


@pytest.mark.slow
def test_fit_jointly__errors_by_curve_hold_where_residuals_of_a_curve_are_alike(measured):
    """With a common shift of every curve those from the residuals' variance are too small."""
    start, fits = fit_laws(fit_curves(measured)).values, []
    for seed in range(80):
        rng = np.random.default_rng(1000 + seed)
        torque = measured.torque + rng.normal(0.0, 0.002, len(measured.torque))
        for curve in measured.curves:
            torque[curve.rows] += rng.normal(0.0, NOISE)
        fits.append(fit_jointly(replace(measured, torque=torque), start))
    values = np.array([f.values["c1"] for f in fits])
    plain, by_curve = (
        np.sqrt(np.mean([e["c1"] ** 2 for e in errors]))
        for errors in ([f.errors for f in fits], [f.errors_by_curve for f in fits])
    )
    assert plain < 0.75 * values.std()
    # 80 draws tell a standard deviation to 8 %, 18 curves that of each draw to 17 %
    assert by_curve == pytest.approx(values.std(), rel=0.25)
    assert np.mean([f.neighbours for f in fits]) > 0.5


def test_fit_jointly__says_what_readings_do_not_determine(measured):
    """Readings far from the transition do not tell how steep it is."""
    away = np.abs(measured.angle - np.polyval(laws.transition(TRUE), measured.locked)) > 0.05
    part = {name: getattr(measured, name)[away] for name in ("angle", "locked", "side", "reading", "torque")}
    found = fit_jointly(with_noise(replace(measured, **part), 3), TRUE)
    assert found.undetermined
    assert set(found.undetermined.values()) <= set(TRUE)


def test_fit_jointly__what_does_not_converge_is_no_result(measured, monkeypatch):
    monkeypatch.setattr("pipeline.rig.magnet.fitting.MAX_EVALUATIONS", 3)
    with pytest.raises(ArithmeticError, match="joint fit: the fit did not converge"):
        fit_jointly(measured, near(TRUE))


def test_fit_jointly__readings_of_one_place_determine_nothing(measured):
    same = {name: np.full_like(getattr(measured, name), 0.1) for name in ("angle", "locked", "torque")}
    with pytest.raises(ArithmeticError, match="joint fit: the readings do not determine all"):
        fit_jointly(replace(measured, **same), TRUE)


@pytest.mark.parametrize("place", [False, True])
def test_fit_dipoles__recovers_point_dipoles(measured, place):
    truth = {"pole1": 150.0, "pole2": 150.0, "h": 0.41 if place else measured.parameters["h"]}
    torque = laws.dipole_moment(measured.angle, measured.locked, {**measured.parameters, **truth})
    found = fit_dipoles(replace(measured, torque=torque), place=place)
    # a sum of squares tells the place of its minimum to the root of rounding
    assert found.values == pytest.approx(truth, rel=1e-6 if place else 1e-12)
    assert found.quality.r2 == pytest.approx(1.0, abs=1e-9)


def test_fit_dipoles__attracting_ones_are_no_result(measured):
    with pytest.raises(ArithmeticError, match="repelling"):
        fit_dipoles(replace(measured, torque=-measured.torque))
