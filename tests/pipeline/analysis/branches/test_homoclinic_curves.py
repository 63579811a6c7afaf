"""Curves of homoclinic orbits in two parameters, against closed forms and shooting with scipy's DOP853."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve, minimize_scalar

import magpend
from magpend_core.crossing import Crossing
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.basins.regimes_figure import plot_curves
from pipeline.analysis.branches.analysis import curves_table
from pipeline.analysis.branches.arclength import Point
from pipeline.analysis.branches.codimension_two import SpecialPoint
from pipeline.analysis.branches.curves import curves_dataset, curves_from
from pipeline.analysis.branches.homoclinic import Loop
from pipeline.analysis.branches.homoclinic_curves import homoclinic_curves, loop_near
from pipeline.analysis.branches.problems import Family, Value
from pipeline.results.tabular import words_of
from tests.core.flows import LORENZ, flow, table
from tests.pipeline.analysis.branches.test_branches_flows import followed

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("long_steps_of_a_file")]


def family_in(equations, first, second, scales, **values):
    parameters = flow(equations).load(**values)
    return Family(parameters.model.system, 0, 1.0, parameters.pack(), (first, second), scales)


def at_second(curve, value):
    """First parameter where the curve has a value of the second, by a polynomial through its nearest points."""
    points = np.array([curve.family.values(p.u) for p in curve.points])
    near = np.argsort(np.abs(points[:, 1] - value))[:8]
    middle, unit = points[near, 1].mean(), np.ptp(points[near, 1])
    return float(np.polyval(np.polyfit((points[near, 1] - middle) / unit, points[near, 0], 7), (value - middle) / unit))


def test_homoclinic_curves__closed_form():
    """Sandstede (1997): y**2 = x**2 - x**3 is invariant at m = a**2, and the saddle's eigenvalues are a - 1, a + 1.

    The saddle quantity 2 a vanishes at a = 0, at a = 1 the stable eigenvalue does, and at a = -1 the unstable one. At
    the last one the orbit leaves the saddle so slowly that a segment must be as short as the stable eigenvalue asks.
    """
    equations = table(
        "sandstede_plane",
        {"x": "a*x + y - a*x**2 + (m - a**2)*x*(2 - 3*x)", "y": "x + a*y - 1.5*x**2 - 1.5*a*x*y"},
        {"a": -0.5, "m": 0.25},
    )
    family = family_in(equations, "m", "a", (2.0, 2.0))
    times = np.linspace(0.0, 16.0, 2000)

    def rates(_, u):
        x, y = u
        return [-0.5 * x + y + 0.5 * x * x, x - 0.5 * y - 1.5 * x * x + 0.75 * x * y]

    loop = solve_ivp(rates, (0.0, 16.0), [0.01, 0.01 * np.sqrt(0.99)], "DOP853", times, rtol=1e-9, atol=1e-11).y.T
    guess = Loop(family, times, loop, np.zeros(2), np.array([0.26, -0.5]))
    (curve,) = homoclinic_curves([guess], ((-1.0, 2.0), (-1.5, 1.5)))
    points = np.array([family.values(p.u) for p in curve.points])
    np.testing.assert_allclose(points[1:-1, 0], points[1:-1, 1] ** 2, atol=1e-8)
    assert curve.ends == ("saddle_node_homoclinic", "saddle_node_homoclinic")
    assert sorted((one.kind, round(one.values[1])) for one in curve.special) == [
        ("neutral_saddle", 0),
        ("saddle_node_homoclinic", -1),
        ("saddle_node_homoclinic", 1),
    ]
    for one in curve.special:
        a = round(one.values[1])
        np.testing.assert_allclose(one.values, [a * a, a], atol=1e-6 if a else 1e-8)


TAKENS = table("takens", {"x": "y", "y": "b1 + b2*x + x**2 + x*y"}, {"b1": 0.0, "b2": 0.0})


def split(rates, saddle, jacobian):
    """Distance of the saddle's manifolds on y = 0, left of the saddle, by DOP853."""
    values, vectors = np.linalg.eig(jacobian)
    ends = []
    for sign in (1.0, -1.0):

        def level(_, u):
            return u[1]

        level.terminal, level.direction = True, 1.0 if sign > 0.0 else -1.0
        own = vectors[:, np.argmax(sign * values)]
        start = np.array([saddle, 0.0]) - 1e-7 * own * np.sign(own[0])

        def flow_of(_, u, sign=sign):
            return [sign * rate for rate in rates(*u)]

        found = solve_ivp(flow_of, (0.0, 400.0), start, "DOP853", events=level, rtol=1e-12, atol=1e-14)
        ends.append(found.y_events[0][0, 0])
    return ends[0] - ends[1]


