"""The equations of motion against other derivations and other arithmetic."""

import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st

from magpend_core import accelerations, energy, jacobian, load_preset, torques
from magpend_core.models.pendulum.equations import VACUUM_PERMEABILITY
from magpend_core.models.pendulum.parameters import LINKS

ANGLE, RATE = st.floats(-np.pi, np.pi), st.floats(-20.0, 20.0)
STATE = st.tuples(ANGLE, ANGLE, RATE, RATE).map(np.array)


def random_states(n, seed, rate=20.0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (n, 4)) * [np.pi, np.pi, rate, rate]


def near_magnet(n, seed):
    """States at which the magnets push hard."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (n, 4)) * [0.15, 0.3, 3.0, 3.0]


def numbers(row, name):
    return np.array(row[name], dtype=float)


def assert_close(value, expected):
    """To 1e-12 relative; the floor is far below any torque or acceleration that matters."""
    assert np.all(np.abs(value - expected) <= 1e-12 * np.abs(expected) + 1e-15), (value, expected)


def test_accelerations_and_torques__agree_with_40_digit_arithmetic(preset, reference):
    rows = reference("accelerations")
    assert len(rows) == 24
    for row in rows:
        given = row["t"], row["y"], preset, row["frequency_hz"]
        assert_close(accelerations(*given), numbers(row, "acceleration"))
        found = torques(*given)
        for name in ("load", "friction", "drive", "magnet_moment", "magnet_torque"):
            assert_close(getattr(found, name), numbers(row, name))


@pytest.mark.parametrize("overrides", [{}, {"mu": 4.61e-3}, {"T1": 0.5, "T2": 0.2, "c": 0.05}, {"g": 0.0}])
def test_accelerations__solve_the_implicit_equations(overrides):
    # Eq. 1 with the loads and friction at the accelerations found, written out once more
    parameters = load_preset(**overrides)
    p = parameters.as_dict()
    y = np.concatenate([random_states(300, 1), near_magnet(300, 2)])
    t = np.linspace(0.0, 0.5, len(y))
    (a1, a2), f = accelerations(t, y, parameters, 2.2).T, torques(t, y, parameters, 2.2)
    psi1, psi2, w1, w2 = y.T
    n12 = p["m2"] * p["e2"] * p["l1"]
    b1 = p["J1"] + p["e1"] ** 2 * p["m1"] + p["l1"] ** 2 * p["m2"]
    b2 = p["J2"] + p["e2"] ** 2 * p["m2"]
    s12, c12 = np.sin(psi1 - psi2), np.cos(psi1 - psi2)
    weight1 = (p["m1"] * p["e1"] + p["m2"] * p["l1"]) * p["g"] * np.sin(psi1)
    weight2 = p["m2"] * p["e2"] * p["g"] * np.sin(psi2)
    r1, r2 = f.friction.T
    q1, q2 = f.magnet_torque.T
    first = b1 * a1 + n12 * c12 * a2 + n12 * s12 * w2**2 + weight1 + r1 - r2 - f.drive - q1
    second = n12 * c12 * a1 + b2 * a2 - n12 * s12 * w1**2 + weight2 + r2 - q2
    size = b1 * abs(a1) + b2 * abs(a2) + n12 * (w1**2 + w2**2) + abs(f.drive) + 1.0
    # two approximate Newton steps: what they leave grows with the fifth power or so of mu
    bound = 1e-13 if p["mu"] < 1e-3 else 2e-8
    assert np.max(np.abs(first) / size) < bound
    assert np.max(np.abs(second) / size) < bound


def lagrangian_accelerations():
    """Accelerations and energy of two rigid links under gravity, by sympy from the Lagrangian."""
    t = sympy.Symbol("t")
    g, l1, m1, m2, e1, e2, j1, j2 = sympy.symbols("g l1 m1 m2 e1 e2 J1 J2", positive=True)
    q = [sympy.Function(f"psi{i}")(t) for i in (1, 2)]
    x1, y1 = e1 * sympy.sin(q[0]), -e1 * sympy.cos(q[0])
    x2 = l1 * sympy.sin(q[0]) + e2 * sympy.sin(q[1])
    y2 = -l1 * sympy.cos(q[0]) - e2 * sympy.cos(q[1])
    rates = [x.diff(t) for x in q]
    kinetic = (
        m1 * (x1.diff(t) ** 2 + y1.diff(t) ** 2)
        + m2 * (x2.diff(t) ** 2 + y2.diff(t) ** 2)
        + j1 * rates[0] ** 2
        + j2 * rates[1] ** 2
    ) / 2
    potential = g * (m1 * (y1 + e1) + m2 * (y2 + l1 + e2))
    state = sympy.symbols("p1 p2 w1 w2")
    plain = dict(zip([*rates, *q], [*state[2:], *state[:2]], strict=True))
    equations = [
        ((kinetic - potential).diff(w).diff(t) - (kinetic - potential).diff(x)) for x, w in zip(q, rates, strict=True)
    ]
    second = [x.diff(t, 2) for x in q]
    mass, rest = sympy.linear_eq_to_matrix(equations, second)
    arguments = (*state, g, l1, m1, m2, e1, e2, j1, j2)
    matrices = [m.subs(plain) for m in (mass, rest)]
    return (
        sympy.lambdify(arguments, matrices, "numpy"),
        sympy.lambdify(arguments, (kinetic + potential).subs(plain), "numpy"),
    )


@pytest.mark.slow
def test_accelerations__equal_sympys_lagrangian(bare):
    solve, total_energy = lagrangian_accelerations()
    rng = np.random.default_rng(4)
    for y in random_states(100, 5):
        values = rng.uniform(0.5, 2.0, 8) * list(bare.as_dict().values())[:8]
        parameters = bare.replace(**dict(zip((p.name for p in LINKS), values, strict=True)))
        mass, rest = solve(*y, *values)
        expected = np.linalg.solve(mass, rest).ravel()
        value = accelerations(0.2, y, parameters, 1.0)
        assert value == pytest.approx(expected, rel=1e-12, abs=1e-12 * np.abs(expected).max())
        assert energy(y, parameters) == pytest.approx(total_energy(*y, *values), rel=1e-13)


def gap(y, parameters):
    """Horizontal and vertical distance of the moving magnet from the fixed one."""
    m = parameters
    l1 = parameters["l1"]
    dx = l1 * np.sin(y[:, 0]) + m["l2"] * np.sin(y[:, 1])
    dy = m["h"] - l1 * np.cos(y[:, 0]) - m["l2"] * np.cos(y[:, 1])
    return dx, dy


def test_magnet_torque__sum_with_regularisation(preset):
    # Fx h = M_M and Fy = Fx dy dx/(dx^2 + delta^2) give Q1 + Q2 = M_M (1 - dy/h delta^2/(dx^2 + delta^2))
    y = near_magnet(400, 7)
    dx, dy = gap(y, preset)
    m = preset
    f = torques(0.0, y, preset, 2.0)
    expected = f.magnet_moment * (1.0 - dy / m["h"] * m["delta"] ** 2 / (dx**2 + m["delta"] ** 2))
    assert f.magnet_torque.sum(axis=1) == pytest.approx(expected, rel=1e-12, abs=1e-15)


@pytest.mark.slow
def test_dipole_torques__equal_the_force_between_poles(dipoles):
    # F = mu0 p1 p2/(4 pi r^2) away from the fixed magnet at (0, -h), times the lever of each angle
    m, l1 = dipoles, dipoles["l1"]
    for y in np.concatenate([random_states(50, 8), near_magnet(50, 9)]):
        at = np.array([l1 * np.sin(y[0]) + m["l2"] * np.sin(y[1]), -l1 * np.cos(y[0]) - m["l2"] * np.cos(y[1])])
        line = at - [0.0, -m["h"]]
        r = np.hypot(*line)
        force = VACUUM_PERMEABILITY * m["pole1"] * m["pole2"] / (4.0 * np.pi * r**2) * line / r
        expected = [
            force @ (l1 * np.array([np.cos(y[0]), np.sin(y[0])])),
            force @ (m["l2"] * np.array([np.cos(y[1]), np.sin(y[1])])),
        ]
        f = torques(0.0, y, dipoles, 2.0)
        assert f.magnet_torque == pytest.approx(expected, rel=1e-12, abs=1e-16)
        assert f.magnet_moment == pytest.approx(sum(expected), rel=1e-12, abs=1e-16)


@pytest.mark.parametrize("duty_cycle", [0.4927, 0.5, 0.2, 0.85])
@pytest.mark.parametrize("frequency", [0.3, 2.2])
def test_drive__is_high_for_the_duty_cycle(duty_cycle, frequency):
    parameters = load_preset(duty_cycle=duty_cycle)
    n = 20_000
    t = (np.arange(n) + 0.5) / n / frequency
    drive = torques(t, np.zeros((n, 4)), parameters, frequency).drive
    high = drive > 0.0
    assert abs(high.mean() - duty_cycle) <= 1.0 / n
    # high first, low after
    assert high[: int(high.sum())].all()
    assert abs(drive).max() <= parameters["q"]
    crest = 1.0 - np.cos(np.pi * duty_cycle)  # of sin + a
    plateau = parameters["q"] * 2.0 / np.pi * np.arctan(parameters["eps_drive"] * crest)
    assert drive.max() == pytest.approx(plateau, rel=1e-6)


def test_drive__edges_are_at_zero_and_at_the_duty_cycle(preset):
    period = 1.0 / 2.2
    edges = np.array([0.0, preset["duty_cycle"] * period])
    for sign, edge in zip((1.0, -1.0), edges, strict=True):
        before, at, after = torques(edge + np.array([-1e-5, 0.0, 1e-5]), np.zeros((3, 4)), preset, 2.2).drive
        assert abs(at) < 1e-12
        assert sign * before < -5e-3
        assert sign * after > 5e-3


@given(STATE, st.floats(-1e-3, 1e-3))
@settings(deadline=None)  # the first example compiles
def test_friction__opposes_the_motion_in_the_joints(y, slow):
    preset = load_preset()
    for state in (y, y * [1.0, 1.0, slow, slow]):
        r1, r2 = torques(0.0, state, preset, 2.0).friction
        assert r1 * state[2] >= 0.0
        assert r2 * (state[3] - state[2]) >= 0.0


@pytest.mark.slow
@given(STATE, st.integers(-3, 3), st.integers(-3, 3), st.floats(0.0, 1.0))
@settings(max_examples=200, deadline=None)
def test_accelerations__full_turns_change_nothing(y, k1, k2, t):
    preset = load_preset()
    turned = y + 2.0 * np.pi * np.array([k1, k2, 0, 0])
    a, b = accelerations(t, y, preset, 2.0), accelerations(t, turned, preset, 2.0)
    # an angle of 20 rad is good to 4e-15, the magnet's slope at most 1e4 per rad
    assert b == pytest.approx(a, rel=1e-12, abs=2e-10)
    near = np.array([0.05, 0.1, 1.0, -2.0])
    a, b = (jacobian(t, state, preset, 2.2) for state in (near, near + turned - y))
    assert b == pytest.approx(a, rel=1e-9, abs=1e-8)


def test_pointwise__shapes(preset):
    y = near_magnet(19, 10)
    many = accelerations(0.1, y, preset, 2.2)
    assert many.shape == (19, 2)
    one = accelerations(0.1, y[17], preset, 2.2)
    assert one.shape == (2,)
    assert (one == many[17]).all()
    t = np.linspace(0.0, 3.0, 19)
    assert (accelerations(t, y, preset, 2.2)[5] == accelerations(t[5], y[5], preset, 2.2)).all()
    assert jacobian(0.1, y, preset, 2.2).shape == (19, 4, 4)
    assert torques(0.1, y[0], preset, 2.2).load.shape == (2,)
    states = np.random.default_rng(0).normal(size=(2, 3, 4))
    found = torques(0.1, states, preset, 2.2)
    assert found.drive.shape == (2, 3)
    assert found.load.shape == (2, 3, 2)
    np.testing.assert_array_equal(found.friction[1, 2], torques(0.1, states[1, 2], preset, 2.2).friction)


def test_accelerations__weightless_links_at_rest_stay(preset):
    # no load in the bearings: a square root of zero and its slope
    weightless = preset.replace(g=0.0, q=0.0, alpha1=0.0, alpha2=0.0)
    assert (accelerations(0.0, [0.3, 0.2, 0.0, 0.0], weightless, 1.0) == 0.0).all()
    assert np.isfinite(jacobian(0.0, [0.3, 0.2, 0.0, 0.0], weightless, 1.0)).all()
