"""Noisy trajectories: order of the method, closed forms, the same bits in any company."""

from __future__ import annotations

import hashlib
import math
import pickle
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from magpend_core import load_model
from magpend_core.disturbance import Disturbance
from magpend_core.engine.noise import with_strengths
from magpend_core.engine.passage import Region
from magpend_core.engine.plain_python import plain
from magpend_core.engine.random_numbers import key_words, normal_pair, tag_word
from magpend_core.models.noisy import NoisyModel, noisy
from magpend_core.models.parameters import ParameterError
from magpend_core.noisy import NoisySections, cell_words, first_passages, noisy_sections

SEED = 11


# equations, parameters and strengths of the noise; the well is that of tests/pipeline, so it compiles once
KINDS: dict[str, tuple[dict[str, str], dict[str, float], dict[str, Any]]] = {
    "ou": ({"x": "-a*x"}, {"a": 1.5}, {"x": 0.7}),
    "ito": ({"x": "m*x"}, {"m": 0.4, "s": 0.8}, {"x": "s*x"}),
    "stratonovich": ({"x": "m*x"}, {"m": 0.4, "s": 0.8}, {"x": "s*x"}),
    "well": ({"x": "a*x - x**3"}, {"a": 1.0}, {"x": 0.5}),
    # nothing but noise, on a plane and on a circle
    "free": ({"x": "0*x", "y": "0*y", "th": "0*th"}, {}, {"x": 0.5, "y": 0.5, "th": 0.8}),
    "shaken": ({"x": "v", "v": "-x - d*v"}, {"d": 0.3, "s": 0.8}, {"v": "s*x"}),
    "oscillator": ({"x": "v", "v": "cos(2*pi*f*t) - d*v - k*x"}, {"d": 0.2, "k": 2.0}, {"v": 0.1}),
}


@cache
def model(kind: str) -> NoisyModel:
    equations, parameters, strengths = KINDS[kind]
    states = {name: {"on_circle": True, "unit": "rad"} if name == "th" else {} for name in equations}
    table = {"name": "noisy", "states": states, "parameters": parameters, "equations": equations}
    interpretation = (kind,) if kind in ("ito", "stratonovich") else ()
    return noisy(load_model(table), Disturbance(tuple(strengths.items()), *interpretation))


def run(kind: str, n: int, steps: int, start: Any, **options: Any) -> NoisySections:
    """`n` cells with their own realizations, over one period of 1 s by default."""
    m = model(kind)
    parameters = np.tile(m.load().pack(), (n, 1))
    parameters[:, -1] = np.arange(n)
    hz = np.full(n, options.pop("hz", 1.0))
    states = np.tile(np.atleast_1d(np.asarray(start, float)), (n, 1))
    given = {"n_transient": 0, "n_keep": 1, "seed": SEED, **options}
    return noisy_sections(parameters, hz, states, system=m.system, noise=m.noise, steps_per_period=steps, **given)


def increments(kind: str, n: int, steps: int, start: float) -> tuple[np.ndarray, np.ndarray]:
    """W and H of every step and cell, by the same rule in numpy: shape (steps, n)."""
    m = model(kind)
    parameters = np.tile(m.load().pack(), (n, 1))
    parameters[:, -1] = np.arange(n)
    words = cell_words(parameters, np.ones(n), np.full((n, 1), start))
    h = 1.0 / steps
    count = np.arange(float(steps))[:, None]
    pair = plain(normal_pair)(count, words[:, 0], words[:, 1], tag_word(0, 0), key_words(SEED))
    return math.sqrt(h) * pair[0], math.sqrt(h / 12.0) * pair[1]


def ou_reference(n: int, steps: int, start: float) -> np.ndarray:
    """The best estimate of the exact end of each path from W and H: what is left out is of order h**2."""
    a, b = 1.5, 0.7
    w, rest = increments("ou", n, steps, start)
    h = 1.0 / steps
    # the kernel exp(-a (h - s)) projected on 1 and on 1/2 - s/h, whose integrals against dW are W and H
    mean = (1.0 - math.exp(-a * h)) / (a * h)
    first_moment = (1.0 / a - (1.0 - math.exp(-a * h)) / (a * a * h)) / h  # of s/h
    tilt = 12.0 * (0.5 * mean - first_moment)
    x = np.full(n, start)
    for k in range(steps):
        x = math.exp(-a * h) * x + b * (mean * w[k] + tilt * rest[k])
    return x


