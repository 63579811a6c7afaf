"""The models that ship as text say what the literature says, and meet its numbers.

`data/library.json` and its provenance: see data/README.md. Exponents of flows: see test_flows.
"""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core.crossing import Crossing
from magpend_core.models import LIBRARY, load_model
from magpend_core.models.sectioned import sectioned
from magpend_core.orbits import scaled_distance
from magpend_core.pointwise import evaluate, rates
from tests.core.cells import polish, run_cells

HZ = 1.0 / (2.0 * math.pi)
"""1 rad/s."""


@pytest.fixture(scope="module")
def library(reference):
    return reference("library")


def _duffing5(t, y, p):
    x, v = y
    return v, p["A"] * np.cos(t) - p["d"] * v - p["k"] * x**3


def _driven_pendulum(t, y, p):
    th, w = y
    return w, p["bias"] + p["A"] * np.cos(t) - p["d"] * w - p["w0"] ** 2 * np.sin(th)


def _three_magnets(t, y, p):
    place, velocity = np.array(y[:2]), np.array(y[2:])
    force = -(p["w0"] ** 2) * place - p["d"] * velocity
    for angle in (0.0, 2.0 * np.pi / 3.0, 4.0 * np.pi / 3.0):
        away = place - np.array([np.cos(angle), np.sin(angle)])
        force = force - p["strength"] * away * (away @ away + p["h"] ** 2) ** -1.5
    return (*velocity, *force)


def _belt(t, y, p):
    x, v = y
    u = p["belt"] - v
    size = p["mu"] + p["mu"] * (p["ratio"] - 1.0) * np.exp(-abs(u) / p["v0"])
    return v, size * (np.tanh(p["eps"] * u) if "eps" in p else np.sign(u)) - x - 2.0 * p["zeta"] * v


def _impact(t, y, p):
    x, v = y
    return v, p["A"] * np.cos(t) - 2.0 * p["zeta"] * v - x


def _van_der_pol(t, y, p):
    x, v = y
    return v, p["mu"] * (1.0 - x * x) * v - x


def _forced_van_der_pol(t, y, p):
    x, v = y
    return v, p["mu"] * (1.0 - x * x) * v - x + p["A"] * np.cos(t)


def _rossler(t, y, p):
    x, y, z = y
    return -y - z, x + p["a"] * y, p["b"] + z * (x - p["c"])


def _lorenz(t, y, p):
    x, y, z = y
    return p["sigma"] * (y - x), x * (p["rho"] - z) - y, x * y - p["beta"] * z


def _flutter(t, y, p):
    """Lee, Barton and Renson's equations M v'' + D v' + K v + (0, k2 al^2 + k3 al^3, 0) = 0 for v = (h, al, w)."""
    rho, b, a, u = p["rho"], p["b"], p["a"], p["U"]
    c1, c2, c3, c4 = (p[f"c{i}"] for i in range(1, 5))
    pi, s, lag, product = np.pi, 1.0 - c1 - c3, c1 * c2 + c3 * c4, c2 * c4 * (c1 + c3)
    off = p["mw"] * p["xa"] * b - a * pi * rho * b**3
    mass = np.array(
        [[p["mT"] + pi * rho * b**2, off, 0], [off, p["Ia"] + pi * (0.125 + a**2) * rho * b**4, 0], [0, 0, 1]]
    )
    air, half = pi * rho * b, a + 0.5
    heave = [p["ch"] + 2 * air * u * s, (1 + s * (1 - 2 * a)) * air * b * u, 2 * air * u**2 * lag]
    own = p["ca"] + (0.5 - a) * (1 - s * (1 + 2 * a)) * air * b**2 * u
    pitch = [-2 * half * air * b * s * u, own, -2 * air * b * u**2 * half * lag]
    damping = np.array([heave, pitch, [-1 / b, a - 0.5, (c2 + c4) * u / b]])
    heave = [p["kh"], 2 * air * u**2 * s, 2 * pi * rho * u**3 * product]
    pitch = [0, p["ka"] - 2 * half * air * s * b * u**2, -2 * air * u**3 * half * product]
    stiffness = np.array([heave, pitch, [0, -u / b, c2 * c4 * u**2 / b**2]])
    v, rate = y[:3], y[3:]
    spring = np.array([0.0, p["ka2"] * v[1] ** 2 + p["ka3"] * v[1] ** 3, 0.0])
    return np.concatenate([rate, np.linalg.solve(mass, -damping @ rate - stiffness @ v - spring)])


