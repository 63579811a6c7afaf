"""Definitions with arguments, states with an index, and sums: each against the same text written out by hand."""

import numpy as np
import pytest

import magpend
from magpend_core import sections
from magpend_core.models import ModelError, load_model
from magpend_core.models.text import calls, read_model
from magpend_core.models.text.grammar import parse
from magpend_core.models.text.keys import read_key
from magpend_core.models.text.latex import equations_of
from magpend_core.models.text.lines import read_lines
from magpend_core.models.text.numeric import node_values, rates_of
from pipeline.specification.starts import starts_model
from tests.core.cells import scipy_end
from tests.core.flows import lorenz96, model_of, table

RING = {
    "name": "lorenz96",
    "states": {"x[0..4]": {}},
    "parameters": {"F": 8.0},
    "equations": {"x[i=0..4]": "(x[mod(i+1,5)] - x[mod(i-2,5)])*x[mod(i-1,5)] - x[i] + F"},
}


def problems_of(equations, define=None, **more):
    with pytest.raises(ModelError) as error:
        read_model(table("a", equations, {"k": 2.0}, define=define or {}, **more))
    return error.value.problems


def linear(model, x, v):
    """Rates and Jacobian of a model of x and v, as plain numbers."""
    derived, leaves = model.derived, {}
    given = {("state", 0): x, ("state", 1): v, ("parameter", 0): 2.0}
    for node in derived.graph.nodes:
        if (node.op, node.value) in given:
            leaves[node.number] = given[node.op, node.value]
    return np.array(node_values(derived.rates + derived.jacobian, leaves), float)


def test_elements__are_the_states_that_one_would_write():
    model = read_model(RING)
    by_hand = load_model(lorenz96(5))
    assert model.state_names == by_hand.state_names == ("x0", "x1", "x2", "x3", "x4")
    assert model.digest == by_hand.digest
    assert model.definition.table["equations"] == RING["equations"]


@pytest.mark.parametrize(
    ("short", "long"),
    [
        ({"define": {"g(u, v)": "u*v/(1 + v)"}, "v": "g(x, k) - g(v + 1, -x)"}, "x*k/(1+k) - (v+1)*(-x)/(1+(-x))"),
        ({"define": {"h(u)": "u**2 - k", "g(u)": "h(u)*x"}, "v": "g(h(v))"}, "((v**2-k)**2 - k)*x"),
        ({"define": {"g(v)": "v + x", "a": "g(3)"}, "v": "a*v"}, "(3 + x)*v"),
        ({"v": "sum(j=1..3, j*x**j) - v"}, "(1*x**1 + 2*x**2 + 3*x**3) - v"),
        ({"v": "sum(j=2..2, v*j)"}, "v*2"),
        ({"v": "v + sum(j=2..1, v*j)"}, "v + 0"),
        ({"v": "sum(i=1..2, sum(j=1..i, i*x + j))"}, "((1*x + 1) + ((2*x + 1) + (2*x + 2)))"),
        ({"define": {"c[i=1..3]": "k*i*x"}, "v": "sum(i=1..2, c[i+1])"}, "(k*2*x + k*3*x)"),
        ({"define": {"g(j)": "j + sum(j=1..2, j*x)"}, "v": "g(v)"}, "v + (1*x + 2*x)"),
        ({"define": {"only[2]": "x"}, "v": "only2 + only[1 + 1]"}, "x + x"),
    ],
)
def test_calls_and_sums__mean_what_they_stand_for(short, long):
    model = model_of({"x": "v", "v": short["v"]}, {"k": 2.0}, define=short.get("define", {}))
    plain = model_of({"x": "v", "v": long}, {"k": 2.0})
    for x, v in ((0.7, -0.2), (-1.3, 2.1)):
        np.testing.assert_allclose(linear(model, x, v), linear(plain, x, v), rtol=1e-14)


def test_lines__have_arguments_and_indices():
    lines = read_lines(
        """
        x[i=2..3]'' = k*(x[i-1] - 2*x[i] + x[i+1]) - c*x[i]' + push(i)
        x[1]'' = k*(x[2] - x[1])
        x[4]'' = 0
        z' = sum(j=1..4, x[j]) - z
        push(u) = (w[1] +
          w[u])*z
        w[1..3] = 0.5
        k = 2
        """,
        {"states": {"x": "m", "z": "s"}},
        {"c": 0.1},
    )
    assert lines.judged() == []
    assert lines.table["states"] == {"x[1..4]": "m", "z": "s", "x_dot[1..4]": "m/s"}
    model = load_model(lines.table)
    assert model.state_names == ("x1", "x2", "x3", "x4", "z", "x_dot1", "x_dot2", "x_dot3", "x_dot4")
    assert [s.unit for s in model.states][:6] == ["m", "m", "m", "m", "s", "m/s"]
    names = ("w1", "w2", "w3", "k", "c")
    by_hand = magpend.model(
        """
        x1'' = k*(x2 - x1)
        x2'' = k*(x1 - 2*x2 + x3) - c*x2' + (w1 + w2)*z
        x3'' = k*(x2 - 2*x3 + x4) - c*x3' + (w1 + w3)*z
        x4'' = 0
        z' = x1 + x2 + x3 + x4 - z
        """,
        **dict.fromkeys(names, 1.0),
    )
    y = dict(zip(model.state_names, np.linspace(-1.0, 1.3, 9), strict=True))
    same = {name: f"x{name[-1]}_dot" if "dot" in name else name for name in y}
    found, wanted = rates_at(model, y), rates_at(by_hand, {same[name]: value for name, value in y.items()})
    assert {same[name]: rate for name, rate in found.items()} == pytest.approx(wanted, rel=1e-14)