def takens_split(b1, b2):
    saddle = 0.5 * (-b2 + np.sqrt(b2 * b2 - 4.0 * b1))
    return split(lambda x, y: (y, b1 + b2 * x + x * x + x * y), saddle, [[0.0, 1.0], [b2 + 2.0 * saddle, saddle]])


def damped_split(b1, b2):
    saddle = np.sqrt(-b1)
    return split(lambda x, y: (y, b1 + b2 * y + x * x + x * y), saddle, [[0.0, 1.0], [2.0 * saddle, b2 + saddle]])


def takens_of(equations):
    """The Bogdanov-Takens point of x' = y, y' = 0 + ... at 0, with the parameters b1 = b2 = 0."""
    family = family_in(equations, "b1", "b2", (1.0, 1.0))
    jacobian = np.array([[0.0, 1.0], [0.0, 0.0]])
    value = Value(np.zeros(1), np.zeros((1, 4)), np.zeros((1, 2)), jacobian, is_rest=True)
    return SpecialPoint("bogdanov_takens", family, Point(np.zeros(4), np.zeros(4), value, 0), np.zeros(2))


def test_loop_near__a_point_with_a_mirror():
    """y' = b1 x + b2 y - x**3 - x**2 y has no square term: the saddle 0 and foci at x**2 = b1, where b2 = 4/5 b1 is the
    exact leading order (Guckenheimer and Holmes 1983, Sect. 7.3) and the guess has weights 1/7 and 6/7.
    """
    equations = table("mirrored_takens", {"x": "y", "y": "b1*x + b2*y - x**3 - x**2*y"}, {"b1": 0.0, "b2": 0.0})
    guess = loop_near(takens_of(equations), 0.05)
    assert guess.values[1] / guess.values[0] == pytest.approx(6.0 / 7.0, rel=1e-4)
    np.testing.assert_allclose(guess.saddle, 0.0, atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 0.1, 0.01])
def test_loop_near__in_any_units(scale):
    """The predicted loop moves as x' = y says, whatever the scale of y, and lies where b1 = -(6/25) b2**2 + ..."""
    states = {"x": {}, "y": {"scale": scale}}
    equations = table("scaled_takens", {"x": "y", "y": "b1 + b2*x + x**2 + x*y"}, {"b1": 0.0, "b2": 0.0}, states=states)
    guess = loop_near(takens_of(equations), 0.05)
    assert guess.values[0] / guess.values[1] ** 2 == pytest.approx(-6.0 / 25.0, rel=0.05)
    x, y = guess.states.T
    np.testing.assert_allclose(np.gradient(x, guess.times), y, atol=0.05 * np.abs(y).max())


def test_homoclinic_curves__bogdanov_takens():
    """b1 = -(6/25) b2**2 + ... from the point (0, 0), at which the curve ends."""
    takens = takens_of(TAKENS)
    family, guess = takens.family, loop_near(takens, 0.05)
    assert guess.values[0] / guess.values[1] ** 2 == pytest.approx(-6.0 / 25.0, rel=0.05)
    (curve,) = homoclinic_curves([guess], ((-1.0, 1.0), (-0.3, 0.1)))
    assert curve.ends == ("bound", "bogdanov_takens")
    (end,) = curve.special
    assert end.kind == "bogdanov_takens"
    np.testing.assert_allclose(end.values, 0.0, atol=1e-6)
    for value in (-0.25, -0.1, -0.03):
        near = at_second(curve, value)
        known = brentq(takens_split, 1.0001 * near, 0.9999 * near, args=(value,), xtol=1e-12)
        assert near == pytest.approx(known, abs=1e-7 * abs(value))
    points = np.array([family.values(p.u) for p in curve.points[:-1]])
    ratio = points[:, 0] / points[:, 1] ** 2
    assert ratio[np.argmin(np.abs(points[:, 1]))] == pytest.approx(-6.0 / 25.0, abs=5e-4)


