"""Tangent vectors of large systems: against written-out products, against numpy, and the limit."""

import dataclasses
import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm

from magpend_core import Status, jacobian, lyapunov_exponents, rates, sections
from magpend_core import lyapunov as exponents
from magpend_core.engine.checks import SystemCheckError, check_system
from magpend_core.engine.jit import inline
from magpend_core.engine.system import System
from magpend_core.engine.variational import with_tangents
from magpend_core.models import ModelError, load_model
from magpend_core.orbits import section_map
from magpend_core.sizes import MAX_STATES, MOST_STATES, WRITTEN_OUT
from pipeline.products.lyapunov import LYAPUNOV, LyapunovOptions
from tests.core.cells import scipy_end
from tests.core.flows import flow, lorenz96, table

N = 12


def kaplan_yorke(spectrum):
    """Dimension of a falling spectrum."""
    sums = np.cumsum(spectrum)
    k = np.flatnonzero(sums >= 0.0)[-1]
    return k + 1 + sums[k] / abs(spectrum[k + 1])


RUBBED = table(
    "rubbed",
    {"x": "v", "v": "cos(2*pi*f*t) - x - 0.2*v - 0.4*sign(v + 0.3) - 0.2*tanh(20*v)"},
    impacts=[{"of": "x - 0.5", "direction": "up", "set": {"v": "-0.7*v"}}],
)
"""A layer, a switch on which the motion slides for a quarter of the time, and an impact in each period."""


@pytest.mark.slow
@pytest.mark.parametrize("equations", [lorenz96(7), RUBBED], ids=["sparse", "rubbed"])
def test_with_tangents__loops_give_the_bits_of_written_out_products(equations, monkeypatch):
    model = flow(equations)
    system, n = model.system, len(model.states)
    states = np.random.default_rng(3).uniform(-0.3, 0.3, (3, n))
    cells = np.tile(model.load().pack(), (3, 1)), np.full(3, 0.15), states
    options = {"n_transient": 3, "n_periods": 8, "n_blocks": 2, "system": system}
    found = []
    for written_out in (True, False):
        monkeypatch.setattr(exponents, "with_tangents", partial(with_tangents, written_out=written_out))
        found.append(lyapunov_exponents(*cells, **options))
    for field in dataclasses.fields(found[0]):
        first, second = (getattr(one, field.name) for one in found)
        np.testing.assert_array_equal(first, second, err_msg=field.name)
    assert (found[0].status == Status.BOUNDED).all()


def _rates(y):
    return (np.roll(y, -1) - np.roll(y, 2)) * np.roll(y, 1) - y + 8.0


def _jacobian(y):
    n = len(y)
    found = -np.eye(n)
    for i in range(n):
        found[i, (i + 1) % n] += y[i - 1]
        found[i, i - 2] -= y[i - 1]
        found[i, i - 1] += y[(i + 1) % n] - y[i - 2]
    return found


def _spectrum_by_numpy(start, n_transient, n_units):
    """All exponents by scipy's integrator and numpy's QR, a tenth of a time unit after the other."""
    n = len(start)

    def extended(t, z):
        return np.concatenate([_rates(z[:n]), (_jacobian(z[:n]) @ z[n:].reshape(n, n)).ravel()])

    y, q, logs = start, np.eye(n), np.zeros(n)
    for i in range(10 * (n_transient + n_units)):
        end = scipy_end(extended, np.append(y, q), 0.1)
        y, (q, r) = end[:n], np.linalg.qr(end[n:].reshape(n, n))
        logs += np.log(np.abs(np.diag(r))) if i >= 10 * n_transient else 0.0
    return np.sort(logs / n_units)[::-1]


@pytest.fixture(scope="module")
def ring():
    """Lorenz-96 of `N` states, with a start on its chaotic attractor."""
    start = 8.0 + np.random.default_rng(1).normal(size=N)
    return flow(lorenz96(N)).system, scipy_end(lambda t, y: _rates(y), start, 20.0, 1e-8)


