"""What a user computes first has the numbers that others have published or computed."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import magpend
from tests.pipeline.factories import duffing, finished, quietly

FREQUENCY = 1.0 / (2.0 * math.pi)
TWO_WELLS = duffing(
    f"frequency_hz = {{ values = [{FREQUENCY!r}] }}",
    'kind = "grid"\nx = { start = -2.2, stop = 2.2, num = 12 }\nv = { start = -2.2, stop = 2.2, num = 12 }',
    n_transient=200,
    n_keep=16,
    tolerance=1e-8,
    more='[parameters]\npreset = "twin-well-periodic"\n'
    "[products]\nlyapunov = { n_transient = 100, n_periods = 200, n_blocks = 4 }",
)
RESONANCE = duffing(
    "frequency_hz = { start = 0.16, stop = 0.30, num = 15 }",
    'kind = "list"\npoints = [[0.0, 0.0]]',
    kind="continuation",
    n_transient=60,
    n_keep=12,
    tolerance=1e-8,
    more='[parameters]\npreset = "hardening"\n[continuation]\ndirection = "both"',
)
# x'' = .2 cos t + x - x^3 - .15 x': DynamicalSystemsBase.jl, issue 139, and recomputed
WELLS = np.array([[-0.7790549287, 0.0274168155], [1.2100908241, 0.0552949542]])
MULTIPLIER = complex(-0.226806, 0.581567)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the finished run ``wells``."""
    path = tmp_path_factory.mktemp("promises")
    (path / "wells.toml").write_text(TWO_WELLS)
    quietly(path / "wells.toml", path / "wells")
    return path


def test_attractors__are_the_two_published_ones_with_their_basins(folder, command):
    found = json.loads(command(folder, "analyse", "attractors", "wells", "--json")[0])
    assert [row["kind"] for row in found] == ["periodic_orbit"] * 2
    assert [row["stability"] for row in found] == ["attracts"] * 2
    for row in found:
        assert row["orbit_period"] == 1
        assert row["multiplier_modulus"] == pytest.approx(abs(MULTIPLIER), abs=2e-6)
    with magpend.open_run(folder / "wells") as ds:
        last = ds.section.isel(period_index=-1).values.reshape(-1, 2)
    assert (np.abs(last[:, None] - WELLS).max(axis=-1).min(axis=1) < 1e-6).all()
    for row, published in zip(
        json.loads(command(folder, "analyse", "basins", "wells", "--json")[0]), (0.498, 0.502), strict=True
    ):
        assert row["low"] < published < row["high"]


def test_exponents__agree_with_multipliers_and_damping(folder):
    with magpend.open_run(folder / "wells") as ds:
        exponents = ds.lyapunov.values.reshape(-1, 2)
    np.testing.assert_allclose(exponents.sum(axis=1), -0.15, atol=1e-6)  # a hundred times the run's tolerance
    np.testing.assert_allclose(np.median(exponents, axis=0), math.log(abs(MULTIPLIER)) * FREQUENCY, atol=1e-4)


def hardening(t, y, f):
    """Return the rates of the preset's oscillator and of the four entries of its fundamental matrix."""
    x, v, a, b, c, d = y
    k = 1.0 + 1.5 * x * x
    force = 0.3 * math.cos(2.0 * math.pi * f * t)
    return v, force - 0.1 * v - x - 0.5 * x**3, c, d, -k * a - 0.1 * c, -k * b - 0.1 * d


@pytest.mark.slow
def test_branches__have_the_orbits_and_folds_of_another_integrator(tmp_path):
    found = magpend.branches(finished(tmp_path, RESONANCE), max_period=1)
    folds = found.isel(bifurcation=found.of_branch == 0)
    assert folds.sizes["bifurcation"] == 2
    for f, state in zip(folds.bifurcation_frequency.values, folds.bifurcation_section.values[:, 0], strict=True):
        start = (*state, 1.0, 0.0, 0.0, 1.0)
        end = solve_ivp(hardening, (0.0, 1.0 / f), start, "DOP853", args=(f,), rtol=1e-11, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(end[:2], state, atol=1e-8)
        assert np.linalg.eigvals(end[2:].reshape(2, 2)).real.max() == pytest.approx(1.0, abs=1e-5)


def test_own_system__as_text_has_the_response_of_the_closed_form():
    model = magpend.model("x'' = -c*x' - k*x + F*cos(2*pi*f*t)", name="linear", c=0.2, k=2.0, F=1.0)
    done = magpend.sections(model.load(), [FREQUENCY], [[0.0, 0.0]], n_transient=300, n_keep=1, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(done.section[0, 0], (0.9615384615, 0.1923076923), atol=1e-7)
