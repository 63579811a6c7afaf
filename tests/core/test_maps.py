"""Maps: systems whose equations give the next state, against closed forms and plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from magpend_core.engine.checks import SystemCheckError
from magpend_core.lyapunov import lyapunov_exponents
from magpend_core.models import load_model
from magpend_core.models.text import read_model
from magpend_core.orbits import polish_orbits, section_map
from magpend_core.rotation import TurningState, rotation_numbers
from magpend_core.sections import sections
from magpend_core.status import Status
from magpend_core.trajectory import trajectory

pytestmark = pytest.mark.slow  # engines of its own

LOGISTIC = {"name": "logistic", "kind": "map", "states": {"x": {}}, "parameters": {"r": 4.0}}
LOGISTIC |= {"equations": {"x": "r*x*(1 - x)"}}
CIRCLE = {
    "name": "circle",
    "kind": "map",
    "states": {"phi": {"unit": "rad", "on_circle": True}},
    "parameters": {"W": 0.4, "K": 0.5},
    "equations": {"phi": "phi + 2*pi*W - K*sin(phi)"},
}
STANDARD = {
    "name": "standard",
    "kind": "map",
    "states": {"theta": {"unit": "rad", "on_circle": True}, "p": {}},
    "parameters": {"K": 0.95},
    "define": {"kicked": "p + K*sin(theta)"},
    "equations": {"theta": "theta + kicked", "p": "kicked"},
}
N_LATTICE, EPS = 8, 0.1
LATTICE = {
    "name": "lattice",
    "kind": "map",
    "states": {f"x{i}": {} for i in range(N_LATTICE)},
    "parameters": {"r": 3.9, "eps": EPS},
    "define": {f"f{i}": f"r*x{i}*(1 - x{i})" for i in range(N_LATTICE)},
    "equations": {
        f"x{i}": f"(1 - eps)*f{i} + eps/2*(f{i - 1 if i else N_LATTICE - 1} + f{(i + 1) % N_LATTICE})"
        for i in range(N_LATTICE)
    },
}


def iterates(table, states, n, **values):
    found = sections(read_model(table).load(**values), None, states, n_transient=0, n_keep=n)
    return found, found.section


def exponents(table, states, **options):
    model = read_model(table)
    packed = np.tile(model.load().pack(), (len(states), 1))
    return lyapunov_exponents(packed, np.ones(len(states)), np.array(states), system=model.system, **options)


def test_iterates__are_those_of_the_closed_form():
    """x = sin(2**n theta)**2 solves the logistic map at r = 4; errors double with each iteration."""
    theta, n = np.array([0.3, 1.1]), np.arange(1, 21)
    found, x = iterates(LOGISTIC, np.sin(theta)[:, None] ** 2, 20)
    errors = np.abs(x[..., 0] - np.sin(2.0**n * theta[:, None]) ** 2)
    assert (errors < 2.0**n * 1e-15).all()
    assert (found.n_steps == 20).all()


def test_iterates__beyond_the_bounds_diverge():
    found, _ = iterates(LOGISTIC, [[0.3], [0.5]], 50, r=4.2)
    assert found.status.tolist() == [Status.DIVERGED] * 2


def test_lattice__follows_numpy_with_its_tangents():
    """Eight states, whose tangent vectors the engine carries in loops: iterates, derivative and exponents."""
    rng = np.random.default_rng(3)
    start, ring = rng.uniform(0.2, 0.8, N_LATTICE), np.eye(N_LATTICE)
    coupling = (1.0 - EPS) * ring + EPS / 2.0 * (np.roll(ring, 1, axis=0) + np.roll(ring, -1, axis=0))
    x, jacobian, q, growth = start, ring, ring, np.zeros(N_LATTICE)
    for i in range(600):
        step = coupling @ np.diag(3.9 * (1.0 - 2.0 * x))
        x = coupling @ (3.9 * x * (1.0 - x))
        q, upper = np.linalg.qr(step @ q)
        growth += np.log(np.abs(np.diag(upper))) * (i >= 200)
        if i < 5:
            jacobian, fifth = step @ jacobian, x
    model = read_model(LATTICE)
    packed, one = model.load().pack()[None], np.ones(1)
    found = section_map(packed, one, start[None], 5, system=model.system)
    assert found.images[0, -1] == pytest.approx(fifth, abs=1e-12)
    assert found.derivatives[0] == pytest.approx(jacobian, rel=1e-11, abs=1e-11)
    found = lyapunov_exponents(packed, one, start[None], system=model.system, n_transient=200, n_periods=400)
    # chaos has parted the two trajectories; their means over 400 iterations scatter by some hundredths
    assert found.exponents[0] == pytest.approx(np.sort(growth / 400)[::-1], abs=0.06)
    assert np.isnan(found.divergence).all()  # a determinant of this size is not written out


def test_henon__fixed_points_and_their_multipliers():
    """x = (b - 1 +- sqrt((1 - b)**2 + 4 a)) / (2 a), with multipliers whose product is -b."""
    model, (a, b) = load_model("henon"), (0.3, 0.3)
    packed = np.tile(model.load(a=a, b=b).pack(), (2, 1))
    x = (b - 1.0 + np.array([1.0, -1.0]) * np.sqrt((1.0 - b) ** 2 + 4.0 * a)) / (2.0 * a)
    guess = np.stack([x, b * x], axis=1) + 1e-2
    found = polish_orbits(packed, np.ones(2), guess, np.ones(2, np.int64), system=model.system)
    assert found.section[:, 0] == pytest.approx(x, abs=1e-13)
    roots = [np.roots([1.0, 2.0 * a * value, -b]) for value in x]
    assert np.sort(found.multipliers.real) == pytest.approx(np.sort(roots), abs=1e-12)
    assert found.seconds.tolist() == [1.0, 1.0]


def test_exponents__of_the_full_logistic_map_are_ln_2():
    found = exponents(LOGISTIC, np.linspace(0.11, 0.83, 32)[:, None], n_transient=10, n_periods=16_000)
    # the mean of 32 trajectories: the scatter of ln|4 (1 - 2 x)| is pi/sqrt(12) and uncorrelated
    assert found.exponents.mean() == pytest.approx(np.log(2.0), abs=4.0 * 0.907 / np.sqrt(32 * 16_000))
    assert found.exponents == pytest.approx(found.divergence[:, None], abs=1e-12)


def test_exponents__of_henon_add_up_to_ln_b():
    table = load_model("henon").definition.table
    found = exponents(table, [[0.1, 0.1], [0.0, 0.2]], n_transient=100, n_periods=1600)
    assert found.exponents.sum(axis=1) == pytest.approx(np.log(0.3), abs=1e-13)
    assert found.divergence == pytest.approx(np.log(0.3), abs=1e-13)
    assert (found.exponents[:, 0] > 0.3).all()


def test_standard_map__keeps_area_and_the_golden_circle_bounds_momentum():
    """The last circle breaks at K = .971635 (Greene, J. Math. Phys. 20 (1979) 1183): chaos about p = 0 is bounded
    below it, and passes p = 2 pi above.
    """
    model = read_model(STANDARD)
    starts = np.stack([np.linspace(-1e-3, 1e-3, 32), np.full(32, 1e-4)], axis=1)
    some = np.random.default_rng(1).uniform(-3.0, 3.0, (16, 2))
    packed = np.tile(model.load(K=1.2).pack(), (16, 1))
    steps = section_map(packed, np.ones(16), some, 3, system=model.system).derivatives
    assert np.linalg.det(steps) == pytest.approx(1.0, abs=1e-11)
    found = exponents(STANDARD, some[:2], n_transient=10, n_periods=160)
    assert found.divergence == pytest.approx(0.0, abs=1e-12)
    assert found.exponents.sum(axis=1) == pytest.approx(0.0, abs=1e-12)
    for k, passes in ((0.95, False), (1.2, True)):
        found = sections(model.load(K=k), None, starts, n_transient=0, n_keep=40_000)
        assert (np.abs(found.section[..., 1]).max() > 2.0 * np.pi) == passes


def test_circle_map__rotation_numbers():
    """Without coupling W; within |W| < K/(2 pi) the angle rests. The lift is exact, however far the angle turns."""
    model = read_model(CIRCLE)
    cells = [(0.4 + 1e-3 * np.sqrt(2.0), 0.0), (0.07, 0.5), (1.07, 0.5), (0.5, 0.5)]
    packed = np.array([model.load(W=w, K=k).pack() for w, k in cells])
    found = rotation_numbers(
        packed, np.ones(4), np.full((4, 1), 0.3), system=model.system, turning=TurningState((0,)), n_periods=2000
    )
    assert found.rotation[[0, 1, 2]] == pytest.approx([cells[0][0], 0.0, 1.0], abs=1e-9)
    assert found.rotation[3] == pytest.approx(0.5, abs=1e-9)


def test_trajectory__has_whole_iterations_alone():
    parameters = read_model(CIRCLE).load(W=0.7, K=0.0)
    found = trajectory(parameters, 1.0, [0.1], [0.0, 1.0, 5.0])
    assert found[:, 0] == pytest.approx(0.1 + 2.0 * np.pi * 0.7 * np.array([0.0, 1.0, 5.0]), abs=1e-13)
    with pytest.raises(ValueError, match="whole numbers of iterations"):
        trajectory(parameters, 1.0, [0.1], [0.5])
    with pytest.raises(ValueError, match="is a map"):
        sections(parameters, 2.0, [[0.1]], n_transient=0, n_keep=1)


@pytest.mark.parametrize(
    ("change", "key", "word"),
    [
        ({"kind": "maps"}, "model.kind", "flow, map"),
        ({"equations": {"x": "x*t"}}, "model.equations.x", "'t'"),
        ({"define": {"g": "f*x"}, "equations": {"x": "g"}}, "model.define.g", "'f'"),
        ({"impacts": [{"of": "x", "direction": "up", "set": {"x": "0"}}]}, "model.impacts", "iterations"),
        ({"mirror": {"signs": {"x": -1}, "half_period": True}}, "model.mirror.half_period", "drive"),
    ],
)
def test_read_model__refuses_what_a_map_cannot_have(change, key, word):
    with pytest.raises(ValueError, match=rf"^{key}: .*{word}"):
        read_model({**LOGISTIC, **change})


def test_checks__angle_that_the_map_does_not_carry_round():
    table = {**CIRCLE, "equations": {"phi": "0.5*phi + W + 0*K"}}
    with pytest.raises(SystemCheckError, match="is_angle: phi"):
        iterates(table, [[0.1]], 1)
