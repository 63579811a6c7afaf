"""Branches of Duffing oscillators, a model without angles: against harmonic balance and symmetry."""

import numpy as np
import pytest

from magpend_core.models import load_model
from pipeline.analysis.branches.analysis import curves_table
from pipeline.analysis.branches.arclength import Settings
from pipeline.analysis.branches.curves import curves_dataset, curves_from
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.declaration import CURVE_COLUMNS
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.problems import Family
from pipeline.layout.columns import described

pytestmark = pytest.mark.slow

DUFFING = load_model("duffing")
TWO_PI = 2.0 * np.pi


def harmonic_balance(parameters):
    """Frequencies [rad/s] of both folds of x = A cos(w t - phi), and a state at w = 0.85.

    ``(c - w^2)^2 + (damping w)^2 = (F/A)^2`` with ``c = linear + 3/4 cubic A^2`` (Nayfeh and Mook, Nonlinear
    Oscillations, 1979, section 4.1): a quadratic in w^2 for each amplitude A.
    """
    p = parameters
    a = np.linspace(1e-3, 4.0, 400001)
    c = p["linear"] + 0.75 * p["cubic"] * a**2
    half = c - 0.5 * p["damping"] ** 2
    root = np.sqrt(half**2 - c**2 + (p["amplitude"] / a) ** 2 + 0j)
    real = np.abs(root.imag) < 1e-12
    left = np.sqrt(np.maximum(half - root.real, 0.0)[real])
    right = np.sqrt((half + root.real)[real])
    bends = np.flatnonzero((np.diff(right)[:-1] < 0.0) & (np.diff(right)[1:] >= 0.0)) + 1
    lower = right[bends[0]]
    upper = max(left.max(), right[bends[0] :].max())
    w = 0.85
    amplitude = a[real][np.argmin(np.abs(left - w))]
    phase = np.arctan2(p["damping"] * w, p["linear"] + 0.75 * p["cubic"] * amplitude**2 - w**2)
    return (lower, upper), np.array([amplitude * np.cos(phase), amplitude * w * np.sin(phase)]), w


def weakly_nonlinear(size):
    """Damping, cubic stiffness and drive of one order, so that amplitudes are of order 1."""
    return DUFFING.load("hardening", damping=size, cubic=size, amplitude=2.0 * size)


def folds_of(parameters):
    (lower, upper), state, w = harmonic_balance(parameters)
    family = Family(DUFFING.system, 1, w / TWO_PI, parameters.pack(), ("frequency",), (0.1,))
    scope = Scope(0.85 / TWO_PI, 1.25 / TWO_PI, settings=Settings(longest_step=0.1))
    (branch,) = explore([Start(family, state, w / TWO_PI)], scope)
    found = sorted(TWO_PI * family.values(b.point.u)[0] for b in branch.bifurcations)
    assert [b.kind for b in branch.bifurcations] == ["fold", "fold"]
    return branch, np.array(found), np.array([lower, upper])


def test_explore__folds_by_harmonic_balance():
    """What the first harmonic leaves out falls faster than what is small: here to a tenth at a quarter."""
    errors = []
    for size in (0.05, 0.0125):
        _, found, expected = folds_of(weakly_nonlinear(size))
        errors.append(np.abs(found - expected))
    assert (errors[1] < 3e-5).all()
    assert (errors[0] / errors[1] > 8.0).all()


def test_curves_from__folds_meet_in_a_cusp():
    """With less drive the two folds come together; the curve is one, through the cusp."""
    parameters = weakly_nonlinear(0.025)
    branch, *_ = folds_of(parameters)
    ds = dataset_of([branch], "frequency", parameters)
    bounds = ((0.85 / TWO_PI, 1.25 / TWO_PI), (0.02, 0.08))
    curves = curves_from(ds, parameters, "amplitude", bounds, 1)
    assert len(curves) == 1
    told = curves_dataset(curves, "frequency", "amplitude", DUFFING)
    assert described(told, CURVE_COLUMNS, DUFFING)["second"].attrs["units"] == "m/s2"
    least = float(told["second"].min())
    # to first order in what is small
    expected = np.sqrt(32.0 * parameters["damping"] ** 3 / (9.0 * np.sqrt(3.0) * parameters["cubic"]))
    assert least == pytest.approx(expected, rel=0.05)
    (row,) = curves_table(told).rows
    assert (row["type"], row["period"]) == ("cusp", 1)
    assert row["amplitude"] == pytest.approx(least, rel=1e-3)
