"""Where a text has no value: the innermost part, why, and at which numbers."""

import numpy as np
import pytest

from magpend_core.models.text.domains import domain_faults, readable
from magpend_core.models.text.grammar import parse, parse_condition
from magpend_core.models.text.numeric import value_of
from tests.core.flows import model_of


def faults(rate, define=None, **values):
    model = model_of({"x": "v", "v": rate}, {"k": 1.0, "g": 2.0, "z": 0.0}, define=define or {})
    given = {"x": 0.0, "v": 0.0, "k": 1.0, "g": 2.0, "z": 0.0, "t": 0.0, "f": 1.0, "phase": 0.0, **values}
    n = max(np.size(v) for v in given.values())
    columns = {name: np.broadcast_to(np.asarray(v, float), n) for name, v in given.items()}
    return domain_faults(model.definition, columns)


@pytest.mark.parametrize(
    ("rate", "part", "why"),
    [
        ("k + 1/x", "1/x", "division by 0"),
        ("log(x)", "log(x)", "logarithm of 0"),
        ("ln(log10(x))", "log10(x)", "logarithm of 0"),
        ("mod(k, x)", "mod(k, x)", "remainder of a division by 0"),
        ("sin(log(x - 1))", "log(x - 1)", "logarithm of -1"),
        ("sqrt(x - g)", "sqrt(x - g)", "square root of -2"),
        ("asin(g)", "asin(g)", "asin of 2, which is not between -1 and 1"),
        ("(x - 1)**0.5", "(x - 1)**0.5", "-1 to the power 0.5, which is no whole number"),
        ("x**(-2)", "x**(-2)", "0 to the power -2"),
        ("exp(1000*k)", "exp(1000*k)", "too large a number"),
        ("k*(g/(x + v))", "g/(x + v)", "division by 0"),
    ],
)
def test_domain_faults__names_the_innermost_part(rate, part, why):
    (fault,) = faults(rate)
    assert fault.place == "equations.v"
    assert fault.why == why
    assert fault.part == part


@pytest.mark.parametrize(
    ("rate", "part", "why"),
    [
        ("x + 1/0", "1/0", "division by 0"),
        ("x + v/z", "v/z", "division by 0"),
        ("where(x < 100, v, v/z)", "v/z", "division by 0"),
        ("where(x < 1, v, (-1)**0.5)", "(-1)**0.5", "-1 to the power 0.5, which is no whole number"),
        ("where(x < 1, v, 10**400)", "10**400", "too large a number"),
        ("where(k > 5, 1/0, v)", "1/0", "division by 0"),
        ("where(k < 5, 1/z, v)", "1/z", "division by 0"),
    ],
)
def test_domain_faults__constant_parts_count_in_every_branch(rate, part, why):
    """A branch that is not taken at the start is computed all the same; a guard without a state is one."""
    (fault,) = faults(rate, x=[0.5, 0.6])
    assert (fault.place, fault.part, fault.why, fault.is_constant) == ("equations.v", part, why, True)
    assert fault.values == ({"z": 0.0} if "z" in part else {})


def test_domain_faults__impacts_and_quantities():
    impacts = [{"of": "x - log(d)", "direction": "up", "set": {"v": "-v*g"}}]
    more = {"define": {"g": "1/d"}, "quantities": {"q": "x*sqrt(-1)"}, "impacts": impacts}
    model = model_of({"x": "v", "v": "-x"}, {"d": 0.0}, **more)
    zeros = dict.fromkeys(("x", "v", "d", "t", "f", "phase"), np.zeros(1))
    found = domain_faults(model.definition, zeros)
    assert [(f.place, f.part) for f in found] == [
        ("define.g", "1/d"),
        ("impacts[0].of", "log(d)"),
        ("quantities.q", "sqrt(-1)"),
    ]
    (fault,) = faults("r*k + r", {"r": "1/x", "unused": "log(-1)"}, x=[1.0, 0.0, 0.0])
    assert fault.place == "define.r"
    assert (fault.row, fault.count, fault.values) == (1, 2, {"x": 0.0})


@pytest.mark.parametrize(
    "rate",
    [
        *("k + x", "where(x > 0, 1/x, 0)", "where(x > 0, log(x), -x)", "atan2(v, x)"),
        # behind a guard without a state
        *("where(z > 0, v/z, v)", "where(z > 0, log(z), 1)*v", "where(not z < 1, 1/z, x)"),
    ],
)
def test_domain_faults__none_where_every_part_that_counts_has_a_value(rate):
    assert faults(rate, x=[0.0, -1.0, 2.0]) == []


def test_domain_faults__of_branches_and_of_several_parts():
    (fault,) = faults("where(x > 0, 1/(x - 1), 0)", x=[-1.0, 0.0, 1.0, 2.0])
    assert (fault.row, fault.count) == (2, 1)
    (fault,) = faults("1/x + where(x > 0, log(x), 0)")
    assert fault.why == "division by 0"
    found = faults("1/x + log(v - 1)")
    assert [f.why for f in found] == ["division by 0", "logarithm of -1"]


@pytest.mark.parametrize(
    "text",
    [
        "a + b - c",
        "a - (b - c)",
        "a*(b + c)/d",
        "a/(b*c)",
        "-a*b",
        "(-x)**2",
        "2**(-x)",
        "where(x > 0 and not (y <= 1 or x < 2), -x, 1/y)",
        "(a + b)**(c*d)",
        "min(a, b + 1)*3",
        "0.001*log(x)/v",
        "a - (-b*c)",
        "a*(-b)*c",
        "(-a*b)**2",
        "-(a + b)*c",
        "(a < b) and (b < c)",
    ],
)
def test_readable__means_the_same(text):
    numbers = {"a": 1.3, "b": -0.7, "c": 2.1, "d": 0.4, "x": 0.9, "y": -1.7, "v": 3.0}
    tree = parse_condition(text) if " and " in text and "where" not in text else parse(text)
    again = parse_condition(readable(tree)) if tree.is_condition else parse(readable(tree))
    assert value_of(again, numbers) == value_of(tree, numbers)
    assert len(readable(tree)) <= len(text) + 2
