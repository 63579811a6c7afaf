"""The implicit method: its coefficients, its steps beside a step in numpy, its tangents, bits and refusals."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core import load_model, run_branches
from magpend_core.engine import rosenbrock
from magpend_core.engine.rosenbrock import implicit_bindings
from magpend_core.engine.tableau import METHODS
from magpend_core.engine.variational import with_parameter_tangent, with_tangents
from magpend_core.sampling import Drive, sample
from tests.core.flows import lorenz96, model_of

RODAS = METHODS["rodas5p"]
STEP = 0.2
RINGS = 9
# each rate couples two neighbours, is nonlinear and driven; these have more states than are written out
MANY = {f"x{i}": f"sin(x{(i + 1) % RINGS})*exp(-x{i}) - 3*x{i}*x{(i - 2) % RINGS} + drive*x{i}" for i in range(RINGS)}
FEW = {"x": "v*exp(z)", "v": "mu*(1 - x**2)*v - x + drive*z", "z": "-40*(z - x*v) + drive**2"}
MU = {"mu": 2.0}
ONE = {"y": "-50*(y - drive) + 0.1*y**2"}
BOTH = pytest.mark.parametrize(("equations", "parameters"), [(FEW, MU), (MANY, {})])


def driven(equations, parameters=None):
    """A model whose drive is a cosine, and its system with the method for stiff systems."""
    model = model_of(equations, parameters, define={"drive": "cos(2*pi*f*t)"})
    return model, dataclasses.replace(model.system, method="rodas5p")


def rates(equations, parameters=None, f=1.0 / STEP):
    """The rates of such a model in numpy, for complex numbers."""
    code = [compile(text, "rates", "eval") for text in equations.values()]
    known = {"sin": np.sin, "exp": np.exp, **(parameters or {})}

    def function(t, y):
        values = {**known, "drive": np.cos(2.0 * np.pi * f * t), **dict(zip(equations, y, strict=True))}
        return np.array([eval(one, values) for one in code])

    return function


def jacobian(f, t, y):
    """Derivatives by the states, by complex steps."""
    return np.array([f(t, y + 1e-30j * e).imag / 1e-30 for e in np.eye(len(y))]).T


def step_in_numpy(f, y, h, t=0.0):
    """One step of the method, with numpy's linear algebra. Return the slopes and the new state."""
    n, implicit = len(y), RODAS.implicit
    by_time = f(t + 1e-30j, y).imag / 1e-30
    matrix = np.eye(n) / (h * implicit.gamma) - jacobian(f, t, y)
    k = np.zeros((RODAS.n_stages, n))
    for s in range(1, RODAS.n_stages - 1):
        state = y + h * RODAS.stages[s] @ k[:-1]
        right = f(t + RODAS.nodes[s] * h, state) + implicit.couplings[s] @ k + h * implicit.shifts[s] * by_time
        k[s] = np.linalg.solve(matrix, right) / h
    return k, y + h * RODAS.stages[-1] @ k[:-1]


def derivative(function, y, h=0.01):
    """Derivatives of a function by central differences of order eight, one row per state."""
    weights = {1: 672.0, 2: -168.0, 3: 32.0, 4: -3.0}
    return np.array(
        [
            sum(w * (function(y + k * h * e) - function(y - k * h * e)) for k, w in weights.items()) / (840.0 * h)
            for e in np.eye(len(y))
        ]
    )


def run(system, packed, starts, period=STEP, tolerance=1e-8, **options):
    """Sections after one period."""
    starts = np.atleast_2d(np.asarray(starts, float))
    n = len(starts)
    options = {"n_transient": 0, "n_keep": 1, "rtol": tolerance, "atol": tolerance, "system": system, **options}
    return run_branches(np.tile(packed, (n, 1, 1)), np.full((n, 1), 1.0 / period), starts, **options)


