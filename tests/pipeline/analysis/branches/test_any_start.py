"""Branches from a given state, and all equilibria of a box: closed forms, numpy's roots and published values."""

import mpmath
import numpy as np
import pytest
from scipy.optimize import brentq

import magpend
from magpend_core.models.text.intervals import Rates
from pipeline.analysis.branches.boxes import Box, BoxSettings, enclose_equilibria, krawczyk, search_equilibria
from pipeline.analysis.branches.completeness import counted_lines
from pipeline.specification.problems import SpecError
from tests.core.flows import model_of

pytestmark = pytest.mark.usefixtures("long_steps_of_a_file")


def box_of(**ranges):
    ends = np.array(list(ranges.values()), float)
    return Box(ends[:, 0], ends[:, 1], np.zeros(len(ends), bool))


def enclosed(equations, box, **parameters):
    model = model_of(equations, parameters)
    return enclose_equilibria(Rates(model.definition, parameters), box)


def states(found):
    return found.states[np.lexsort(found.states.T.round(9)[::-1])]


FUNCTIONS = (
    *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "sqrt"),
    *("square", "cube", "inverse", "power", "product", "minimum"),
)
TEXTS = {
    "square": "x**2 - 3*x",
    "cube": "x**3*0.1",
    "inverse": "1/(x - 0.3)",
    "power": "(2 + x*x)**1.3",
    "product": "x*(0.7 - x)*pi",
    "minimum": "min(x, 0.4) + abs(x)",
}
BY_MPMATH = {
    "square": lambda x: x**2 - 3 * x,
    "cube": lambda x: x**3 * mpmath.mpf(0.1),
    "inverse": lambda x: 1 / (x - mpmath.mpf(0.3)),
    "power": lambda x: (2 + x * x) ** mpmath.mpf(1.3),
    "product": lambda x: x * (mpmath.mpf(0.7) - x) * mpmath.mpf(np.pi),
    "minimum": lambda x: min(x, mpmath.mpf(0.4)) + abs(x),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_intervals__contain_values_of_fifty_digits(name):
    """Rates and slopes at points of random intervals, the narrow ones of a few units in the last place."""
    exact = BY_MPMATH.get(name) or getattr(mpmath, name)
    rates = Rates(model_of({"x": TEXTS.get(name, f"{name}(x)")}).definition, {})
    random, (least, greatest) = np.random.default_rng(0), (-6.0, 6.0)
    if name in ("asin", "acos"):
        least, greatest = -0.99, 0.99
    if name in ("log", "sqrt"):
        least, greatest = 1e-3, 6.0
    low = random.uniform(least, greatest, 300)
    high = np.minimum(low + 10.0 ** random.uniform(-16.0, 0.5, 300), greatest)
    first, last = (end[:, 0] for end in rates.rates(low[:, None], high[:, None]))
    slopes = [end[:, 0, 0] for end in rates.jacobian(low[:, None], high[:, None])]
    with mpmath.workdps(50):
        for k in range(len(low)):
            for share in (0.0, 0.37, 1.0):
                x = mpmath.mpf(low[k]) + mpmath.mpf(share) * (mpmath.mpf(high[k]) - mpmath.mpf(low[k]))
                assert first[k] <= exact(x) <= last[k], (name, low[k], high[k])
                if name != "minimum" and k % 10 == 0 and abs(x - mpmath.mpf(0.3)) > 1e-6:
                    assert slopes[0][k] <= mpmath.diff(exact, x) <= slopes[1][k], (name, low[k], high[k])
    narrow = (high - low < 1e-14) & np.isfinite(last)
    assert ((last - first)[narrow] < 1e-9 * (1.0 + np.abs(last[narrow]) ** 2)).all()


def test_enclose__wells_and_roots_of_polynomials():
    """Two wells and the saddle between; 25 equilibria of two quintics, whose roots numpy finds."""
    found = enclosed({"x": "v", "v": "a*x - x**3 - d*v"}, box_of(x=(-3, 3), v=(-2, 2)), a=0.7, d=0.3)
    root = np.sqrt(0.7)
    assert found.is_proved
    np.testing.assert_allclose(states(found), [[-root, 0.0], [0.0, 0.0], [root, 0.0]], atol=1e-12)
    quintic = [1.0, 0.3, -5.0, -0.4, 3.5, 0.2]
    text = "((((1*{0} + 0.3)*{0} - 5)*{0} - 0.4)*{0} + 3.5)*{0} + 0.2"
    found = enclosed({"x": text.format("x"), "y": f"{text.format('y')} + 0.1*x"}, box_of(x=(-4, 4), y=(-4, 4)))
    known = sorted(
        (x.real, y.real)
        for x in np.roots(quintic)
        for y in np.roots([*quintic[:-1], quintic[-1] + 0.1 * x.real])
        if abs(x.imag) < 1e-9 and abs(y.imag) < 1e-9
    )
    assert len(known) == 25
    assert found.is_proved
    np.testing.assert_allclose(states(found), known, atol=1e-9)
    for low, high, (x, y) in zip(found.low, found.high, found.states, strict=True):
        assert ((high - low) < 1e-9).all()
        exact = min(known, key=lambda one: np.hypot(one[0] - x, one[1] - y))
        assert ((low - 1e-12 <= exact) & (exact <= high + 1e-12)).all()


def test_enclose__mueller_brown_takens_and_brusselator():
    """Three minima and two saddles (Mueller and Brown, Theor. Chim. Acta 53, 1979, 75); closed forms."""
    rows = [
        (-200, -1, 0, -10, 1, 0),
        (-100, -1, 0, -10, 0, 0.5),
        (-170, -6.5, 11, -6.5, -0.5, 1.5),
        (15, 0.7, 0.6, 0.7, -1, 1),
    ]
    part = "({0})*({1})*exp(({2})*(x-({5}))**2 + ({3})*(x-({5}))*(y-({6})) + ({4})*(y-({6}))**2)"
    terms = {"x": [], "y": []}
    for size, a, b, c, x, y in rows:
        by_x, by_y = f"2*({a})*(x-({x})) + ({b})*(y-({y}))", f"({b})*(x-({x})) + 2*({c})*(y-({y}))"
        terms["x"].append(part.format(-size, by_x, a, b, c, x, y))
        terms["y"].append(part.format(-size, by_y, a, b, c, x, y))
    found = enclosed({k: " + ".join(v) for k, v in terms.items()}, box_of(x=(-1.5, 1.2), y=(-0.2, 2.0)))
    known = [(-0.822, 0.624), (-0.558, 1.442), (-0.05, 0.467), (0.212, 0.293), (0.623, 0.028)]
    assert found.is_proved
    np.testing.assert_allclose(states(found), known, atol=6e-4)
    takens = {"x": "y", "y": "a + b*x + x**2 - x*y"}
    found = enclosed(takens, box_of(x=(-3, 3), y=(-3, 3)), a=-0.5, b=0.4)
    assert found.is_proved
    np.testing.assert_allclose(states(found)[:, 0], -0.2 + np.sqrt(0.54) * np.array([-1.0, 1.0]), atol=1e-12)
    brusselator = {"x": "a + x**2*y - (b + 1)*x", "y": "b*x - x**2*y"}
    found = enclosed(brusselator, box_of(x=(-50, 50), y=(-50, 50)), a=1.2, b=2.0)
    assert found.is_proved
    np.testing.assert_allclose(states(found), [[1.2, 2.0 / 1.2]], atol=1e-12)
    # at the fold two equilibria are one: undecided; none where the rates have no real value
    assert not enclosed(takens, box_of(x=(-3, 3), y=(-3, 3)), a=0.04, b=0.4).is_proved
    assert len(enclosed({"x": "log(x) - 0.5"}, box_of(x=(-3, 3))).states) == 1


def test_enclose__a_pair_in_a_needle_that_newton_misses():
    """x = 3 exp(-1e8 (x - .7)^2) holds at 0 and twice in a needle 1e-4 wide, where scipy finds it by its signs."""
    box, rate = box_of(x=(-5, 5)), lambda x: -x + 3.0 * np.exp(-1e8 * (x - 0.7) ** 2)
    model = model_of({"x": "-x + 3*exp(-1e8*(x - 0.7)**2)"})
    known = [0.0, *(brentq(rate, *ends, xtol=1e-15) for ends in ((0.699, 0.7), (0.7, 0.701)))]
    found = enclose_equilibria(Rates(model.definition, {}), box)
    assert found.is_proved
    np.testing.assert_allclose(states(found)[:, 0], known, atol=1e-12)
    assert len(search_equilibria(model.system, model.load().pack(), box, np.zeros((0, 1)))) < 3
    # of too few boxes the rest stays undecided, and boxes that are not divided far enough hold the pair together
    few, coarse = BoxSettings(most_boxes=20), BoxSettings(smallest=1e-3)
    for settings in (few, coarse):
        found = enclose_equilibria(Rates(model.definition, {}), box, settings)
        assert not found.is_proved
        assert len(found.states) < 3


def test_krawczyk__has_no_bounds_where_slopes_have_none():
    rates = Rates(model_of({"x": "sqrt(x) - 1"}).definition, {})
    low, high = krawczyk(rates, np.array([[0.0], [0.9]]), np.array([[3.0], [1.1]]))
    assert np.isinf([low[0, 0], high[0, 0]]).all()
    assert 0.9 < low[1, 0] < 1.0 < high[1, 0] < 1.1
    assert Rates(model_of({"x": "sign(x) - x"}).definition, {}).obstacle == "sign"


HOOP = "th' = v\nv' = sin(th)*(w**2*cos(th) - 1) - d*v"


@pytest.fixture(scope="module")
def hoop(tmp_path_factory):
    """A bead on a rotating hoop: th = 0 and pi, and beyond w = 1 also cos th = 1/w^2; its cells end below alone."""
    model = magpend.model(HOOP, states={"th": {"on_circle": True}, "v": "1"}, name="hoop", w=0.5, d=0.4)
    spec = magpend.Spec("sweep", model).with_parameters(frequency_hz=0.2).with_axis("w", 0.4, 0.6, 2)
    spec = spec.with_start_list(points=[(0.1, 0.0)])
    return magpend.run(spec, tmp_path_factory.mktemp("runs") / "hoop", workers=0)


@pytest.mark.slow
def test_branches__all_equilibria_of_a_hoop(hoop):
    ds = hoop.branches(low=0.5, high=2.0, all_equilibria=2, within={"v": (-3.0, 3.0)})
    assert ds["n_equilibria"].values.tolist() == [2, 4]
    assert ds["n_stable_equilibria"].values.tolist() == [1, 2]
    assert ds["equilibria_index_sum"].values.tolist() == [0, 0]
    text = "\n".join(counted_lines(ds))
    assert text.count("proved by interval arithmetic") == 2
    # the branch on top, on which no cell ends, is unstable throughout
    top = [i for i in range(ds.sizes["branch"]) if abs(abs(float(ds["section"][i, 0, 0, 0])) - np.pi) < 1e-9]
    assert len(top) == 1
    n = int(ds["n_points"][top[0]])
    assert (ds["n_unstable"].values[top[0], :n] == 1).all()
    np.testing.assert_allclose(ds["w"].values[top[0], [0, n - 1]], [0.5, 2.0])
    tilted = ds["section"].sel(state="th", phase=0).values
    arms = [i for i in range(len(tilted)) if 0.5 < np.nanmax(np.abs(tilted[i])) < 3.0]
    assert arms
    for i in arms:
        w = ds["w"].values[i]
        good = np.isfinite(w) & (np.abs(tilted[i]) > 1e-3)
        np.testing.assert_allclose(np.cos(tilted[i][good]), 1.0 / w[good] ** 2, atol=1e-8)


@pytest.mark.slow
def test_branches__start_at_an_unstable_state(hoop):
    plain = hoop.branches(low=0.5, high=0.9)
    ds = hoop.branches(low=0.5, high=0.9, start={"th": 3.0, "v": 0.1, "w": 0.7})
    assert ds.sizes["branch"] == plain.sizes["branch"] + 1
    assert (ds["n_unstable"].values[0, : int(ds["n_points"][0])] == 1).all()
    lost = hoop.branches(low=0.5, high=0.9, start={"th": np.pi / 2, "v": 1e6})
    assert lost.attrs["left_out"].startswith("start at w = 0.5: Newton's method found no equilibrium")


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"start": {"th": 0.1}}, "missing: v"),
        ({"start": {"th": 0.1, "v": 0.0, "u": 1.0}}, "unknown state 'u'"),
        ({"start": {"th": 0.1, "v": 0.0, "w": 7.0}}, "w = 7 is outside of 0.4 to 0.6"),
        ({"within": {"v": (-1.0, 1.0)}}, "give that, too"),
        ({"all_equilibria": 1}, "add v=LOW:HIGH"),
        ({"all_equilibria": 1, "within": {"v": (3.0, -3.0)}}, "is empty; give the lesser number first"),
        ({"all_equilibria": 1, "within": {"v": (-1.0, 1.0), "x": (0.0, 1.0)}}, "unknown state 'x'"),
    ],
)
@pytest.mark.slow
def test_branches__bad_starts_are_refused_before_anything_is_computed(hoop, options, told):
    with pytest.raises(SpecError, match=told):
        hoop.branches(**options)
