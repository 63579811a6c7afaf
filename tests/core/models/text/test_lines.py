"""A model from lines of equations is the model that the same TOML text gives."""

import json
import re

import pytest

from magpend_core.models import ModelError, load_model
from magpend_core.models.text.lines import is_equations, read_lines

TABLE = {
    "name": "oscillator",
    "states": {"x": "m", "x_dot": "m/s"},
    "parameters": {"d": 0.2, "A": {"value": 1, "unit": "m/s2"}},
    "define": {"drive": "A*cos(2*pi*f*t)"},
    "equations": {"x": "x_dot", "x_dot": "(-d*x_dot - x + drive)"},
}
LINES = """
# a comment
x'' = (-d*x' - x  # the line goes on
  + drive)
drive = A*cos(2*pi*f*t)
d = 0.2
"""


def problems(text, **values):
    return read_lines(text, {}, values).judged()


def test_read_lines__gives_the_table_of_the_same_model():
    keys = {"name": "oscillator", "states": {"x": "m"}}
    lines = read_lines(LINES, keys, {"A": {"value": 1, "unit": "m/s2"}})
    table = {**TABLE, "equations": {"x": "x_dot", "x_dot": "(-d*x_dot - x   + drive)".replace("   ", " ")}}
    assert lines.judged() == []
    assert lines.table == table
    assert load_model(lines.table).digest == load_model(TABLE).digest
    assert load_model(lines.table) is load_model(table)
    by_state = read_lines({"x": "v", "v": "-x"}, {})
    assert by_state.judged() == []
    assert by_state.table == read_lines("x' = v\nv' = -x", {}).table
    assert read_lines({"x''": "-x"}, {}).table == read_lines("x'' = -x", {}).table
    table = read_lines("a'' = -a + b\nb' = -b\nc''' = -c''", {"states": {"c": "rad"}}).table
    assert table["states"] == {"a": "1", "b": "1", "c": "rad", "a_dot": "1", "c_dot": "rad/s", "c_ddot": "rad/s2"}
    assert table["equations"]["c_ddot"] == "-c_ddot"


@pytest.mark.parametrize("equations", ["x'' = -d*x' - x", {"x''": "-d*x' - x"}], ids=["lines", "primed key"])
def test_load_model__reads_primes_in_a_table(equations):
    table = {"name": "m", "states": {"x": "m"}, "parameters": {"d": 0.2}, "equations": equations}
    plain = {"states": {"x": "m", "v": "m/s"}, "equations": {"x": "v", "v": "-d*v - x"}}
    model = load_model(table)
    assert [state.unit for state in model.states] == ["m", "m/s"]
    renamed = json.loads(json.dumps(plain).replace('"v"', '"x_dot"').replace("*v", "*x_dot"))
    assert model is load_model({**table, **renamed})
    with pytest.raises(ModelError, match=r"'dd' .*did you mean d"):
        load_model(json.loads(json.dumps(table).replace("-d*", "-dd*")))


@pytest.mark.parametrize(
    ("text", "values", "expected"),
    [
        ("x' = v\nv' = -gama*v + x", {}, r"line 2, equations.v: .*'gama' .*If gama is a parameter, .* gama=1.0"),
        ("x' = -x\n2*x", {}, r'line 2: "2\*x" is no equation; write NAME'),
        ("x' = -x\ndy/dt = 3", {}, r"line 2: .* write y' = \.\.\. for this rate"),
        ("x' = -x\n\nx' = x", {}, r"line 3: x has an equation already \(line 1\); remove one"),
        ("x = v\nv = -x", {}, r"there is no rate; write NAME' = "),
        ("x' = -y'", {}, r"line 1: y' on a right side: there is no equation y'' = "),
        ("x' = 2\ny' = x'", {}, r"line 2: x' on a right side: it is the rate .* rate = \.\.\., and use x' = rate"),
        ("x'' = -x\nx_dot = 3", {}, r"makes a state x_dot, and a line defines x_dot"),
        ("x' = -d*x\nd = 2", {"d": 3.0}, r"d = 3.0: has a value already; remove one"),
        ("x' = -x", {"titel": "me"}, r"titel = .*: the value of a parameter is a number; did you mean title"),
        ("x''''' = -x", {}, r"at most 4 primes"),
        ("x' = sinn(x)", {}, r"line 1, equations.x: .*unknown function 'sinn' .* did you mean sin"),
        ("sin' = -x", {}, r"line 1: sin has a meaning of its own"),
        (
            "f' = -f*cos(2*pi*t)",
            {},
            r"states.f: f belongs to the drive in equations with t; choose .* f_, or take it out",
        ),
        ("t' = 1", {}, r"states.t: has a meaning of its own"),
    ],
)
def test_read_lines__names_line_key_and_remedy(text, values, expected):
    found = problems(text, **values)
    assert any(re.search(expected, problem) for problem in found), found


def test_read_lines__reports_all_problems_at_once():
    found = problems("x' = v + gama\nv' -x\nz' = -z + delt", mu="big")
    assert len(found) == 4, found
    assert is_equations("x' = -x")
    assert is_equations("a = 2\n x ″ = -x")
    assert not is_equations("name = \"x'\"\n[states]\nx = 'm'")
    assert not is_equations("duffing")