def _henon(t, y, p):
    return [1.0 - p["a"] * y[0] ** 2 + y[1], p["b"] * y[0]]


FLUTTER = {
    **{"U": 16.0, "kh": 3529.4, "kh3": 0.0, "ch": 14.5756, "ka": 54.1162, "ka2": 751.6, "ka3": 5006.7, "ka4": 0.0},
    **{"ka5": 0.0, "ca": 0.5628, "Ia": 0.1724, "xa": 0.24, "mw": 5.3, "mT": 16.9, "b": 0.15, "a": -0.5, "rho": 1.204},
    **{"c1": 0.165, "c2": 0.0455, "c3": 0.335, "c4": 0.3},
}

EQUATIONS = {
    "duffing5": (_duffing5, {"d": 0.08, "k": 1.0, "A": 0.2}),
    "driven-pendulum": (_driven_pendulum, {"d": 0.2, "w0": 1.0, "A": 1.66, "bias": 0.0}),
    "three-magnets": (_three_magnets, {"w0": 0.8, "d": 0.2, "strength": 1.0, "h": 0.2}),
    "belt": (_belt, {"belt": 1.5, "zeta": 0.05, "mu": 0.5, "ratio": 2.0, "v0": 0.5, "eps": 1000.0}),
    "belt-stick": (_belt, {"belt": 1.5, "zeta": 0.05, "mu": 0.5, "ratio": 2.0, "v0": 0.5}),
    "impact": (_impact, {"zeta": 0.1, "A": 0.3, "gap": 1.0, "r": 0.7}),
    "van-der-pol": (_van_der_pol, {"mu": 1.0}),
    "forced-van-der-pol": (_forced_van_der_pol, {"mu": 1.0, "A": 0.4}),
    "rossler": (_rossler, {"a": 0.2, "b": 0.2, "c": 5.7}),
    "flutter": (_flutter, FLUTTER),
    "henon": (_henon, {"a": 1.4, "b": 0.3}),
    "lorenz": (_lorenz, {"sigma": 10.0, "rho": 28.0, "beta": 8.0 / 3.0}),
}
"""Right-hand sides written down once more, at 1 rad/s, and the published parameters."""


def test_library__all_are_checked():
    """Each text that ships stands in this module; pendulum-text has a test of its own."""
    assert {path.stem for path in LIBRARY.glob("*.toml")} == {*EQUATIONS, "pendulum-text"}


@pytest.mark.parametrize("name", EQUATIONS)
def test_library__rates_are_those_of_the_literature(name):
    model, (right_hand_side, published) = load_model(name), EQUATIONS[name]
    parameters = model.load()
    assert {key: parameters[key] for key in model.parameter_names} == pytest.approx(published, rel=1e-15)
    rng = np.random.default_rng(5)
    states = rng.uniform(-1.4, 1.4, (40, len(model.states)))
    times = rng.uniform(0.0, 2.0 * np.pi, 40)
    expected = [right_hand_side(t, y, published) for t, y in zip(times, states, strict=True)]
    # a few roundings of numbers of size 10
    assert rates(times, states, parameters, HZ) == pytest.approx(np.array(expected), rel=1e-13, abs=1e-13)


