"""Poincare sections at levels of expressions: crossings, points moved onto them, multipliers, what is refused."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core import Status, load_model, lyapunov_exponents, sections
from magpend_core.crossing import Crossing
from magpend_core.engine.crossing import with_section, without_section
from magpend_core.models.parameters import ParameterError
from magpend_core.models.sectioned import sectioned
from magpend_core.models.text import read_model
from magpend_core.orbits import on_section, section_map
from magpend_core.poincare import Section
from tests.core.cells import polish, run_cells
from tests.core.flows import HOPF, LORENZ, ROSSLER, VAN_DER_POL, flow, model_of, table


def seen(model, of, value=0.0, direction="up", **changes):
    """The parameters of a model seen where an expression crosses a level."""
    return sectioned(flow(model), Crossing(of, value, direction, changes.pop("longest", 50.0))).load(**changes)


def crossings(parameters, start, n, tolerance=1e-13):
    """The first section points of a trajectory, and the times between them."""
    hertz = parameters.model.crossing.frequency_hz
    system, packed = parameters.model.system, parameters.pack()
    found = run_cells(system, packed, hertz, [start], n_keep=n, rtol=tolerance)
    return found.section[0, 0], found.return_time[0, 0]


def rossler_crossings(of, start, seconds, c):
    """The same by scipy: upward zeros of a function of the state, and their instants."""

    def rates(_, y):
        return [-y[1] - y[2], y[0] + 0.2 * y[1], 0.2 + y[2] * (y[0] - c)]

    def event(_, y):
        return of(*y)

    event.direction = 1.0
    found = solve_ivp(rates, (0.0, seconds), start, "DOP853", rtol=3e-14, atol=1e-15, events=event, max_step=0.02)
    return found.y_events[0], found.t_events[0]


@pytest.mark.parametrize(
    ("of", "value", "function"),
    [
        ("x + y", 1.0, lambda x, y, z: x + y - 1.0),
        ("x + y - 1", 0.0, lambda x, y, z: x + y - 1.0),
        ("2*x - y + 3*z", 0.5, lambda x, y, z: 2.0 * x - y + 3.0 * z - 0.5),
        ("x**2 + y**2", 16.0, lambda x, y, z: x**2 + y**2 - 16.0),
    ],
)
def test_run_branches__where_scipy_finds_crossings(of, value, function):
    start = [-2.0, -3.0, 0.05]
    points, times = crossings(seen(ROSSLER, of, value, c=2.5), start, 3)
    known, instants = rossler_crossings(function, start, 40.0, 2.5)
    assert len(known) > 3
    np.testing.assert_allclose(points, known[:3], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(np.cumsum(times), instants[:3], rtol=1e-12)
    assert np.abs(function(*points.T)).max() < 1e-13 * 16.0


def test_run_branches__a_plane_is_a_state_of_the_rotated_system():
    """In the axes u = 0.6 x + 0.8 y and w = 0.6 y - 0.8 x Rossler's plane 0.6 x + 0.8 y = 1 is u = 1."""
    define = {"x": "0.6*u - 0.8*w", "y": "0.8*u + 0.6*w", "dx": "-y - z", "dy": "x + 0.2*y"}
    equations = {"u": "0.6*dx + 0.8*dy", "w": "0.6*dy - 0.8*dx", "z": "0.2 + z*(x - c)"}
    turned = table("turned", equations, {"c": 5.7}, define=define)
    axes = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    start = np.array([-2.0, -3.0, 0.05])
    points, times = crossings(seen(ROSSLER, "0.6*x + 0.8*y", 1.0, "down", c=5.7), start, 12)
    known, instants = crossings(seen(turned, "u", 1.0, "down"), axes @ start, 12)
    np.testing.assert_allclose(points @ axes.T, known, atol=1e-9)
    np.testing.assert_allclose(times, instants, atol=1e-9)