@pytest.mark.slow
def test_lyapunov__of_twelve_states(ring, monkeypatch):
    system, start = ring
    options = {"n_transient": 2, "n_periods": 4, "n_blocks": 2, "rtol": 1e-12, "atol": 1e-12}
    found = lyapunov_exponents(np.full((1, 1), 8.0), np.ones(1), start[None], system=system, **options)
    # chaos of some 1.7 per time unit separates the two by exp(10) in 6 of them
    expected = _spectrum_by_numpy(start, 2, 4)
    assert found.exponents[0] == pytest.approx(expected, abs=1e-6)
    system, start = ring
    starts = start + 0.1 * np.random.default_rng(2).normal(size=(16, N))
    options = {"n_transient": 20, "n_periods": 80, "n_blocks": 4, "system": system}
    found = lyapunov_exponents(np.full((16, 1), 8.0), np.ones(16), starts, **options)
    assert found.exponents.sum(axis=1) == pytest.approx(-N, abs=1e-6)
    assert found.divergence == pytest.approx(-N, abs=1e-10)
    # a flow that does not come to rest has an exponent 0, within 5 standard errors
    nearest = np.abs(found.exponents).argmin(axis=1)
    rows = np.arange(16)
    assert (np.abs(found.exponents[rows, nearest]) < 5.0 * found.stderr[rows, nearest] + 1e-3).all()
    system, start = ring
    starts = start + 0.1 * np.random.default_rng(2).normal(size=(40, N))
    cells = np.full((40, 1), 8.0), np.ones(40), starts
    options = {"n_transient": 0, "n_periods": 2, "n_blocks": 2, "system": system, "n_lanes": 16}
    whole = lyapunov_exponents(*cells, **options)
    monkeypatch.setattr(exponents, "MOST_NUMBERS", 1)
    parts = lyapunov_exponents(*cells, **options)
    for field in dataclasses.fields(whole):
        np.testing.assert_array_equal(getattr(whole, field.name), getattr(parts, field.name))


@pytest.mark.slow
def test_section_map__of_twelve_states_has_the_derivative_of_the_flow(ring):
    # at rest on x = F the linear flow is exact: with F = 0.5 it attracts
    system, rest = ring[0], np.full((1, N), 0.5)
    found = section_map(np.full((1, 1), 0.5), np.ones(1), rest, 1, system=system)
    neighbour = np.roll(np.eye(N), 1, axis=1) - np.roll(np.eye(N), -2, axis=1)
    assert found.derivatives[0] == pytest.approx(expm(0.5 * neighbour - np.eye(N)), abs=1e-10)


@pytest.mark.long
def test_lyapunov__standard_case_of_forty_states():
    # the case of Lorenz and Emanuel, J. Atmos. Sci. 55 (1998) 399-414: a largest exponent of 1.69 per time
    # unit, and a dimension of 27.1; the tolerances are those of published values, not of the 16 trajectories
    n, rng = 40, np.random.default_rng(1)
    cells = np.full((16, 1), 8.0), np.ones(16), 8.0 + rng.normal(size=(16, n))
    found = lyapunov_exponents(*cells, system=flow(lorenz96(n)).system, n_transient=100, n_periods=400)
    mean = found.exponents.mean(axis=0)
    assert mean[0] == pytest.approx(1.69, abs=0.03)
    assert kaplan_yorke(mean) == pytest.approx(27.1, abs=0.3)
    assert found.exponents.sum(axis=1) == pytest.approx(-n, abs=1e-4)
    assert np.abs(mean).min() < 0.01
    assert (found.status == Status.BOUNDED).all()


@pytest.mark.slow
def test_jacobian__of_a_large_text_is_whole():
    model = flow(lorenz96(N))
    entries = model.system.jacobian_entries
    assert entries is not None
    assert len(entries) == 4 * N
    state = np.random.default_rng(5).normal(size=N)
    found = jacobian(0.0, state, model.load(), 1.0)
    np.testing.assert_allclose(found, _jacobian(state), atol=1e-14)
    np.testing.assert_allclose(rates(0.0, state, model.load(), 1.0), _rates(state), atol=1e-14)
    assert flow(lorenz96(WRITTEN_OUT)).system.jacobian_entries is None


@inline
def _no_constants(frequency, p, out):
    out[0] = 0.0