def test_curves__spring_from_a_bogdanov_takens_point(tmp_path):
    """The whole command on x' = y, y' = b1 + b2 y + x**2 + x y: its Hopf curve b1 = -b2**2 ends at (0, 0), from where
    the homoclinic curve b1 = -(49/25) b2**2 + ... is followed.
    """
    model = magpend.model("x' = y\ny' = b1 + b2*y + x**2 + x*y", name="damped", b1=-0.1, b2=0.2)
    spec = magpend.Spec("sweep", model).with_section(of="y", value=0.0, longest=60.0)
    spec = spec.with_axis("b1", values=[-0.12, -0.1]).with_start_random(n=1, x=(-0.4, -0.3), y=(0.0, 0.05), seed=0)
    run = magpend.run(spec.with_integration(n_transient=100, n_keep=4), tmp_path / "run", workers=0)
    run.branches(low=-0.12, high=0.02, stable=True)
    found = run.curves(second="b2", second_low=-0.02, second_high=0.22)
    kinds = [words_of(found["kind"])[code] for code in found["kind"].values]
    rows = {kind: np.array([found[name].values[k] for name in ("b1", "b2")]) for k, kind in enumerate(kinds)}
    hopf, homoclinic = (row[:, np.isfinite(row[0])] for row in (rows["hopf"], rows["homoclinic"]))
    np.testing.assert_allclose(hopf[0], -(hopf[1] ** 2), atol=1e-9)
    assert np.abs(homoclinic[:, 0]).max() < 1e-9
    ratio = homoclinic[0, 1:] / homoclinic[1, 1:] ** 2
    near = np.argsort(homoclinic[1, 1:])[:6]
    assert np.polyfit(homoclinic[1, 1:][near], ratio[near], 2)[-1] == pytest.approx(-49.0 / 25.0, abs=1e-5)
    b1, b2 = homoclinic[:, np.argmin(np.abs(homoclinic[1] - 0.1))]
    assert b1 == pytest.approx(brentq(damped_split, 1.001 * b1, 0.999 * b1, args=(b2,), xtol=1e-13), abs=1e-9)


NEURON = table(
    "neuron",
    {"v": "y - 0.5*(v + 0.5) - 2*w*(v + 0.7) - m*(v - 1)", "w": "rate*(winf - w)*tau"},
    {"y": 0.075, "rate": 1.15},
    define={
        "m": "(1 + tanh((v + 0.01)/0.15))/2",
        "winf": "(1 + tanh((v - 0.1)/0.145))/2",
        "tau": "cosh((v - 0.1)/0.29)",
    },
)


def neuron_rates(u, y, rate):
    v, w = u
    m, inf = (0.5 * (1.0 + np.tanh(x)) for x in ((v + 0.01) / 0.15, (v - 0.1) / 0.145))
    drift = y - 0.5 * (v + 0.5) - 2.0 * w * (v + 0.7) - m * (v - 1.0)
    return np.array([drift, rate * (inf - w) * np.cosh((v - 0.1) / 0.29)])


def neuron_split(y, rate):
    """Distance on v = 0.0365 between the saddle's unstable and stable manifold, by DOP853."""
    saddle = fsolve(neuron_rates, [-0.185, 0.019], (y, rate), xtol=1e-13)
    steps = 1e-6 * np.eye(2)
    jacobian = np.array([neuron_rates(saddle + h, y, rate) - neuron_rates(saddle - h, y, rate) for h in steps]).T
    values, vectors = np.linalg.eig(jacobian / 2e-6)
    ends = []
    for sign in (1.0, -1.0):

        def level(_, state):
            return state[0] - 0.0365

        level.direction, level.terminal = -sign, True
        own = vectors[:, np.argmax(sign * values)]
        start = saddle + 1e-6 * own * np.sign(own[0 if sign > 0.0 else 1])

        def flow_of(_, u, sign=sign):
            return sign * neuron_rates(u, y, rate)

        found = solve_ivp(flow_of, (0.0, 300.0), start, "DOP853", events=level, rtol=1e-11, atol=1e-13)
        ends.append(found.y_events[0][0, 1])
    return ends[0] - ends[1]


def resting_current(v):
    """Minus the current at which the neuron rests at a voltage."""
    w = 0.5 * (1.0 + np.tanh((v - 0.1) / 0.145))
    return neuron_rates([v, w], 0.0, 1.0)[0]