def rates_at(model, states):
    return {
        name: float(v)
        for name, v in rates_of(model.definition, {**dict.fromkeys(model.parameter_names, 1.0), **states}).items()
    }


@pytest.mark.slow
def test_elements__move_as_scipy_integrates_the_ring():
    model = read_model(
        {
            **RING,
            "parameters": {"F": 3.0},
            "equations": {"x[i=0..4]": RING["equations"]["x[i=0..4]"] + " + cos(2*pi*f*t + i)"},
        }
    )
    start = np.array([1.0, 0.2, -0.4, 0.7, 2.0])
    found = sections(model.load(), [0.5], start[None], n_transient=0, n_keep=1, rtol=1e-11, atol=1e-11).section[0, 0]

    def rates(t, y):
        return (np.roll(y, -1) - np.roll(y, 2)) * np.roll(y, 1) - y + 3.0 + np.cos(np.pi * t + np.arange(5))

    np.testing.assert_allclose(found, scipy_end(rates, start, 2.0), atol=1e-9)


@pytest.mark.parametrize(
    ("equations", "define", "words"),
    [
        ({"x": "g(x, k)"}, {"g(u)": "u"}, "g at character 1 has 2 arguments; it takes 1"),
        ({"x": "g(x)"}, {"g(u)": "g(u) + 1"}, "define.g: calls itself: g needs g"),
        ({"x": "g(x)"}, {"g(u)": "h(u)", "h(u)": "u*g(u)"}, "calls itself: g needs h needs g"),
        ({"x": "g(x)"}, {"g(u)": "a*u", "a": "g(2)"}, "define.a: goes round in a circle: a needs a"),
        ({"x": "-x"}, {"x(u)": "u"}, "define.x(u): is the name of a state already"),
        ({"x": "-x"}, {"sin(u)": "u"}, "define.sin(u): has a meaning of its own"),
        ({"x": "-x"}, {"g(u, u)": "u"}, 'the argument "u" is given twice'),
        ({"x": "-x"}, {"g(sin)": "u"}, 'the argument "sin" has a meaning of its own'),
        ({"x": "-x"}, {"g(u": "u"}, "define.g(u: must begin with a letter"),
        ({"x": "-x"}, {"g(u)": "u + w"}, "unknown name 'w' at character 5"),
        ({"x": "x(k - 1)"}, {}, "'x' at character 1 is a state and takes no arguments; for a product write x*(...)"),
        ({"x": "g*x"}, {"g(u)": "u"}, "'g' at character 1 is a function; write its arguments"),
        ({"x": "g(x < 1)"}, {"g(u)": "u"}, "a condition stands at character 5 where 'g' needs a number"),
        ({"x": "x[1]"}, {}, "x[...] at character 1 is x[1], which does not exist"),
        ({"x": "sum(j=1..3, x[j])"}, {}, "is x[1] at j = 1, which does not exist; give the ends"),
        (
            {"x": "x[k]"},
            {},
            "the index of x[...] at character 1 needs 'k'; it can have whole numbers and indices alone",
        ),
        ({"x": "x[1/2]"}, {}, "is 0.5; it must be a whole number"),
        ({"x": "sum(x)"}, {}, "sum at character 1 needs an index with its range: sum(j=1..20, x[j])"),
        ({"x": "sum(j=1, x)"}, {}, "sum at character 1 needs an index with its range"),
        ({"x": "sum(sin=1..2, x)"}, {}, "the index 'sin' at character 5 has a meaning of its own"),
        ({"x": "x[1"}, {}, "the [ at character 2 is not closed"),
        ({"x": "sum(j=1..k, x)"}, {}, "the range of the sum at character 1 needs 'k'"),
        ({"x": "j*sum(j=1..2, x)"}, {}, "unknown name 'j' at character 1"),
    ],
)
def test_calls_and_sums__say_what_is_wrong(equations, define, words):
    found = problems_of(equations, define)
    assert any(words in one for one in found), found


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("x[i=3..1]", "the range 3..1 is empty"),
        ("x[i]", "the index [i] must be one number or a range"),
        ("x[1..9999]", "has 9999 elements; 1024 are the most"),
        ("x[2..4]", "there is no such state"),
    ],
)
def test_keys__say_what_is_wrong(key, words):
    with pytest.raises(ModelError) as error:
        read_model({"name": "a", "states": {"x[1..3]": {}}, "equations": {"x1": "0", key: "0"}})
    found = error.value.problems
    assert any(words in one for one in found), found