def gbm_reference(kind: str, n: int, steps: int, start: float) -> np.ndarray:
    w = increments(kind, n, steps, start)[0].sum(axis=0)
    drift = 0.4 - (0.5 * 0.8**2 if kind == "ito" else 0.0)
    return start * np.exp(drift + 0.8 * w)


def slope_of(errors: list[float]) -> float:
    """Order of convergence from errors at steps that are halved each time."""
    return float(-np.polyfit(np.arange(len(errors)), np.log2(errors), 1)[0])


def errors_of(kind: str, reference: Callable[[int, int], np.ndarray], steps: tuple[int, ...], n: int) -> tuple:
    strong, weak = [], []
    for k in steps:
        exact = reference(n, k)
        found = run(kind, n, k, 1.0, checks_step=False).section[:, 0, 0]
        strong.append(float(np.abs(found - exact).mean()))
        weak.append(float(abs((found**2 - exact**2).mean())))
    return strong, weak


@pytest.mark.slow
def test_noisy_sections__additive_noise_has_strong_order_three_halves() -> None:
    strong, weak = errors_of("ou", lambda n, k: ou_reference(n, k, 1.0), (4, 8, 16, 32), 4000)
    assert slope_of(strong) > 1.4
    assert slope_of(weak) > 1.8
    assert strong[-1] < 2e-4  # of a standard deviation of .4


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ito", "stratonovich"])
def test_noisy_sections__multiplicative_noise_has_strong_order_one(kind: str) -> None:
    strong, weak = errors_of(kind, lambda n, k: gbm_reference(kind, n, k, 1.0), (16, 32, 64, 128), 4000)
    assert 0.85 < slope_of(strong) < 1.3
    assert slope_of(weak) > 0.8
    assert strong[-1] < 0.02  # the two interpretations differ by a factor exp(0.32)


def test_noisy_sections__halved_steps_follow_the_same_path() -> None:
    # an independent path would differ by the noise itself; the order is that of the step
    errors = [float(np.median(run("ou", 2000, k, 1.0).strong_error)) for k in (4, 8, 16, 32)]
    assert slope_of(errors) > 1.4
    strong = float(np.abs(run("ou", 2000, 8, 1.0).section[:, 0, 0] - ou_reference(2000, 8, 1.0)).mean())
    halved = float(run("ou", 2000, 8, 1.0).strong_error.mean())
    assert strong / 2 < halved < 2 * strong
    errors = [float(np.median(run("well", 2000, k, 0.5).strong_error)) for k in (4, 8, 16, 32)]
    assert slope_of(errors) > 1.4


@pytest.mark.slow
def test_noisy_sections__strength_of_a_state_without_noise() -> None:
    # dv = (-x - d v) dt + s x dW, dx = v dt: Ito and Stratonovich agree, and the order is that of additive noise
    errors = [float(np.median(run("shaken", 2000, k, [1.0, 0.0]).strong_error)) for k in (4, 8, 16, 32)]
    assert slope_of(errors) > 1.4
    found = run("shaken", 40_000, 64, [1.0, 0.0], checks_step=False).section[:, 0]
    # the second moments (xx, xv, vv) follow a linear equation of their own
    d, s = 0.3, 0.8
    rates = np.array([[0.0, 2.0, 0.0], [-1.0, -d, 1.0], [s * s, -2.0, -2.0 * d]])
    exact = expm(rates) @ [1.0, 0.0, 0.0]
    products = np.stack([found[:, 0] ** 2, found[:, 0] * found[:, 1], found[:, 1] ** 2])
    error = products.std(axis=1) / math.sqrt(len(found))
    assert (np.abs(products.mean(axis=1) - exact) < 4 * error).all()


