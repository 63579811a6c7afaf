"""Lyapunov exponents: published and analytic values, the divergence, closed orbits, independence of lanes."""

from functools import partial

import numpy as np
import pytest

from magpend_core import Status, jacobian, lyapunov_exponents, polish_orbits, sections
from magpend_core.lyapunov import MOST_LOSS
from magpend_core.models.duffing.system import DUFFING
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from tests.core.cells import stroboscopic_map

exponents_of = partial(lyapunov_exponents, system=PENDULUM_FITTED)
orbits_of = partial(polish_orbits, system=PENDULUM_FITTED)

UNIT_FREQUENCY = 0.5 / np.pi  # forcing cos t
CHAOTIC = [0.2, -1.0, 1.0, 0.3]  # damping, linear, cubic, amplitude of the chaotic Duffing oscillator


def packed(parameters, n):
    return np.tile(parameters.pack(), (n, 1))


def of_duffing(parameters, n_cells=32, **options):
    starts = options.pop("starts", np.random.default_rng(4).uniform(-1.0, 1.0, (n_cells, 2)))
    cells = np.tile(parameters, (len(starts), 1)), np.full(len(starts), UNIT_FREQUENCY), starts
    return exponents_of(*cells, system=DUFFING, **options)


def test_duffing__published_exponents_half_the_damping_and_none():
    # x'' = .3 cos t + x - x^3 - .2 x': (0.158, -0.358) +- 0.002 per unit time, recomputed
    # independently; ChaosTools.jl issue 301 has 0.15894, -0.35894
    found = of_duffing(CHAOTIC, n_periods=1600, rtol=1e-7, atol=1e-7)
    mean = found.exponents.mean(axis=0)
    assert mean == pytest.approx([0.158, -0.358], abs=0.002)
    assert found.weighted.mean(axis=0) == pytest.approx([0.158, -0.358], abs=0.003)
    # the spread between cells is what their standard errors say
    assert found.exponents[:, 0].std(ddof=1) == pytest.approx(found.stderr[:, 0].mean(), rel=0.5)
    # complex pair: both exponents are -c/2; the plain average oscillates about them
    found = of_duffing([0.2, 2.0, 0.0, 1.0], 2)
    assert found.weighted == pytest.approx(-0.1, abs=1e-6)
    assert found.exponents == pytest.approx(-0.1, abs=1e-3)
    assert (found.exponents[:, 0] >= found.exponents[:, 1]).all()
    # negative cubic stiffness: one of the two escapes
    starts = np.array([[0.0, 0.0], [3.0, 1.0]])
    found = of_duffing([0.1, 1.0, -1.0, 0.1], starts=starts, n_exponents=2, n_periods=16)
    assert found.status.tolist() == [Status.BOUNDED, Status.DIVERGED]
    assert np.isfinite(found.exponents[0]).all()
    for name in ("exponents", "stderr", "weighted", "blocks", "divergence", "loss"):
        assert np.isnan(getattr(found, name)[1]).all(), name


@pytest.mark.parametrize("parameters", [CHAOTIC, [0.15, -1.0, 1.0, 0.2], [0.2, 2.0, 0.0, 1.0]])
def test_duffing__exponents_add_up_to_minus_the_damping(parameters):
    found = of_duffing(parameters, 4, n_periods=64, rtol=1e-11, atol=1e-11)
    assert found.exponents.sum(axis=1) == pytest.approx(-parameters[0], abs=1e-8)
    assert found.divergence == pytest.approx(-parameters[0], abs=1e-12)
    assert found.is_whole


@pytest.mark.slow
@pytest.mark.parametrize("case", [0, 1])
def test_lyapunov__reference_spectra(preset, reference, case):
    expected = reference("lyapunov")[case]
    frequency, n = expected["frequency_hz"], 8
    starts = np.array([[0.1 + 0.03 * i, 0.1, 0.0, 0.0] for i in range(n)])
    run = sections(preset, frequency, starts, n_transient=[200, 1200][case], n_keep=1)
    states = run.section[:, -1]
    if case == 1:  # the left attractor, on which the reference is
        states = states[np.abs(states[:, 0] + 0.0557) < 0.01]
    found = exponents_of(packed(preset, len(states)), np.full(len(states), frequency), states, n_periods=800)
    errors = np.hypot(found.stderr.mean(axis=0) / np.sqrt(len(states)), expected["stderr"])
    assert len(states) >= 2
    assert (np.abs(found.exponents.mean(axis=0) - expected["lyapunov_per_s"]) < 3.0 * errors).all()