@pytest.mark.parametrize("name", ["duffing5", "driven-pendulum"])
def test_library__coexisting_orbits(name, library):
    """Ueda's five orbits, Kennedy and Yorke's three: points and multipliers of an independent program."""
    orbits = library[name]["orbits"]
    found = _polished(name, orbits)
    assert found.converged.all()
    for i, orbit in enumerate(orbits):
        assert found.orbit_period[i] == orbit["period"]
        distance = scaled_distance(found.section[i], np.array(orbit["points"]), load_model(name).system)
        assert distance.min() < 1e-9
        for expected in orbit["multipliers"]:
            assert np.abs(found.multipliers[i] - complex(*expected)).min() < 1e-7


def _polished(name, orbits, frequency_hz=HZ, off=1e-3, **values):
    """Polish each published orbit from near a point of it."""
    points = np.array([orbit["points"][0] for orbit in orbits]) + off
    return polish(load_model(name).load(**values), points, [orbit["period"] for orbit in orbits], frequency_hz)


def _run(model, states, n_transient, n_keep, tolerance=1e-9, preset=None, frequency_hz=HZ, **values):
    options = {"n_transient": n_transient, "n_keep": n_keep, "rtol": tolerance}
    return run_cells(model.system, model.load(preset, **values).pack(), frequency_hz, states, **options)


def test_three_magnets__rests_are_the_roots_of_the_forces(library):
    """And the bob of a magnet comes to rest there: Attractors.jl's shares are in tests/workflows."""
    for preset, known in zip((None, "low-damping"), library["three-magnets"], strict=True):
        rests = np.array(known["equilibria"])
        starts = np.concatenate([1.02 * rests, np.zeros_like(rests)], axis=1)
        found = _run(load_model("three-magnets"), starts, 60, 1, preset=preset, frequency_hz=0.5)
        assert found.section[:, 0, 0, :2] == pytest.approx(rests, abs=1e-7)


def _cycles(name, crossing, points, periods, **values):
    return polish(sectioned(load_model(name), crossing).load(**values), points, periods)


@pytest.mark.slow
def test_van_der_pol__period_amplitude_and_multiplier(library):
    """At mu = 1 the period is 6.6632868593231 (Amore, arXiv 2111.12198)."""
    for known in library["van-der-pol"]:
        start = [[known["x_max"] + 0.01, 0.0]]
        found = _cycles("van-der-pol", Crossing("v", 0.0, "down", 60.0), start, [1], mu=known["mu"])
        assert found.converged.all()
        assert found.section[0, 0] == pytest.approx(known["x_max"], abs=1e-9)
        assert found.seconds[0] == pytest.approx(known["period"], abs=1e-9)
        assert found.multipliers[0, 0] == pytest.approx(known["multiplier"], abs=1e-8)
    assert library["van-der-pol"][2]["period"] == pytest.approx(6.6632868593231, abs=1e-12)


RETURN = Crossing("x", 0.0, "up", 60.0)
"""That of test_flows, whose engines serve here, too."""


def _half_a_turn(point):
    """Where Rossler's flow next crosses x = 0 upwards, by another integrator."""

    def rises(t, y, p):
        return y[0]

    rises.terminal, rises.direction = True, 1.0
    found = solve_ivp(
        _rossler, (0.0, 30.0), point, "DOP853", events=rises, args=(EQUATIONS["rossler"][1],), rtol=1e-12, atol=1e-12
    )
    return found.y_events[0][0]