def test_equations__are_given_once_for_each_element():
    with pytest.raises(ModelError) as error:
        read_model({"name": "a", "states": {"x[1..4]": {}}, "equations": {"x[1..3]": "0", "x[i=3..4]": "i"}})
    found = error.value.problems
    assert any("x3 has an equation already, x[1..3]" in one for one in found), found
    missing = read_lines("x[1]' = 0\nx[3]' = 0", {}).judged()
    assert any("line 1: there is no equation for x[2]" in one for one in missing), missing


def test_written_out__ends_for_texts_of_any_size():
    define = {"g0(u)": "u*u + u"} | {f"g{i}(u)": f"g{i - 1}(g{i - 1}(u)) + u" for i in range(1, 60)}
    found = problems_of({"x": "g59(x)"}, define)
    assert any("when calls and sums are written out; use define for parts" in one for one in found), found
    deep = {"g0(u)": "sin(u)"} | {f"g{i}(u)": f"sin(g{i - 1}(u))" for i in range(1, 190)}
    found = problems_of({"x": "g189(g189(x))"}, deep)
    assert any(f"nested more than {calls.MAX_WRITTEN} deep" in one for one in found), found
    found = problems_of({"x": "sum(i=1..1000, sum(j=1..1000, x*i*j))"})
    assert any("more than 400000 parts" in one for one in found), found


def test_equations_of__shows_calls_and_sums_as_they_are_written():
    model = magpend.model("""
        g(u, v) = u*v/(1 + h(v))
        h(v) = v**2
        x[i=1..3]'' = x[mod(i, 3)+1] - g(x[i]', k)
        m = sum(j=1..3, x[j]**2)/3
        z' = m - z
        k = 2.0
    """)
    assert equations_of(model.definition) == [
        r"m &= \frac{\sum_{j=1}^{3} x_{j}^{2}}{3}",
        r"h\left(v\right) &= v^{2}",
        r"g\left(u, v\right) &= \frac{u \, v}{1 + h\left(v\right)}",
        r"\frac{\mathrm{d}x_{i}}{\mathrm{d}t} &= \dot{x}_{i}, \quad i = 1, \dots, 3",
        r"\frac{\mathrm{d}z}{\mathrm{d}t} &= m - z",
        r"\frac{\mathrm{d}\dot{x}_{i}}{\mathrm{d}t} &= x_{\operatorname{mod}\left(i, 3\right) + 1} - "
        r"g\left(\dot{x}_{i}, k\right), \quad i = 1, \dots, 3",
    ]


def test_parse__reads_ranges_beside_numbers_with_a_point():
    assert parse("sum(j=1..2, 1.5*j)").kind == "total"
    assert parse("1.").value == 1.0
    assert list(read_key("x[ i = 1 .. 3 ]").elements) == [("x1", {"i": 1}), ("x2", {"i": 2}), ("x3", {"i": 3})]


def test_tables__take_ranges_of_parameters_quantities_impacts_and_signs():
    model = read_model(
        {
            "name": "a",
            "states": {"x[1..2]": {"unit": "m", "scale": 2.0}, "y": {}},
            "parameters": {"w[1..2]": [0.5, 0.7], "q[1..2]": {"value": [1, 2], "unit": "N"}, "p[1..2]": 3.0},
            "equations": {"x[i=1..2]": "-w[i]*x[i]**3 - p[i]*x[i] - q[i]*y", "y": "-y**3"},
            "quantities": {"e[i=1..2]": {"value": "x[i]**2", "unit": "m2"}, "s": "sum(j=1..2, e_(j))"},
            "define": {"e_(j)": "x[j]**2"},
            "impacts": [{"of": "x[1] - 1", "direction": "up", "set": {"x[i=1..2]": "-x[i]"}}],
            "mirror": {"signs": {"x[1..2]": -1, "y": -1}},
        }
    )
    assert dict(model.presets[0].values) == {"w1": 0.5, "w2": 0.7, "q1": 1.0, "q2": 2.0, "p1": 3.0, "p2": 3.0}
    assert [s.scale for s in model.states] == [2.0, 2.0, 1.0]
    assert [(q.name, q.unit) for q in model.quantities] == [("e1", "m2"), ("e2", "m2"), ("s", "1")]
    assert set(model.definition.impacts[0].set) == {"x1", "x2"}
    assert model.mirror.signs == (-1, -1, -1)


def test_starts__take_ranges_of_states():
    model = read_model(RING)
    random = starts_model("random", model).model_validate({"kind": "random", "n": 3, "x[0..3]": [-1.0, 1.0], "x4": 0.5})
    assert random.given == {**{f"x{k}": (-1.0, 1.0) for k in range(4)}, "x4": 0.5}
    below = starts_model("grid", model).model_validate({"kind": "grid", "states": {"x[0..4]": 0.25}})
    assert below.given == {f"x{k}": 0.25 for k in range(5)}