@pytest.mark.parametrize(
    ("of", "value", "guess"),
    [
        ("x + y", 0.1, [0.4, -0.3]),
        ("y - x**2 + c*x", 0.2, [0.5, 0.3]),
        ("s*y", 0.01, [0.5, 0.04]),
        ("tilt(x, 2)", 0.3, [0.3, 0.0]),
    ],
)
def test_polish_orbits__hopf_normal_form(of, value, guess):
    """The period and the multiplier are those of the cycle, whatever the section; so is the radius."""
    define = {**HOPF["define"], "tilt(a, b)": "a + y/b"}
    model = {**HOPF, "define": define, "parameters": {**HOPF["parameters"], "c": 0.5}}
    found = polish(seen(model, of, value), [guess])
    assert found.converged.all()
    assert found.seconds[0] == pytest.approx(np.pi, rel=1e-11)
    assert (found.section[0] ** 2).sum() == pytest.approx(0.25, rel=1e-10)
    np.testing.assert_allclose(found.multipliers[0], [np.exp(-0.5 * np.pi), 0.0], atol=1e-9)
    assert found.multipliers[0, 1] == 0.0  # exactly: analyses count the multipliers above 0


@pytest.mark.parametrize("of", ["x + y", "x + 0.1*y**2", "exp(0.2*x) + y"])
def test_polish_orbits__multipliers_do_not_depend_on_the_section(of):
    plain = polish(seen(ROSSLER, "x", c=2.5), [[0.0, -4.34, 0.058]])
    assert plain.converged.all()
    parameters = seen(ROSSLER, of, c=2.5)
    guess, _ = crossings(parameters, plain.section[0], 1)
    found = polish(parameters, guess)
    assert found.converged.all()
    np.testing.assert_allclose(found.multipliers, plain.multipliers, rtol=1e-8, atol=1e-10)
    assert found.seconds[0] == pytest.approx(plain.seconds[0], rel=1e-11)


@pytest.mark.parametrize("of", ["x + y", "x + 0.1*y**2 - 0.3*z"])
def test_section_map__differences(of):
    """The derivative is that of the map from any state beside the section, moved onto it, to the next crossing."""
    parameters = seen(ROSSLER, of, c=3.0)
    system, packed = parameters.model.system, parameters.pack()[None]
    rate = np.array([parameters.model.crossing.frequency_hz])
    (point,), _ = crossings(parameters, [0.0, -4.0, 0.05], 1)
    found = section_map(packed, rate, point[None], 2, system=system)
    steps = 1e-5 * np.eye(3)
    around = np.concatenate([point + steps, point - steps])
    ends = section_map(np.tile(packed, (6, 1)), np.tile(rate, 6), around, 2, system=system).images[:, -1]
    np.testing.assert_allclose(found.derivatives[0], (ends[:3] - ends[3:]).T / 2e-5, atol=3e-7)
    column = int(Section(system).moved_state(Section(system).normals(point[None], packed))[0])
    assert (found.derivatives[0, :, column] == 0.0).all()
    # images move along the surface
    normal = Section(system).normals(found.images[0, -1:], packed)[0]
    np.testing.assert_allclose(normal @ found.derivatives[0], 0.0, atol=1e-9)


def test_sections__of_an_expression():
    parameters, start = load_model("rossler").load(c=2.5), [[-2.0, -3.0, 0.05]]
    found = sections(parameters, None, start, n_transient=0, n_keep=3, section=Crossing("x + y", 1.0, longest=50.0))
    points, times = crossings(seen(ROSSLER, "x + y", 1.0, c=2.5), start[0], 3)
    np.testing.assert_allclose(found.section[0], points, atol=1e-6)
    np.testing.assert_allclose(found.return_time[0], times, atol=1e-6)