@pytest.mark.slow
def test_rossler__orbits_of_chaosbook(library):
    """Unstable orbits of 1, 2 and 3 returns at c = 5.7: periods and multipliers."""
    known = library["rossler"]["orbits"]
    points = np.array([_half_a_turn(orbit["point"]) for orbit in known])
    found = _cycles("rossler", RETURN, points + [0.0, 1e-4, 1e-5], [1, 2, 3])
    assert found.converged.all()
    for i, orbit in enumerate(known):
        assert found.section[i] == pytest.approx(points[i], abs=1e-8)
        assert found.seconds[i] == pytest.approx(orbit["period"], abs=1e-8)
        assert found.multipliers[i, 0] == pytest.approx(orbit["multiplier"], rel=1e-6)
    # as printed by ChaosBook (P. Simon, extras/simon/Roessler.html)
    assert found.seconds[:2] == pytest.approx([5.88108845586, 11.7586260717], abs=1e-9)
    assert found.multipliers[:2, 0].real == pytest.approx([-2.403953527, -3.512006980], rel=1e-7)


@pytest.mark.slow
def test_rossler__multiplier_is_minus_one_at_the_doublings(library):
    """The stable orbit of 1, 2, 4 returns loses its stability where Brent's method found it."""
    for known in library["rossler"]["doublings"]:
        n, c = known["returns"], known["c"]
        model = sectioned(load_model("rossler"), RETURN)
        start = _run(model, [[0.0, -4.0, 0.06]], 4000, 1, c=c - 2e-3, frequency_hz=1.0 / 60.0)
        point = start.section[0, 0, :1]
        found = _cycles("rossler", RETURN, point, [n], c=c)
        assert found.orbit_period[0] == n
        assert found.seconds[0] == pytest.approx(known["period"], abs=1e-7)
        assert found.multipliers[0, 0] == pytest.approx(-1.0, abs=1e-6)


@pytest.mark.slow
def test_lorenz__shortest_orbit(library):
    """The orbit AB of Viswanath (Nonlinearity 16, 2003): 1.5586522107162 s."""
    known = library["lorenz"]["ab"]
    found = _cycles("lorenz", Crossing("z", 27.0, "up", 20.0), [np.array(known["point"]) + 1e-4], [2])
    assert found.converged.all()
    assert found.seconds[0] == pytest.approx(1.5586522107162, abs=1e-10)
    assert found.multipliers[0, 0] == pytest.approx(max(known["multipliers"]), rel=1e-7)


@pytest.fixture(scope="module")
def pendulums():
    """Parameters of the paper's pendulum without magnets, in Python and as text."""
    return load_model("pendulum-free").load(), load_model("pendulum-text").load()


@pytest.mark.slow
def test_pendulum_text__has_the_built_in_parameters_accelerations_and_quantities(pendulums):
    built_in, text = pendulums
    assert {p.name: (p.unit, text[p.name]) for p in text.model.parameters} == {
        p.name: (p.unit, built_in[p.name]) for p in built_in.model.parameters
    }
    # Four sweeps of the loads against two Newton steps: 1e-9 of accelerations of up to 1e3 rad/s2
    built_in, text = pendulums
    rng = np.random.default_rng(8)
    states = rng.uniform([-3.0, -3.0, -10.0, -20.0], [3.0, 3.0, 10.0, 20.0], (300, 4))
    times = rng.uniform(0.0, 0.5, 300)
    assert rates(times, states, text, 2.2) == pytest.approx(rates(times, states, built_in, 2.2), rel=1e-9, abs=1e-9)
    names = [q.name for q in text.model.quantities]
    shared = [name for name in names if name in {q.name for q in built_in.model.quantities}]
    assert {"energy", "drive_torque", "load1", "load2"} <= set(shared)
    assert evaluate(shared, times, states, text, 2.2) == pytest.approx(
        evaluate(shared, times, states, built_in, 2.2), rel=1e-8, abs=1e-9
    )


@pytest.mark.slow
def test_pendulum_text__sections_are_those_of_the_built_in_one(pendulums):
    """Twelve periods of regular motion at 2.7 Hz: the same states to 1e-9."""
    states = np.random.default_rng(9).uniform(-0.3, 0.3, (6, 4))
    found = [_run(p.model, states, 0, 12, 1e-12, frequency_hz=2.7).section for p in pendulums]
    assert found[1] == pytest.approx(found[0], rel=0.0, abs=1e-9)


