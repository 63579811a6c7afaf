"""What the model must do: modes, energies, wells, symmetry, coexisting motions."""

import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.optimize import root

from magpend_core import accelerations, energy, jacobian, load_preset, sections, torques, trajectory

HANGING = np.zeros(4)


@pytest.mark.parametrize("start", [[2.0, 1.0, 0.0, 0.0], [0.3, -0.5, 12.0, -20.0]])
def test_sections__conserve_energy_without_friction_drive_and_magnets(bare, start):
    result = sections(bare, 1.0, [start], n_transient=0, n_keep=10, rtol=1e-11, atol=1e-11)
    before, after = energy(np.array(start), bare), energy(result.section[0], bare)
    # ten periods of a few hundred steps, each within 1e-11
    assert np.max(abs(after - before)) < 1e-9 * before
    # and the angles did move
    assert np.ptp(result.section[0, :, 0]) > 0.1


def balance(parameters, frequency, start, n_periods, n_points=40_001):
    """Energy gained over whole periods, and the work of all torques with its parts."""
    t = np.linspace(0.0, n_periods / frequency, n_points)
    y = trajectory(parameters, frequency, start, t, rtol=1e-11, atol=1e-11)
    f = torques(t, y, parameters, frequency)
    w1, w2 = y[:, 2], y[:, 3]
    r1, r2 = f.friction.T
    q1, q2 = f.magnet_torque.T
    powers = {"drive": f.drive * w1, "friction": -r1 * w1 - r2 * (w2 - w1), "magnets": q1 * w1 + q2 * w2}
    gained = energy(y[-1], parameters) - energy(y[0], parameters)
    return gained, {name: simpson(power, x=t) for name, power in powers.items()}


@pytest.mark.parametrize(("frequency", "start"), [(2.2, [0.2, 0.2, 0.0, 0.0]), (2.7, [-0.1, 0.3, 2.0, -5.0])])
def test_trajectory__energy_balance(preset, frequency, start):
    gained, work = balance(preset, frequency, start, 3)
    assert abs(gained - sum(work.values())) < 1e-8 * max(abs(w) for w in work.values())
    # each part counts
    assert work["drive"] > 0.1
    assert work["friction"] < -0.1
    assert abs(work["magnets"]) > 1e-3


def equilibrium(parameters, guess):
    def residual(angles):
        return accelerations(0.0, [*angles, 0.0, 0.0], parameters, 1.0)

    found = root(residual, guess, tol=1e-13)
    assert np.max(abs(residual(found.x))) < 1e-9
    return np.array([*found.x, 0.0, 0.0])


@pytest.mark.parametrize("friction", [{}, {"T1": 0.0, "T2": 0.0, "mu": 0.0}])
def test_jacobian__hanging_is_unstable_between_two_stable_wells(friction):
    parameters = load_preset(q=0.0, **friction)
    right, left = equilibrium(parameters, [0.1, 0.1]), equilibrium(parameters, [-0.1, -0.1])
    assert 0.03 < right[0] < 0.3
    assert left == pytest.approx(-right, abs=1e-12)
    for well in (right, left):
        assert np.linalg.eigvals(jacobian(0.0, well, parameters, 1.0)).real.max() < -1e-3
    assert accelerations(0.0, HANGING, parameters, 1.0) == pytest.approx([0.0, 0.0], abs=1e-12)
    growth = np.linalg.eigvals(jacobian(0.0, HANGING, parameters, 1.0))
    assert np.sum(growth.real > 0.01) == 1


def test_jacobian__hanging_without_magnets(bare):
    parameters = load_preset(q=0.0, alpha1=0.0, alpha2=0.0)
    assert np.linalg.eigvals(jacobian(0.0, HANGING, parameters, 1.0)).real.max() < 0.0
    eigenvalues = np.linalg.eigvals(jacobian(0.0, HANGING, bare, 1.0))
    assert abs(eigenvalues.real).max() < 1e-12
    modes = np.unique(np.round(abs(eigenvalues.imag) / (2.0 * np.pi), 9))
    # of the paper's constants, to the digits given
    assert modes == pytest.approx([0.926, 1.433], abs=5e-4)


def test_sections__fall_into_the_well_on_either_side():
    parameters = load_preset(q=0.0, T1=1e-3, T2=1e-3, mu=0.0, c=0.02)
    right = equilibrium(parameters, [0.1, 0.1])
    start = np.array([0.02, 0.02, 0.0, 0.0])
    result = sections(parameters, 1.0, [start, -start], n_transient=30, n_keep=1)
    # the little dry friction left holds the links within a few thousandths of the well
    assert result.section[:, 0] == pytest.approx(np.array([right, -right]), abs=5e-3)


@pytest.mark.slow
def test_sections__left_and_right_motions_coexist(preset, reference):
    right, left = (np.array(orbit["section"]) for orbit in reference("orbits")[:2])
    rng = np.random.default_rng(0)
    starts = rng.uniform(-1.0, 1.0, (48, 4)) * [0.5, 0.5, 3.0, 3.0]
    # chaotic transients before some of them last hundreds of periods, and depend on the last bit
    result = sections(preset, 2.2, starts, n_transient=1500, n_keep=1, stop_when_closed=True)
    ends = result.section[:, 0]
    is_right, is_left = (np.max(abs(ends - orbit), axis=1) < 1e-4 for orbit in (right, left))
    assert is_right.sum() >= 5
    assert is_left.sum() >= 5
    assert (result.orbit_period[is_right | is_left] == 1).all()