def test_curves_from__homoclinic_orbits_of_a_neuron():
    """From the end of a branch. The fold of the equilibria lies at one current, whatever the rate of w."""
    ds = followed(NEURON, "v", [0.0365, 0.1], "y", 0.06, 0.09, level=0.0365, y=0.075)
    parameters = sectioned(flow(NEURON), Crossing("v", 0.0365, longest=50.0)).load(y=0.075)
    found = curves_from(ds.isel(bifurcation=slice(0)), parameters, "rate", ((0.06, 0.09), (0.9, 1.25)), 1)
    (curve,) = [one for one in found if one.kind == "homoclinic"]
    assert at_second(curve, 1.15) == pytest.approx(0.07293069625, abs=1e-9)
    for rate in (1.05, 1.2):
        near = at_second(curve, rate)
        known = brentq(neuron_split, near - 1e-5, near + 1e-5, args=(rate,), xtol=1e-12)
        assert near == pytest.approx(known, abs=1e-8)
    told = curves_dataset(found, "y", "rate", parameters.model)
    lines = curves_table(told).lines
    (end,) = curve.special
    fold = minimize_scalar(resting_current, (-0.3, -0.24, -0.2), tol=1e-12)
    assert end.kind == curve.ends[0] == "saddle_node_homoclinic"
    assert end.values[0] == pytest.approx(-fold.fun, abs=1e-7)
    np.testing.assert_allclose(end.point.u[0], fold.x, atol=1e-5)
    assert any("HOM homoclinic, saddle quantity" in line for line in lines)
    plot_curves(told)


def lorenz(rho, beta, sigma=10.0):
    """Return the trajectory that leaves the origin along its unstable eigenvector, until x = 0 or t = 15."""

    def crossing(_, state):
        return state[0]

    crossing.terminal = True
    own = 0.5 * (-(sigma + 1.0) + np.sqrt((sigma + 1.0) ** 2 + 4.0 * sigma * (rho - 1.0)))
    start = 1e-7 * np.array([1.0, 1.0 + own / sigma, 0.0])

    def rates(_, u):
        return [sigma * (u[1] - u[0]), u[0] * (rho - u[2]) - u[1], u[0] * u[1] - beta * u[2]]

    return solve_ivp(rates, (0.0, 15.0), start, "DOP853", events=crossing, rtol=1e-11, atol=1e-13)


def test_homoclinic_curves__lorenz():
    """The stable manifold of the origin has two dimensions; the curve passes (13.926557407, 8/3)."""
    first = lorenz(13.92, 8.0 / 3.0)
    size = np.linalg.norm(first.y, axis=0)
    after = int(size.argmax())
    until = after + int(size[after:].argmin()) + 1
    family = family_in(LORENZ, "rho", "beta", (10.0, 1.0))
    guess = Loop(family, first.t[:until], first.y.T[:until], np.zeros(3), np.array([13.92, 8.0 / 3.0]))
    (curve,) = homoclinic_curves([guess], ((10.0, 20.0), (2.55, 2.8)))
    assert curve.ends == ("bound", "bound")
    assert at_second(curve, 8.0 / 3.0) == pytest.approx(13.926557407, abs=1e-7)
    for beta in (2.57, 2.77):
        near = at_second(curve, beta)
        low, high = near - 1e-7, near + 1e-7
        assert not len(lorenz(low, beta).t_events[0])  # it comes to rest at the other equilibrium
        assert len(lorenz(high, beta).t_events[0])


def test_curves_from__saddle_node_on_a_circle():
    """The angle's rate is omega - level*sin: the fold of the equilibria is at omega = level."""
    equations = table(
        "level_circle",
        {"x": "x*(1 - s) - y*rate", "y": "y*(1 - s) + x*rate"},
        {"omega": 1.3, "level": 1.0},
        define={"s": "x**2 + y**2", "rate": "omega - level*y/sqrt(s)"},
    )
    ds = followed(equations, "y", [1.0, 0.0], "omega", 0.5, 1.5, omega=1.3)
    parameters = sectioned(flow(equations), Crossing("y", longest=50.0)).load(omega=1.3)
    (curve,) = curves_from(ds.isel(bifurcation=slice(0)), parameters, "level", ((0.5, 1.5), (0.7, 1.3)), 1)
    assert (curve.kind, curve.family.period, curve.start) == ("fold", 0, -1)
    np.testing.assert_allclose(curve.values[:, 0], curve.values[:, 1], atol=1e-8)
    assert np.ptp(curve.values[:, 1]) > 0.5