def test_on_section__along_one_state():
    parameters = seen(ROSSLER, "x**2 + 4*y", 5.0)
    points = np.array([[0.1, 1.0, 3.0], [3.0, -0.9, 2.0], [np.nan, 0.0, 0.0]])
    moved = on_section(points, parameters.pack(), parameters.model.system)
    np.testing.assert_allclose(moved[0], [0.1, (5.0 - 0.01) / 4.0, 3.0], rtol=1e-14)
    np.testing.assert_allclose(moved[1], [np.sqrt(5.0 + 3.6), -0.9, 2.0], rtol=1e-14)
    assert np.isnan(moved[2]).any()
    np.testing.assert_array_equal(on_section(moved[:2], parameters.pack(), parameters.model.system), moved[:2])
    assert on_section(np.zeros((0, 3)), parameters.pack(), parameters.model.system).shape == (0, 3)
    # x**2 = -5 has no point
    assert np.isnan(on_section([[1.0, 0.0, 0.0]], seen(ROSSLER, "x**2", -5.0).pack(), _square())).any()


def _square():
    return sectioned(flow(ROSSLER), Crossing("x**2", -5.0, longest=50.0)).system


def test_run_branches__parameters_move_the_section():
    """With x - a*y in place of a level: at each a the points are where x = a y."""
    model = {**VAN_DER_POL, "parameters": {"mu": 1.0, "a": 0.0}, "quantities": {"slope": "x - a*v"}}
    points = [crossings(seen(model, "slope", a=a), [2.0, 0.0], 4)[0] for a in (0.0, 0.5, -0.7)]
    for a, own in zip((0.0, 0.5, -0.7), points, strict=True):
        np.testing.assert_allclose(own[:, 0], a * own[:, 1], atol=1e-13)
    assert np.abs(points[1] - points[2])[-1].max() > 0.1


def test_run_branches__turns_of_an_angle():
    """A pendulum under a torque goes round: sin(th) rises through 0 where th passes 0, once a turn."""
    pendulum = table("turner", {"th": "w", "w": "3 - 0.5*w - sin(th)"}, states={"th": {"on_circle": True}})
    points, times = crossings(seen(pendulum, "sin(th)"), [0.3, 5.0], 6)
    known, instants = crossings(seen(pendulum, "th"), [0.3, 5.0], 6)
    np.testing.assert_allclose(points, known, atol=1e-11)
    np.testing.assert_allclose(times, instants, atol=1e-11)


def test_run_branches__two_crossings_within_a_step():
    """An excursion beyond a curved surface, much shorter than a step, is found: -x^8 with x = cos t is above -1e-12 for
    |x| < 10^-1.5, twice a turn.
    """
    slow = model_of({"x": "v", "v": "-x"})
    parameters = sectioned(slow, Crossing("-x**8", -1e-12, longest=50.0)).load()
    _, times = crossings(parameters, [1.0, 0.0], 40, tolerance=1e-5)
    np.testing.assert_allclose(times[1:], np.pi, atol=1e-3)


@pytest.mark.slow
def test_section_map__crossings_that_rounding_hides():
    """About a centre far from 0 the steps onto a surface are lost in the states' last digits; each of 256 starts on a
    cycle returns all the same, after its period.
    """
    far = table(
        "far", {"x": "u - v - u*r", "y": "u + v - v*r"}, {}, define={"u": "x - 20", "v": "y - 20", "r": "u**2 + v**2"}
    )
    parameters = seen(far, "0.003*u - 0.26*v", longest=20.0)
    system, angles = parameters.model.system, np.linspace(0.02, 3.0, 256)
    starts = np.column_stack([20.0 + np.cos(angles), 20.0 + np.sin(angles)])
    packed = np.tile(parameters.pack(), (len(starts), 1))
    found = section_map(packed, np.full(len(starts), 0.05), starts, 2, rtol=1e-12, system=system)
    assert (found.status == Status.BOUNDED).all()
    np.testing.assert_allclose(found.times[:, 1], 2.0 * np.pi, rtol=1e-4)


def test_lyapunov_exponents__rossler():
    found = []
    for of in ("x", "x + 0.5*y"):
        parameters = seen(ROSSLER, of, direction="down", c=5.7)
        n, hertz = 16, parameters.model.crossing.frequency_hz
        starts = np.random.default_rng(3).uniform(-5.0, 5.0, (n, 3)) * [1.0, 1.0, 0.0]
        system, packed = parameters.model.system, parameters.pack()
        settled = run_cells(system, packed, hertz, starts, n_transient=50).section[:, 0, -1]
        options = {"n_transient": 20, "n_periods": 2000, "rtol": 1e-10, "atol": 1e-10}
        exponents = lyapunov_exponents(np.tile(packed, (n, 1)), np.full(n, hertz), settled, system=system, **options)
        found.append(exponents.exponents.mean(axis=0))
    np.testing.assert_allclose(found[1], [0.0714, 0.0, -5.3943], atol=0.003)
    np.testing.assert_allclose(found[1], found[0], atol=0.003)