def one_step(system, packed, state):
    """The state after one step of the engine, as long as the drive's period."""
    found = run(system, packed, state, tolerance=0.9, step_size=np.array([2.0 * STEP]))
    assert found.n_steps[0, 0] == 1
    return found.section[0, 0, 0]


def some_state(equations):
    return np.random.default_rng(2).uniform(0.1, 1.0, len(equations))


def orders(errors):
    errors = np.array(errors)
    return np.log2(errors[:-1] / errors[1:])


def test_coefficients__give_order_5_and_damp_what_is_stiff():
    f, start, end = rates(FEW, MU), np.array([1.0, 0.5, 0.3]), 0.5
    exact = solve_ivp(f, (0.0, end), start, "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    errors = []
    for n in (80, 160, 320):
        y = start
        for i in range(n):
            _, y = step_in_numpy(f, y, end / n, i * end / n)
        errors.append(np.abs(y - exact).max())
    assert orders(errors)[-1] > 4.8
    _, limit = step_in_numpy(lambda t, y: -1e9 * y + 0.0 * t, np.array([1.0]), 1.0)
    assert abs(limit[0]) < 1e-6


def test_continuous_extension__has_order_4_and_ends_at_the_step():
    f, start, x = rates(FEW, MU), np.array([1.0, 0.5, 0.3]), np.array([0.2, 0.5, 0.8, 1.0])
    errors = []
    for h in (0.004, 0.002):
        k, end = step_in_numpy(f, start, h)
        own = solve_ivp(f, (0.0, h), start, "DOP853", rtol=1e-13, atol=1e-15, dense_output=True).sol
        inside = start + h * (x[:, None] ** np.arange(1.0, 5.0) @ RODAS.dense.T) @ k
        np.testing.assert_allclose(inside[-1], end, atol=1e-14)
        errors.append(np.abs(inside[:3] - own(h * x[:3]).T).max())
    assert orders(errors)[0] > 4.7  # of the error of one step


@pytest.mark.parametrize(("equations", "parameters"), [(ONE, {}), (FEW, MU), (MANY, {})])
def test_step__is_that_of_numpy(equations, parameters):
    model, system = driven(equations, parameters)
    state = some_state(equations)
    _, end = step_in_numpy(rates(equations, parameters), state, STEP)
    np.testing.assert_allclose(one_step(system, model.load().pack(), state), end, rtol=1e-13)


def test_step__exchanges_rows_lane_by_lane():
    """The first pivot vanishes in the middle lane alone; elsewhere either row is the larger one."""
    model = model_of({"x": "a*x + 90*y + z", "y": "-90*x - y*z", "z": "120*x + z - y**2"}, {"a": 0.0})
    system = dataclasses.replace(model.system, method="rodas5p")
    pivot = 1.0 / (STEP * RODAS.implicit.gamma)
    values, state = pivot * np.array([0.2, 1.0, 3.0]), np.array([3e-3, -2e-3, 5e-3])
    packed = np.array([model.load(a=a).pack() for a in values])[:, None]
    found = run_branches(
        packed,
        np.full((3, 1), 1.0 / STEP),
        np.tile(state, (3, 1)),
        **{"n_transient": 0, "n_keep": 1, "rtol": 0.9, "atol": 0.9, "step_size": np.full(3, 2.0 * STEP)},
        system=system,
    )
    assert (found.n_steps == 1).all()
    for a, end in zip(values, found.section[:, 0, 0], strict=True):
        f = rates({"x": f"{float(a)!r}*x + 90*y + z", "y": "-90*x - y*z", "z": "120*x + z - y**2"})
        np.testing.assert_allclose(end, step_in_numpy(f, state, STEP)[1], rtol=1e-12)


def test_step__of_a_narrow_jacobian_leaves_nothing_out():
    table = lorenz96(40)
    texts = dict(zip([f"x{i}" for i in np.random.default_rng(0).permutation(40)], ("",) * 40, strict=True))
    texts = {name: table["equations"][name].replace("F", "8.0") for name in texts}  # in an order that hides the band
    model = model_of(texts)
    system = dataclasses.replace(model.system, method="rodas5p")
    assert implicit_bindings(system)["BELOW"] < 10
    state = some_state(texts)
    _, end = step_in_numpy(rates(texts), state, STEP)
    np.testing.assert_allclose(one_step(system, model.load().pack(), state), end, rtol=1e-12)


@pytest.mark.parametrize(
    ("equations", "parameters", "written_out"), [(FEW, MU, True), (FEW, MU, False), (MANY, {}, False)]
)
def test_tangents__are_derivatives_of_the_step(equations, parameters, written_out):
    model, system = driven(equations, parameters)
    f, state, n = rates(equations, parameters), some_state(equations), len(equations)
    # the trace's integral is one more state in numpy
    packed = model.load().pack()

    def with_trace(t, y):
        inner = y[:n]
        trace = sum(f(t, inner + 1e-3 * e)[i] - f(t, inner - 1e-3 * e)[i] for i, e in enumerate(np.eye(n))) / 2e-3
        return np.append(f(t, inner), trace)

    extended = with_tangents(system, 2, divergence=True, written_out=written_out)
    found = one_step(extended, packed, np.concatenate([state, np.eye(n)[:2].ravel(), [0.0]]))
    np.testing.assert_array_equal(found[:n], one_step(system, packed, state))
    slopes = derivative(lambda y: step_in_numpy(f, y, STEP)[1], state)[:2]
    np.testing.assert_allclose(found[n:-1].reshape(2, n), slopes, rtol=1e-7, atol=1e-9)
    _, end = step_in_numpy(with_trace, np.append(state, 0.0), STEP)
    assert found[-1] == pytest.approx(end[-1], rel=1e-4)


def test_tangents__keep_the_volume_by_liouvilles_formula():
    model, system = driven(FEW, MU)
    start = np.concatenate([[1.0, 0.5, 0.3], np.eye(3).ravel(), [0.0]])
    errors = []
    for tolerance in (1e-6, 1e-9):
        extended = with_tangents(system, 3, divergence=True)
        end = run(extended, model.load().pack(), start, 0.3, tolerance).section[0, 0, 0]
        errors.append(abs(np.log(np.linalg.det(end[3:12].reshape(3, 3))) - end[12]))
    assert errors[1] < 1e-6
    assert errors[1] < 0.1 * errors[0]


def test_parameter_tangent__is_the_derivative_by_a_parameter():
    model, system = driven(FEW, MU)
    packed, state, h = model.load().pack(), np.array([1.0, 0.5, 0.3]), 1e-6
    sets = np.concatenate([packed, packed + h, packed - h, [0.5 / h]])
    end = run(with_parameter_tangent(system), sets, [*state, 0.0, 0.0, 0.0], 1.0, 1e-10).section[0, 0, 0]

    def ends(mu):
        f = rates(FEW, {"mu": mu}, 1.0)
        return solve_ivp(f, (0.0, 1.0), state, "Radau", rtol=1e-12, atol=1e-13).y[:, -1]

    np.testing.assert_allclose(end[3:], (ends(2.001) - ends(1.999)) / 2e-3, rtol=1e-5)


def test_run_branches__has_the_same_bits_alone_and_among_others():
    model, system = driven(FEW, MU)
    rng = np.random.default_rng(7)
    starts, packed = rng.uniform(-1.0, 1.0, (37, 3)), model.load().pack()
    together = run(system, packed, starts, 1.0, n_keep=3)
    for lanes in (1, 5, 64):
        other = run(system, packed, starts[::-1], 1.0, n_keep=3, n_lanes=lanes)
        assert other.section[::-1].tobytes() == together.section.tobytes()
        assert other.n_steps[::-1].tobytes() == together.n_steps.tobytes()
    alone = run(system, packed, starts[20], 1.0, n_keep=3)
    assert alone.section.tobytes() == together.section[20:21].tobytes()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["impact", "belt-stick", "belt", "pendulum", "flutter", "double-pendulum"])
