"""The engine on another system: published points of linear and Duffing oscillators."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from magpend_core import Status, lyapunov_exponents, polish_orbits
from magpend_core.engine.entry import integrate
from magpend_core.engine.jit import CACHE_FOLDER, inline, is_covered
from magpend_core.engine.lanes import engine_of
from magpend_core.engine.observers import RECORD, Observer
from magpend_core.engine.variational import with_tangents
from magpend_core.models.pendulum.systems import PENDULUM_DIPOLE, PENDULUM_FITTED
from tests.core.cells import run_cells
from tests.core.flows import model_of

UNIT_FREQUENCY = 0.5 / np.pi  # forcing cos t
PERIOD = 2.0 * np.pi


def run(system, parameters, starts, frequency=UNIT_FREQUENCY, **settings):
    """Sections (x, x', and the derivative of the map, row by row) of each start, shape (n, n_keep, 6)."""
    full = [[*s, 1.0, 0.0, 0.0, 1.0] for s in starts]
    return run_cells(system, parameters, frequency, full, rtol=1e-11, **settings).section[:, 0]


def test_linear_oscillator__is_the_closed_form(oscillator):
    # free decay: exp(-c t/2) (cos s t + c/(2 s) sin s t) with s^2 = k - c^2/4
    c, k = 0.3, 2.0
    s = np.sqrt(k - c * c / 4.0)
    found = run(oscillator, [c, k, 0.0, 0.0], [[1.0, 0.0]], frequency=0.7, n_transient=0, n_keep=10)[0]
    t = np.arange(1, 11) / 0.7
    exact = np.exp(-0.5 * c * t) * (np.cos(s * t) + 0.5 * c / s * np.sin(s * t))
    assert np.max(abs(found[:, 0] - exact)) < 1e-9
    # the variational equation of a linear system is the system
    assert found[:, 2] == pytest.approx(found[:, 0], abs=1e-9)
    # F (k - w^2)/D and F c w^2/D with D = (k - w^2)^2 + (c w)^2: the forced response at t = 2 pi n/w
    c, k, force = 0.2, 2.0, 1.0
    d = (k - 1.0) ** 2 + c**2
    expected = np.array([force * (k - 1.0) / d, force * c / d])
    assert expected == pytest.approx([0.9615384615, 0.1923076923], abs=5e-11)
    # the transient shrinks by exp(-c T/2), half of a decade a period
    found = run(oscillator, [c, k, 0.0, force], [[3.0, -2.0], [0.0, 0.0]], n_transient=45, n_keep=1)[:, 0, :2]
    assert np.max(abs(found - expected)) < 1e-9


@pytest.mark.parametrize(
    ("start", "point"), [((-0.8, 0.0), (-0.7790549287, 0.0274168155)), ((1.2, 0.0), (1.2100908241, 0.0552949542))]
)
def test_duffing__two_attractors_at_their_published_points(oscillator, start, point):
    # x'' = .2 cos t + x - x^3 - .15 x'; points recomputed independently, also in issue 139 of
    # DynamicalSystemsBase.jl
    duffing = [0.15, -1.0, 1.0, 0.2]
    found = run(oscillator, duffing, [start], n_transient=60, n_keep=1)[0, 0, :2]
    assert np.max(abs(found - point)) < 1e-9
    # from there on one period's derivative has the published multipliers
    one = run(oscillator, duffing, [found], n_transient=0, n_keep=1)[0, 0]
    assert one[:2] == pytest.approx(found, abs=1e-9)
    multipliers = np.linalg.eigvals(one[2:].reshape(2, 2))
    published = [-0.226806 - 0.581567j, -0.226806 + 0.581567j]
    assert np.sort_complex(multipliers) == pytest.approx(published, abs=1e-6)
    assert np.prod(multipliers).real == pytest.approx(np.exp(-0.15 * PERIOD), abs=1e-8)


@pytest.mark.parametrize("damping", [0.0, 0.15, 0.5])
def test_duffing__determinant_of_the_map_is_that_of_the_damping(oscillator, damping):
    starts = [(0.3, 0.2), (-1.5, 1.0)]
    found = run(oscillator, [damping, -1.0, 1.0, 0.3], starts, n_transient=0, n_keep=2)
    determinants = np.linalg.det(found[..., 2:].reshape(2, 2, 2, 2))
    assert determinants == pytest.approx(np.tile(np.exp(-damping * PERIOD * np.array([1, 2])), (2, 1)), rel=1e-8)


def test_engine_of__keeps_systems_from_outside_apart(oscillator):
    assert is_covered(*PENDULUM_FITTED.functions)
    assert is_covered(*PENDULUM_DIPOLE.functions)
    assert is_covered(*with_tangents(PENDULUM_FITTED, 1).functions)
    assert not is_covered(*oscillator.functions)
    mixed = dataclasses.replace(PENDULUM_FITTED, name="mixed", rhs=oscillator.rhs)
    assert not is_covered(*mixed.functions)
    assert not is_covered(*with_tangents(mixed, 1).functions)
    # a kept function has a cache with a path, one from outside in a folder of its own
    if CACHE_FOLDER is not None:
        kept = Path(engine_of(PENDULUM_FITTED, RECORD)._cache.cache_path)
        assert kept.parent == CACHE_FOLDER
        outside = Path(engine_of(oscillator, RECORD)._cache.cache_path)
        assert outside.parent.parent == CACHE_FOLDER


# ---- the least that a system can be: one state, neither angles, edges nor layers ------------------

RELAXATION = model_of({"x": "cos(2*pi*f*t) - rate*x"}, {"rate": 0.5}, states={"x": {"escape": 10.0}}).system
GROWTH = model_of({"x": "x*(1 - x)"}).system
"""The least of all: neither forcing nor parameters."""


def test_system__takes_lists_and_whole_numbers(duffing):
    listed = dataclasses.replace(
        duffing, state_names=["x", "v"], is_angle=[0, np.False_], scales=np.array([1, 1]), escape=[1000, 1000]
    )
    assert listed == duffing
    assert hash(listed) == hash(duffing)
    assert listed.label == duffing.label


@pytest.mark.slow
def test_one_state__section_multiplier_and_exponent_are_the_closed_forms():
    rate, omega = 0.5, 1.0
    packed, frequency = np.array([[rate]] * 2), np.full(2, UNIT_FREQUENCY)
    starts = np.array([[0.3], [-2.0]])
    result = run_cells(RELAXATION, packed, frequency, starts, n_transient=10, rtol=1e-11)
    orbit = rate / (rate**2 + omega**2)
    decayed = (starts[:, 0] - orbit) * np.exp(-rate * 11 * PERIOD)
    assert result.section[:, 0, 0, 0] == pytest.approx(orbit + decayed, abs=1e-10)
    assert result.turns.shape == (2, 1, 0)
    polished = polish_orbits(packed, frequency, starts, np.array([1, 1]), system=RELAXATION)
    assert polished.section == pytest.approx(orbit, abs=1e-10)
    assert polished.multipliers == pytest.approx(np.exp(-rate * PERIOD), rel=1e-9)
    found = lyapunov_exponents(packed, frequency, starts, n_periods=32, system=RELAXATION)
    assert found.exponents == pytest.approx(-rate, abs=1e-6)
    assert found.divergence == pytest.approx(-rate, abs=1e-12)


# ---- an observer of one's own ------------------------------------------------------------------------


class _Count(NamedTuple):
    n: int


def _count_above(section, turns, i_period, memory, record, measures, settings):
    measures[0] += section[0] > LEVEL  # noqa: F821
    if i_period <= len(record):
        record[i_period - 1, 0] = section[0]
    return BOUNDED if i_period == settings.n else PENDING  # noqa: F821


@inline
def _no_memory(settings, n_states):
    return 0


@pytest.mark.slow
@pytest.mark.parametrize("n_keep", [0, 4])
def test_observer__of_ones_own_on_one_state_without_forcing_or_parameters(n_keep):
    codes = {"PENDING": int(Status.PENDING), "BOUNDED": int(Status.BOUNDED), "LEVEL": 0.5}
    observer = Observer("count_above", _count_above, _no_memory, codes)
    starts = np.array([0.0, 0.1, 0.9])
    given = {"parameters": np.empty((3, 1, 0)), "frequency_hz": np.full((3, 1), 2.0), "initial_states": starts[:, None]}
    options = {"n_keep": n_keep, "n_measures": 1, "rtol": 1e-11, "atol": 1e-11, "max_steps_per_period": 20_000}
    cells = integrate(GROWTH, observer, _Count(7), **given, **options)
    # logistic growth: x(t) = 1/(1 + (1/x0 - 1) exp(-t)), 1/2 at t = ln 9 from the second start
    assert cells.measures.ravel().tolist() == [0.0, 3.0, 7.0]
    assert cells.n_periods.ravel().tolist() == [7, 7, 7]
    assert (cells.status == Status.BOUNDED).all()
    assert cells.section.shape == (3, 1, n_keep, 1)
    decay = np.exp(-0.5 * np.arange(1, n_keep + 1))
    exact = starts[:, None] / (starts[:, None] + (1.0 - starts[:, None]) * decay)
    assert cells.section[:, 0, :, 0] == pytest.approx(exact, abs=1e-10)