@pytest.mark.slow
def test_lyapunov__on_closed_orbits_the_logarithms_of_the_multipliers(preset, reference):
    orbits = reference("orbits")
    points = np.array([orbit["section"] for orbit in orbits])
    frequency = np.array([orbit["frequency_hz"] for orbit in orbits])
    periods = np.array([orbit["orbit_period"] for orbit in orbits])
    orbit = orbits_of(packed(preset, len(points)), frequency, points, periods)
    expected = np.log(np.abs(orbit.multipliers)) * (frequency / periods)[:, None]
    cells, options = (packed(preset, len(points)), frequency, orbit.section), {"rtol": 1e-9, "atol": 1e-9}
    found = exponents_of(*cells, **options)
    assert np.sort(found.weighted)[:, ::-1] == pytest.approx(expected, abs=1e-4)
    largest = exponents_of(*cells, n_exponents=1, **options)
    assert largest.weighted == pytest.approx(expected[:, :1], abs=1e-4)
    assert largest.divergence == pytest.approx(found.divergence, abs=5e-5)
    # as the docstring says of the plain average
    assert (np.abs(found.exponents - expected) < 4.0 / 400 * frequency[:, None]).all()


@pytest.mark.slow
def test_lyapunov__like_a_qr_of_the_period_maps(preset):
    # the textbook recipe, on Jacobians of the stroboscopic map and numpy's QR
    # few periods: chaos separates the two computations
    n, start = 16, np.array([[0.5, -0.3, 0.0, 0.0]])
    one = packed(preset, 1)
    q, logs, point = np.eye(4), np.zeros(4), start
    for i in range(10 + n):
        image, derivative = stroboscopic_map(one, np.array([2.4]), point, 1, rtol=1e-11)
        q, r = np.linalg.qr(derivative[0] @ q)
        logs += np.log(np.abs(np.diag(r))) if i >= 10 else 0.0
        point = image[:, -1]
    found = exponents_of(one, np.array([2.4]), start, n_transient=10, n_periods=n, rtol=1e-11, atol=1e-11, n_blocks=2)
    assert found.exponents[0] == pytest.approx(np.sort(logs * 2.4 / n)[::-1], abs=1e-4)


@pytest.fixture(scope="module")
def mixed(preset):
    """Chaotic and closed cells at three frequencies."""
    frequency = np.repeat([0.3, 1.0, 2.2], 6)
    rng = np.random.default_rng(3)
    states = np.concatenate([rng.uniform(-0.4, 0.4, (18, 2)), np.zeros((18, 2))], axis=1)
    return packed(preset, 18), frequency, states, {"n_transient": 20, "n_periods": 32, "n_blocks": 4}


@pytest.mark.slow
def test_lyapunov__sum_is_the_divergence(mixed):
    found = exponents_of(*mixed[:3], rtol=1e-10, atol=1e-10, **mixed[3])
    missing = np.abs(found.exponents.sum(axis=1) - found.divergence)
    assert np.median(missing) < 1e-6
    assert missing.max() < 0.01 * np.abs(found.exponents).sum(axis=1).max()
    assert found.loss.max() < MOST_LOSS


@pytest.mark.slow
def test_lyapunov__a_cell_depends_on_itself_alone(mixed):
    parameters, frequency, states, options = mixed
    together = exponents_of(parameters, frequency, states, n_lanes=16, **options)
    order = np.arange(18)[::-1]
    back = exponents_of(parameters[order], frequency[order], states[order], n_lanes=64, **options)
    alone = exponents_of(parameters[4:5], frequency[4:5], states[4:5], **options)
    for name in ("exponents", "stderr", "weighted", "blocks", "divergence", "loss"):
        a = getattr(together, name)
        assert (a == getattr(back, name)[order]).all(), name
        assert (a[4] == getattr(alone, name)[0]).all(), name


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ({"n_exponents": 5}, "n_exponents = 5 .* at most 4"),
        ({"n_periods": 100, "n_blocks": 16}, "n_periods = 100 must be a multiple of n_blocks = 16; give 112"),
        ({"n_blocks": 1}, "n_blocks = 1 .* 2 or more"),
        ({"n_transient": -1}, "n_transient = -1"),
    ],
)
def test_lyapunov__options_out_of_bounds(preset, option, words):
    with pytest.raises(ValueError, match=words):
        exponents_of(packed(preset, 1), np.array([2.2]), np.zeros((1, 4)), **option)
    with pytest.raises(ValueError, match="1, 2 and 1 rows"):
        exponents_of(packed(preset, 1), np.array([2.2, 2.3]), np.zeros((1, 4)))


@pytest.mark.slow
def test_lyapunov__of_a_stiff_rest(preset):
    # without the drive the pendulum comes to rest, where friction decays at 1800 /s: the steps must not
    # outgrow that, though the trajectory would allow it
    still = preset.replace(q=0.0)
    run = sections(still, 1.0, [[0.3, 0.2, 0.0, 0.0]], n_transient=100, n_keep=1)
    state = run.section[:, -1]
    exact = np.sort(np.linalg.eigvals(jacobian(0.0, state[0], still, 1.0)).real)[::-1]
    options = {"n_transient": 10, "n_periods": 16, "n_blocks": 2}
    for n in (1, 4):
        found = exponents_of(packed(still, 1), np.ones(1), state, n_exponents=n, **options)
        # the pendulum creeps on, and the exponents with it
        assert found.exponents[0, :3] == pytest.approx(exact[: min(n, 3)], rel=1e-3)
    assert exact[3] < -1000.0