def test_run_branches__agrees_with_an_explicit_method_on_jumps_layers_and_edges(name):
    model = load_model(name)
    starts = np.random.default_rng(1).uniform(-0.3, 0.3, (4, model.system.n_states)) * model.system.units
    packed = model.load().pack()
    explicit, implicit = (
        run(model.system, packed, starts, 1.0 / 1.3, 1e-11, n_transient=2, method=method)
        for method in ("dopri5", "rodas5p")
    )
    assert (implicit.status == explicit.status).all()
    np.testing.assert_allclose(implicit.section, explicit.section, atol=3e-7)


def test_quantities_and_samples__come_from_the_methods_own_extension():
    model, system = driven(FEW, MU)
    packed, start = model.load().pack(), [1.0, 0.5, 0.3]
    found = run(system, packed, start, 1.0, 1e-9, quantities=["x", "z"])
    times = np.linspace(0.0, 1.0, 2001)
    own = solve_ivp(rates(FEW, MU, 1.0), (0.0, 1.0), start, "Radau", times, rtol=1e-11, atol=1e-12).y[[0, 2]]
    expected = np.array([own.min(axis=1), own.max(axis=1), np.trapezoid(own, times)]).T
    np.testing.assert_allclose(found.extremes[0, 0, 0], expected, atol=2e-5)
    drive = Drive(np.ones(1), values=np.zeros((1, 0)))
    sampled = sample(system, packed[None], np.array([start]), [times[::100]], drives=[drive], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(sampled.states[0].T[[0, 2]], own[:, ::100], atol=1e-7)


def test_integrate__names_what_cannot_be_differentiated():
    many = model_of(lorenz96(65)["equations"], {"F": 8.0})
    with pytest.raises(ValueError, match="65 states; rodas5p solves linear systems of at most 64; choose dopri5"):
        run(dataclasses.replace(many.system, method="rodas5p"), many.load().pack(), np.zeros(65))


def test_tangents__agree_with_variational_equations_of_another_integrator():
    equations = {"x": "v", "v": "mu*(1 - x**2)*v - x + 4*drive"}
    model, system = driven(equations, {"mu": 30.0})
    found = run(with_tangents(system, 2), model.load().pack(), [2.0, 0.0, 1.0, 0.0, 0.0, 1.0], 5.0, 1e-12)

    def extended(t, z):
        x, v, matrix = z[0], z[1], z[2:].reshape(2, 2)
        jacobian = np.array([[0.0, 1.0], [-60.0 * x * v - 1.0, 30.0 * (1.0 - x**2)]])
        change = 30.0 * (1.0 - x**2) * v - x + 4.0 * np.cos(0.4 * np.pi * t)
        return np.concatenate([[v, change], (jacobian @ matrix).ravel()])

    start = [2.0, 0.0, 1.0, 0.0, 0.0, 1.0]
    other = solve_ivp(extended, (0.0, 5.0), start, "Radau", rtol=1e-12, atol=1e-14).y[:, -1]
    monodromy = found.section[0, 0, 0, 2:].reshape(2, 2).T
    np.testing.assert_allclose(monodromy, other[2:].reshape(2, 2), atol=1e-8)
    assert np.abs(monodromy).max() > 1e-3


@BOTH
def test_loops__that_are_written_out_change_no_bit(equations, parameters, monkeypatch):
    model, system = driven(equations, parameters)
    starts = np.random.default_rng(5).uniform(0.1, 1.0, (5, len(equations)))
    written = run(system, model.load().pack(), starts, 1.0)
    monkeypatch.setattr(rosenbrock, "UNROLLED", 0)
    looped = run(dataclasses.replace(system, name="looped"), model.load().pack(), starts, 1.0)
    assert looped.section.tobytes() == written.section.tobytes()
    assert (written.n_steps > 5).all()