@pytest.mark.slow
def test_noisy_sections__oscillator_has_the_closed_covariance() -> None:
    # x'' + .2 x' + 2 x = cos t + .1 xi: Lyapunov's equation gives var x = .01/(2 .2 2), var v = .01/(2 .2), cov 0
    found = run("oscillator", 20_000, 64, [0.96, 0.19], hz=1 / (2 * math.pi), n_transient=12, checks_step=False)
    x, v = found.section[:, 0].T
    mean = np.linalg.solve([[1.0, 0.2], [-0.2, 1.0]], [1.0, 0.0])  # of x at the section: Re 1/(1 + .2 i), and -Im
    n = len(x)
    for sample, variance in ((x, 0.0125), (v, 0.025)):
        assert abs(sample.var() - variance) < 4 * variance * math.sqrt(2 / n)
    assert abs(np.mean((x - x.mean()) * (v - v.mean()))) < 4 * math.sqrt(0.0125 * 0.025 / n)
    assert abs(x.mean() - mean[0]) < 4 * math.sqrt(0.0125 / n)
    assert abs(v.mean() - mean[1]) < 4 * math.sqrt(0.025 / n)


def test_noisy_sections__same_bits_in_any_company_and_when_they_go_on() -> None:
    options: dict[str, Any] = {"hz": 0.16, "n_transient": 1, "n_keep": 3}
    whole = run("oscillator", 75, 20, [0.1, 0.2], **options)
    for n_lanes in (1, 16, 33):
        again = run("oscillator", 75, 20, [0.1, 0.2], n_lanes=n_lanes, **options)
        np.testing.assert_array_equal(again.section, whole.section)
        np.testing.assert_array_equal(again.strong_error, whole.strong_error)
    fewer = run("oscillator", 7, 20, [0.1, 0.2], **options)
    np.testing.assert_array_equal(fewer.section, whole.section[:7])
    m = model("oscillator")
    parameters = np.tile(m.load().pack(), (40, 1))
    parameters[:, -1] = np.arange(40)
    steps = 5 + np.arange(40) % 7
    hz, states = 0.1 + 0.01 * (np.arange(40) % 5), np.zeros((40, 2))
    given: dict[str, Any] = {"system": m.system, "noise": m.noise, "seed": 1, "n_transient": 1, "n_keep": 2}
    together = noisy_sections(parameters, hz, states, steps_per_period=steps, **given)
    for i in (0, 13, 39):
        part = slice(i, i + 1)
        alone = noisy_sections(parameters[part], hz[part], states[part], steps_per_period=steps[part], **given)
        np.testing.assert_array_equal(alone.section[0], together.section[i])
    m = model("oscillator")
    parameters, hz, states = np.tile(m.load().pack(), (5, 1)), np.full(5, 0.2), np.zeros((5, 2))
    parameters[:, -1] = np.arange(5)
    given: dict[str, Any] = {"system": m.system, "noise": m.noise, "seed": 3, "steps_per_period": 16}
    whole = noisy_sections(parameters, hz, states, n_transient=2, n_keep=6, **given)
    first = noisy_sections(parameters, hz, states, n_transient=2, n_keep=2, **given)
    words = cell_words(parameters, hz, states)
    rest = noisy_sections(
        parameters, hz, first.section[:, -1], n_transient=0, n_keep=4, first_period=4, words=words, **given
    )
    np.testing.assert_array_equal(np.concatenate([first.section, rest.section], axis=1), whole.section)
    np.testing.assert_array_equal(rest.strong_error, whole.strong_error)


def test_noisy_sections__without_noise_follows_the_deterministic_flow() -> None:
    m = model("oscillator")
    cell = np.array([[0.2, 2.0, 0.0, 0.0]]), np.array([1 / (2 * math.pi)]), np.array([[0.1, 0.2]])
    given: dict[str, Any] = {"system": m.system, "noise": m.noise, "seed": 0, "n_transient": 0, "n_keep": 1}
    found = noisy_sections(*cell, steps_per_period=400, **given)
    # the linear equation's closed form: particular solution and decaying oscillation
    amplitude = 1.0 / complex(1.0, 0.2)
    a, b = amplitude.real, -amplitude.imag  # x = a cos t + b sin t
    root, t = math.sqrt(2.0 - 0.01), 2 * math.pi
    x0, v0 = 0.1 - a, 0.2 - b
    free = math.exp(-0.1 * t) * (x0 * math.cos(root * t) + (v0 + 0.1 * x0) / root * math.sin(root * t))
    assert found.section[0, 0, 0] == pytest.approx(a + free, abs=5e-6)  # order 3 with steps of .016