def test_impact__orbits_with_one_impact(library):
    """Shaw and Holmes' orbits with one impact in n periods, in closed form but for the impact's instant."""
    hz = library["impact"]["frequency_rad"] * HZ
    for known in library["impact"]["orbits"]:
        found = _polished(
            "impact", [{"points": [known["section"]], "period": known["periods"]}], hz, 1e-4, A=known["F"]
        )
        assert found.converged.all()
        assert found.section[0] == pytest.approx(known["section"], abs=1e-8)
        assert found.orbit_period[0] == known["periods"]
        for expected in known["multipliers"]:
            assert np.abs(found.multipliers[0] - complex(*expected)).min() < 1e-6


def test_impact__the_stop_is_first_touched_at_the_grazing_amplitude(library):
    """Below it the motion is the linear oscillator's; just above, period 1 is gone (Nordmark 1991)."""
    grazing = library["impact"]["grazing"]
    assert grazing == pytest.approx(math.hypot(1.0 - 0.81, 0.18), abs=1e-12)
    for size, closes in ((0.999, True), (1.003, False)):
        found = _run(load_model("impact"), [[0.1, 0.0]], 400, 2, frequency_hz=0.9 * HZ, A=size * grazing).section[0, 0]
        assert (np.abs(found[1] - found[0]).max() < 1e-6) == closes


FARTHEST_BACK = Crossing("v", 0.0, "up", 30.0)
"""One section for both tests of the belt, and that of workflows/belt.toml: its engines are the same."""


def _turning_point(start, belt):
    """Where a mass that slips on the belt, slower than it, is farthest back, by another integrator."""
    p = EQUATIONS["belt-stick"][1]

    def slips(t, y):
        x, v = y
        size = p["mu"] + p["mu"] * (p["ratio"] - 1.0) * np.exp((v - belt) / p["v0"])
        return v, size - x - 2.0 * p["zeta"] * v

    def turns(t, y):
        return y[1]

    turns.terminal, turns.direction = True, 1.0
    found = solve_ivp(slips, (0.0, 30.0), start, "DOP853", events=turns, rtol=1e-12, atol=1e-12)
    return found.y_events[0][0][0]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "tolerance"), [("belt", 5e-3), ("belt-stick", 1e-8)])
def test_belt__stick_slip_cycle(name, tolerance, library):
    """Period and turning point of the cycle with true sticking; the steep tanh creeps a little."""
    for known in library["belt"]["cycles"]:
        model = sectioned(load_model(name), FARTHEST_BACK)
        found = _run(model, [[-2.0, 0.0]], 60, 2, 1e-9, frequency_hz=1.0 / 30.0, belt=known["belt"])
        assert found.return_time[0, 0] == pytest.approx(known["period"], abs=tolerance)
        # it comes here from where it slips, at 1 - 2 zeta belt: until then it has the belt's velocity
        back = _turning_point([known["x_slip"], known["belt"]], known["belt"])
        assert found.section[0, 0, :, 0] == pytest.approx(back, abs=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["belt", "belt-stick"])
def test_belt__rest_and_cycle_are_parted_by_the_unstable_cycle(name, library):
    """1e-3 inside it a state spirals to the rest, as far outside it sticks and slips."""
    for known in library["belt"]["rest"]:
        model = sectioned(load_model(name), FARTHEST_BACK)
        starts = [[known["unstable_x_max"] + off, 0.0] for off in (-1e-3, 1e-3)]
        found = _run(model, starts, 400, 1, 1e-9, frequency_hz=1.0 / 30.0, belt=known["belt"])
        inside, outside = found.section[:, 0, 0, 0]
        unstable_x_min = _turning_point([known["unstable_x_max"], 0.0], known["belt"])
        assert inside > unstable_x_min + 0.05
        assert outside < unstable_x_min - 0.05