def test_with_section__names():
    parameters = seen(LORENZ, "x + y")
    system = parameters.model.system
    plain = without_section(system)
    assert plain.parameter_names == parameters.model.whole.parameter_names
    assert plain.section is None
    assert plain.surface is None
    assert parameters.model.section_states == ("x", "y", "z")
    assert system.label != seen(LORENZ, "x + y", direction="down").model.system.label
    with pytest.raises(ValueError, match=r"no such state; it has x, y, z\. For an expression give a model as text"):
        with_section(load_model("lorenz").system, "x + y", 1)


def test_sectioned__unit_digest_and_mirror():
    quantities = {"e": {"value": "(x**2 + y**2)/2", "unit": "J"}}
    model = flow({**HOPF, "quantities": quantities, "mirror": {"signs": {"x": -1, "y": -1}}})
    of = {name: sectioned(model, Crossing(name)) for name in ("e", "x + y", "x*y", "x")}
    assert of["e"].parameter("section_value").unit == "J"
    assert of["x + y"].parameter("section_value").unit == "1"
    assert len({own.digest for own in of.values()}) == 4
    assert sectioned(model, Crossing("x + y")) is of["x + y"]
    # a half turn keeps the energy and the product, and turns the plane round
    assert [own.mirror is not None for own in of.values()] == [True, False, True, False]
    assert of["x + y"].through.sentence == "x + y = 0 going up"


@pytest.mark.parametrize(
    ("of", "text"),
    [
        ("q", "section.of = 'q': is not a state of normal_form; known states: x, y."),
        ("x + q", "section.of: \"x + q\": unknown name 'q' at character 5; known names: x, y, mu, omega, cubic,"),
        ("x +", 'section.of: "x +"'),
        ("mu", "section.of = 'mu': names no state of normal_form, so nothing crosses its levels; known states: x, y."),
        ("2*mu - 1", "section.of = '2*mu - 1': names no state of normal_form"),
        ("x - x", "section.of = 'x - x': is the same at all states, so nothing crosses its levels."),
        ("cos(x)**2 + sin(x)**2", "section.of = 'cos(x)**2 + sin(x)**2': is the same at all states"),
        ("x + t", "section.of = 'x + t': depends on t; a section is a level of an expression of states"),
    ],
)
def test_sectioned__refused(of, text):
    with pytest.raises(ParameterError) as error:
        sectioned(flow(HOPF), Crossing(of))
    assert error.value.problems[0].startswith(text)


def test_sectioned__refused_where_the_motion_keeps_it():
    """The energy of an oscillator without damping; what is not kept at other parameters is not refused."""
    kept = model_of({"x": "v", "v": "-k*x"}, {"k": 2.0}, quantities={"energy": "v**2/2 + k*x**2/2"})
    with pytest.raises(ParameterError, match="'energy': does not change along the motion"):
        sectioned(kept, Crossing("energy", 1.0))
    damped = model_of({"x": "v", "v": "-x - c*v"}, {"c": 0.0})
    assert sectioned(damped, Crossing("v**2 + x**2")).crossing.of == "v**2 + x**2"


def test_sectioned__refused_where_an_angle_goes_on():
    pendulum = read_model(table("turner", {"th": "w", "w": "-sin(th)"}, states={"th": {"on_circle": True}}))
    with pytest.raises(ParameterError, match="'th - 1': changes by a full turn of the angle th"):
        sectioned(pendulum, Crossing("th - 1"))
    assert sectioned(pendulum, Crossing("w - cos(th)")).crossing.of == "w - cos(th)"