@inline
def _chain_rhs(y, u, c):
    return y[1], -y[0]


@inline
def _chain_jacobian(y, u, c):
    return 0.0 * y[0] + 1.0, 0.0 * y[0] - 1.0


CHAIN = System(
    name="chain",
    state_names=("a", "b"),
    parameter_names=(),
    n_constants=1,
    constants=_no_constants,
    rhs=_chain_rhs,
    jacobian=_chain_jacobian,
    jacobian_entries=(1, 2),
)


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ((1, 2), None),
        ((0, 2), "entry 0, the derivative of the rate of a by a, is 1 where differences of rhs give 0"),
        ((2, 1), "jacobian_entries must be whole numbers from 0 to 3 in rising order"),
        ((1, 4), "jacobian_entries must be"),
        ((), "jacobian_entries must be"),
        ((1, 2, 3), "jacobian returns 2 numbers; it must return a tuple of 3"),
    ],
)
def test_check_system__entries_of_the_jacobian(entries, words):
    system = dataclasses.replace(CHAIN, jacobian_entries=entries)
    cell = np.zeros((1, 0)), np.ones(1), np.array([[0.3, 0.2]])
    if words is None:
        check_system(system, *cell, jacobian=True)
        return
    with pytest.raises(SystemCheckError, match=re.escape(words)):
        check_system(system, *cell, jacobian=True)


@pytest.mark.slow
def test_lyapunov__a_system_of_two_states_may_declare_its_entries():
    options = {"n_transient": 1, "n_periods": 8, "n_blocks": 2, "system": CHAIN}
    found = lyapunov_exponents(np.zeros((1, 0)), np.ones(1), np.array([[0.3, 0.2]]), **options)
    # a rotation: vectors keep their lengths, up to the integration's error
    assert found.exponents == pytest.approx(0.0, abs=1e-6)
    assert found.divergence == pytest.approx(0.0, abs=1e-12)


def test_read_model__takes_up_to_1024_states_and_no_more():
    large = load_model(lorenz96(MAX_STATES + 1))
    assert large.derived.jacobian == ()
    assert large.system.jacobian is None
    assert len(load_model(lorenz96(MAX_STATES)).derived.jacobian) == MAX_STATES**2
    with pytest.raises(ModelError) as refused:
        load_model(lorenz96(MOST_STATES + 1))
    # one sentence, though all equations name states
    assert refused.value.problems == ["model.states: has 1025 states; 1024 are the most."]


@pytest.mark.slow
def test_sections__of_a_hundred_states_are_those_of_scipy():
    model = load_model(lorenz96(100, 3.0))
    start = np.random.default_rng(5).uniform(-1.0, 1.0, 100)
    found = sections(model.load(), [0.5], start[None], n_transient=0, n_keep=1, rtol=1e-11, atol=1e-11)
    wanted = scipy_end(lambda t, y: _rates(y) - 5.0, start, 2.0)
    np.testing.assert_allclose(found.section[0, 0], wanted, atol=1e-9)
    with pytest.raises(ValueError, match=r"lorenz96_.* has 100 states; attractors, .* need tangents, which"):
        lyapunov_exponents(model.load().pack()[None], np.ones(1), start[None], system=model.system)


def test_lyapunov__refuses_more_states_before_anything_is_computed(monkeypatch):
    names = tuple(f"x{i}" for i in range(MAX_STATES + 1))
    large = dataclasses.replace(
        CHAIN, name="large", state_names=names, is_angle=(), units=(), scales=(), sizes=(), escape=()
    )
    monkeypatch.setattr(exponents, "integrate", lambda *args, **options: pytest.fail("integrated"))
    words = (
        "large has 65 states; attractors, branches, equilibria, multipliers and Lyapunov exponents need tangents, "
        "which are computed for at most 64 states"
    )
    with pytest.raises(ValueError, match=words):
        lyapunov_exponents(np.zeros((1, 0)), np.ones(1), np.zeros((1, len(names))), system=large)
    model = SimpleNamespace(name="large", states=names)
    with pytest.raises(ValueError, match=f"n_exponents: {words}"):
        LYAPUNOV.settle(LyapunovOptions(n_exponents=3), model)