FREE = (np.inf,) * 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "start", "region", "exact"),
    [
        # dx = (x - x^3) dt + .5 dW from -1 to 0, by quadrature: Gardiner, Handbook of Stochastic Methods, eq. 5.5.19
        ("well", [-1.0], ([0.0], [-np.inf], [0.0], [0.0], np.inf), 18.4262),
        # a disc of radius .8 from its centre: R^2/(2 s^2)
        ("free", [0.0, 0.0, 0.0], ([0.0] * 3, [-np.inf] * 3, FREE, [1.0, 1.0, 0.0], 0.8), 1.28),
        # an arc from 2.5 to -2.7 across the cut, from 2.9: a b/s^2
        (
            "free",
            [0.0, 0.0, 2.9],
            ([0.0, 0.0, 2.5], [-np.inf, -np.inf, 0.0], [np.inf, np.inf, 1.0832], [0.0] * 3, np.inf),
            0.4 * 0.6832 / 0.64,
        ),
    ],
)
def test_first_passages__mean_time_has_an_error_of_the_order_of_the_step(
    kind: str, start: list[float], region: tuple[Any, ...], exact: float
) -> None:
    m, n, h = model(kind), 100_000, 0.05
    parameters, states = np.tile(m.load().pack(), (n, 1)), np.tile(start, (n, 1))
    parameters[:, -1] = np.arange(n)
    hz, of_cells = np.full(n, 0.5 / h), Region(*(np.tile(np.atleast_1d(part), (n, 1)) for part in region))
    assert of_cells.contains(states, m.is_angle).all()
    for halves in (False, True):
        found = first_passages(
            parameters, hz, states, of_cells, system=m.system, noise=m.noise, seed=SEED, steps_per_period=2,
            n_periods=10_000, first_period=0, words=cell_words(parameters, hz, states), halves=halves,
        )  # fmt: skip
        # a passage is noted at the end of its step
        times = (found.steps - (0.25 if halves else 0.5)) * h
        noise = times.std() / math.sqrt(n)
        # looked at the ends of the steps alone, the face would seem to be .58 s sqrt(h) = .07 farther: 8 % or more
        assert abs(times.mean() - exact) < 4 * noise + 0.005 * exact
        # some are back at the end of the step
        assert not of_cells.contains(found.place, m.is_angle).all()


@pytest.mark.parametrize(
    ("strengths", "words"),
    [
        ({"y": 1.0}, r"strengths\.y: is not a state"),
        ({"x": "v", "v": 0.1}, r"strengths\.x = 'v': depends on v"),
        ({"v": "k*v"}, "interpretation: missing"),
        ({"v": "cos(t)"}, r"strengths\.v.*depends on t"),
        ({"v": "k*unknown"}, r"strengths\.v"),
        ({"psi1_dot": "2*psi1"}, "not given as text"),
    ],
)
def test_noisy__problems_name_the_key(strengths: dict[str, Any], words: str) -> None:
    owner = load_model() if "psi1_dot" in strengths else model("oscillator").whole
    with pytest.raises(ParameterError, match=words):
        noisy(owner, Disturbance(tuple(strengths.items())))


def test_with_strengths__refuses_impacts() -> None:
    impacts = [{"of": "x", "direction": "down", "set": {"v": "-0.5*v"}}]
    ball = {"name": "ball", "states": {"x": {}, "v": {}}, "parameters": {}, "impacts": impacts}
    bouncing = load_model({**ball, "equations": {"x": "v", "v": "-1 + 0*t"}})
    with pytest.raises(ValueError, match="crosses a surface infinitely often"):
        with_strengths(bouncing.system, model("oscillator").noise)
    parameters = model("ito").load(s=0.3)
    assert pickle.loads(pickle.dumps(parameters)) == parameters


def digest() -> str:
    """Of some sections with multiplicative noise, which use every function of a step (see test_same_bits, test_jit)."""
    found = run("ito", 20, 16, 1.0, n_keep=3)
    return hashlib.sha256(found.section.tobytes() + found.strong_error.tobytes()).hexdigest()
