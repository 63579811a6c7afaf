"""Reading a model: what a text gives, what errors say, and that hostile texts end in one."""

import copy
import json
import pickle
import random
import re
import time
from typing import Any

import numpy as np
import pytest

from magpend_core.models import ModelError, load_model, model_names
from magpend_core.models.clock import DRIVEN, STROBED
from magpend_core.models.model import Mirror, State
from magpend_core.models.parameters import NON_NEGATIVE, POSITIVE
from magpend_core.models.presets import Preset
from magpend_core.models.text import read_model

DUFFING = {
    "name": "duffing5",
    "states": {"x": {"unit": "m"}, "v": {"unit": "m/s"}},
    "parameters": {"d": 0.08, "A": {"value": 0.2, "unit": "N", "meaning": "amplitude"}},
    "define": {"drive": "A*cos(2*pi*f*t)"},
    "equations": {"x": "v", "v": "drive - d*v - x**3"},
}

PENDULUM = {
    "name": "pendulum1",
    "title": "a pendulum",
    "source": "a textbook",
    "states": {
        "th": {"unit": "rad", "on_circle": True, "meaning": "angle", "symbol": r"\theta"},
        "w": {"unit": "rad/s", "scale": 3.0, "escape": 1e4},
    },
    "parameters": {"l": {"value": 2.0, "unit": "m", "bound": "positive"}, "d": 0.1, "A": 1.0},
    "define": {"g": "9.81", "ratio": "g/l"},
    "equations": {"th": "w", "w": "A*sin(2*pi*phase) - d*w - ratio*sin(th)"},
    "quantities": {
        "E": {"value": "0.5*w**2 - ratio*cos(th)", "unit": "1/s2", "meaning": "energy"},
        "push": "A*sin(2*pi*f*t)",
    },
    "drawing": {
        "points": {"bob": ["l*sin(th)", "-l*cos(th)"]},
        "fixed": {"pivot": ["0", 0]},
        "lines": [["pivot", "bob"]],
    },
    "mirror": {"signs": {"th": -1, "w": -1}, "half_period": True},
    "presets": {"strong": {"source": "a guess", "A": 3.0}},
    "classifier": {"meaning": "side", "words": {"left": "sin(th) < 0", "right": "sin(th) > 0"}},
}


def changed(table, *path, value):
    """A copy of a text with one entry set."""
    made = copy.deepcopy(table)
    inner = made
    for key in path[:-1]:
        inner = inner.setdefault(key, {})
    inner[path[-1]] = value
    return made


def problems_of(table):
    with pytest.raises(ModelError) as error:
        read_model(table)
    return error.value.problems


def test_read_model__fills_in_what_a_short_text_leaves_out():
    model = read_model(DUFFING)
    assert model.states == (State("x", "m", "x", escape=1e9, rate="v"), State("v", "m/s", "v", r"\dot{x}", escape=1e9))
    assert [(p.name, p.unit, p.meaning) for p in model.parameters] == [("d", "1", "d"), ("A", "N", "amplitude")]
    assert dict(model.load()) == {"d": 0.08, "A": 0.2}
    assert model.preset_names == ("default",)
    assert model.preset().provenance["d"]
    assert model.clock is DRIVEN
    assert model.text == DUFFING == model.reference
    model = read_model(PENDULUM)
    assert (model.title, model.name) == ("a pendulum", "pendulum1")
    assert model.is_angle == (True, False)
    assert model.scales == (1.0, 3.0)
    assert model.states[1].escape == 1e4
    assert model.parameter("l").bound == POSITIVE
    assert model.mirror == Mirror((-1, -1), True)
    assert [(q.name, q.unit, q.meaning) for q in model.quantities] == [("E", "1/s2", "energy"), ("push", "1", "push")]
    assert model.load("strong")["A"] == 3.0
    assert model.load("strong")["d"] == 0.1
    assert model.preset("strong").provenance == {"l": "a textbook", "d": "a textbook", "A": "a guess"}
    assert model.portraits == (("th", "w"),)
    bound = changed(PENDULUM, "parameters", "d", value={"value": 0.0, "bound": "non-negative"})
    assert read_model(bound).parameter("d").bound == NON_NEGATIVE


def test_drawing__places_points_by_the_text():
    model = read_model(PENDULUM)
    states = np.array([[[0.3, 1.0], [2.0, -1.0]]])
    drawn = model.drawing.points(states, model.load())
    np.testing.assert_allclose(drawn["bob"][..., 0], 2.0 * np.sin(states[..., 0]))
    np.testing.assert_allclose(drawn["bob"][..., 1], -2.0 * np.cos(states[..., 0]))
    assert drawn["bob"].shape == (1, 2, 2)
    np.testing.assert_array_equal(model.drawing.fixed(model.load())["pivot"], [0.0, 0.0])
    assert model.drawing.lines == (("pivot", "bob"),)
    assert (model.drawing.trace, model.drawing.unit) == ("bob", "m")
    classifier = read_model(PENDULUM).classifier
    section = np.zeros((3, 4, 2))
    section[0, :, 0], section[1, :, 0], section[2, :, 0] = -0.5, [0.1, 3.0, 1.0, 2.0], [0.1, -0.1, 0.2, 0.3]
    codes = classifier.classify(section, np.zeros((3, 1)), np.ones(3), dict(read_model(PENDULUM).load()))
    assert classifier.words == ("unknown", "left", "right", "mixed")
    assert codes.dtype == np.int8
    assert [classifier.words[c] for c in codes] == ["left", "right", "mixed"]


@pytest.mark.parametrize(
    ("signs", "half_period", "wrong"),
    [({"th": -1, "w": -1}, False, "w"), ({"th": -1}, True, "th"), ({"w": -1}, True, "th"), ({}, True, "w")],
)
def test_mirror__must_be_one_of_the_equations(signs, half_period, wrong):
    table = changed(PENDULUM, "mirror", value={"signs": signs, "half_period": half_period})
    (problem,) = problems_of(table)
    assert f"model.mirror: the rate of {wrong} at a state" in problem
    # That of a square wave with a duty cycle of 0.4927, in the pendulum as text
    table = {**load_model("pendulum-text").definition.table, "name": "a"}
    names = ("psi1", "psi2", "psi1_dot", "psi2_dot")
    table["mirror"] = {"signs": dict.fromkeys(names, -1), "half_period": True}
    assert read_model(table).mirror == Mirror((-1, -1, -1, -1), True)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("equations", "v"), "drive - d*vv", "unknown name 'vv' at character 11; did you mean v?"),
        (("equations", "v"), "drive +", 'model.equations.v: "drive +": ends where something must follow.'),
        (("equations", "y"), "x", "model.equations.y: there is no such state"),
        (("equations",), {"x": "v"}, "model.equations.v: missing; give the rate of the state v."),
        (("states", "sin"), "m", "model.states.sin: has a meaning of its own in expressions"),
        (("states", "x y"), "m", "must begin with a letter"),
        (("states", "frequency"), "m", "names something else in runs"),
        (("states", "x"), {"unit": 3}, "model.states.x.unit: 3 must be a text in quotes."),
        (("states", "x"), {"unit": "\x1b[2J"}, r"model.states.x.unit: '\x1b[2J' has control characters; remove them."),
        (("title",), "\x1b[31mred", r"model.title: '\x1b[31mred' has control characters; remove them."),
        (("states", "x"), {"scale": 0.0}, "model.states.x.scale: 0.0 must be greater than 0."),
        (("states", "x"), {"angle": True}, "model.states.x.angle: is no key here; "),
        (("states", "x"), {"on_circle": "yes"}, 'model.states.x.on_circle: "yes" must be true or false.'),
        (("parameters", "x"), 1.0, "model.parameters.x: is the name of a state already"),
        (("parameters", "d"), {"unit": "s"}, "model.parameters.d: has no value"),
        (("parameters", "d"), "0.1", "d = '0.1' is not a number"),
        (("parameters", "d"), {"value": -1.0, "bound": "positive"}, "d = -1.0 is out of bounds"),
        (("parameters", "d"), {"value": 1.0, "bound": "above"}, "must be one of finite, positive"),
        (("define", "A"), "2", "model.define.A: is the name of a parameter already"),
        (("define", "a1"), "a1 + 1", "model.define.a1: goes round in a circle: a1 needs a1."),
        (("parameters",), {1: 2.0}, "model.parameters: the key 1 must be a text."),
        (("name",), "five wells", 'model.name: "five wells" must be a letter'),
        (("quantities", "x"), "v", "model.quantities.x: is the name of a state already"),
        (("quantities", "E"), {"unit": "J"}, "model.quantities.E"),
        (("impacts",), {"of": "x"}, "model.impacts: must be a list of tables"),
        (("impacts",), [{"of": "x - 1", "direction": "in", "set": {"v": "-v"}}], 'must be "up" or "down"'),
        (("impacts",), [{"of": "x - 1", "direction": "up", "set": {"w": "-v"}}], "model.impacts[0].set.w"),
        (("drawing",), {"points": {"a": ["x"]}, "trace": "a"}, "must be two expressions"),
        (("drawing",), {"points": {"a": ["x", "t"]}}, "needs 't', which is not known here"),
        (("drawing",), {"points": {"a": ["x", "0"]}, "fixed": {"b": ["x", "0"]}}, "point knows parameters"),
        (("drawing",), {"points": {"a": ["x", "0"]}, "lines": [["a", "c"]]}, '"c" is no point'),
        (("drawing",), {"points": {"a": ["x", "0"]}, "trace": "c"}, '"c" is no moving point'),
        (("mirror",), {"signs": {"x": 2}}, "model.mirror.signs.x: 2 must be 1 or -1."),
        (("mirror",), {"signs": {"w": -1}}, "model.mirror.signs.w: there is no such state"),
        (("presets",), {"a": {"B": 1.0}}, "model.presets.a.B: is no parameter"),
        (("presets",), {"default": {"A": 1.0}}, "is that of the table of parameters"),
        (("classifier",), {"words": {"left": "x"}}, "must be a condition"),
        (("equatoins",), {}, "model.equatoins: is no key here; did you mean equations or quantities?"),
    ],
)
def test_read_model__says_what_is_wrong_and_where(path, value, words):
    found = problems_of(changed(DUFFING, *path, value=value))
    assert any(words in p for p in found), found


def test_read_model__tells_all_problems_at_once():
    table = changed(changed(DUFFING, "equations", "v", value="q1 - q2"), "parameters", "d", value="x")
    table["states"]["v"]["unit"] = 1
    assert len(problems_of(table)) == 4
    table = changed(DUFFING, "define", value={"drive": "b1*2", "b1": "sin(b2)", "b2": "drive + 1"})
    assert problems_of(table) == ["model.define.drive: goes round in a circle: drive needs b1 needs b2 needs drive."]
    problems = problems_of(changed(DUFFING, "equations", "v", value="driv - e*v - sine(x) + q1 + q2*q3 +"))
    said = [problem.removeprefix("model.equations.v: ").partition(": ")[2] for problem in problems]
    assert [s.split(" at ")[0] for s in said] == [
        "unknown function 'sine'",
        "ends where something must follow.",
        *(f"unknown name {name!r}" for name in ("driv", "e", "q1", "q2", "q3")),
    ]
    problems = problems_of(changed(DUFFING, "equations", "v", value="+".join(f"q{i}" for i in range(20))))
    assert len(problems) == 9
    assert problems[-1].endswith("12 more problems.")


def test_autonomous__is_what_knows_no_time():
    table = {"name": "vdp", "states": {"x": "1", "y": "1"}, "equations": {"x": "y", "y": "(1 - x**2)*y - x"}}
    assert read_model(table).clock is STROBED
    for needed in ("t", "f", "phase", "a1"):
        define = {"a1": "sin(a2)", "a2": "phase"}
        assert read_model({**table, "define": define, "equations": {"x": "y", "y": needed}}).clock is DRIVEN
    assert read_model({**table, "define": {"a1": "t"}}).clock is STROBED  # not needed by an equation


# ---- references and digests --------------------------------------------------------------------


def test_load_model__returns_the_same_object_for_a_text_however_it_is_given(tmp_path):
    model = load_model(copy.deepcopy(DUFFING))
    assert load_model(model.reference) is model
    assert load_model(json.dumps(model.reference)) is model
    parameters = model.load(A=0.3)
    again = pickle.loads(pickle.dumps(parameters))
    assert again == parameters
    assert again.model is model
    for name in ("rossler", "belt"):
        assert name in model_names()
        model = load_model(name)
        assert model.reference == name
        assert pickle.loads(pickle.dumps(model.load())) == model.load()
    path = tmp_path / "mine.toml"
    path.write_text('model = "duffing5"\nbase = "default"\n[values]\nA = 0.5\n[provenance]\nA = "a fit"\n')
    assert dict(read_model(DUFFING).load(Preset.read(path))) == {"d": 0.08, "A": 0.5}


@pytest.mark.parametrize("text", ["{", "{]", '{"name": 1}', "{" * 5000, '{"name":"a","states":{"x":NaN}}'])
def test_load_model__refuses_broken_json(text):
    with pytest.raises(ModelError, match="model"):
        load_model(text)


def digest(table):
    return read_model(table).digest


def test_digest__stays_where_the_meaning_does():
    same = digest(DUFFING)
    assert digest(json.loads(json.dumps(DUFFING))) == same
    reordered = {key: DUFFING[key] for key in reversed(DUFFING)}
    assert digest(reordered) == same
    assert digest(changed(DUFFING, "equations", value={"v": "drive-d * v\n- x ** 3.0", "x": "(v)"})) == same
    assert digest(changed(DUFFING, "title", value="hardening")) == same
    assert digest(changed(DUFFING, "parameters", "A", "meaning", value="force")) == same
    assert digest(changed(DUFFING, "parameters", "d", value=0.1)) == same  # a run has the values that it uses
    two = changed(DUFFING, "define", value={"drive": "A*shape", "shape": "cos(2*pi*f*t)"})
    assert digest(two) == digest(changed(DUFFING, "define", value={"shape": "cos(2*pi*f*t)", "drive": "A*shape"}))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("equations", "v"), "drive - d*v - x**2"),
        (("equations", "v"), "drive - d*v + x**3"),
        (("equations", "v"), "drive - (d*v - x**3)"),
        (("define", "drive"), "A*sin(2*pi*f*t)"),
        (("define", "drive"), "A*cos(2.0000000000000004*pi*f*t)"),
        (("states",), {"v": {"unit": "m/s"}, "x": {"unit": "m"}}),
        (("states", "x"), {"unit": "m", "on_circle": True}),
        (("states", "x"), {"unit": "m", "scale": 2.0}),
        (("states", "x"), {"unit": "m", "escape": 2.0}),
        (("parameters",), {"A": 0.2, "d": 0.08}),
        (("parameters", "d"), {"value": 0.08, "bound": "positive"}),
        (("quantities",), {"E": "v**2"}),
        (("impacts",), [{"of": "x - 1", "direction": "up", "set": {"v": "-v"}}]),
    ],
)
def test_digest__changes_with_the_meaning(path, value):
    assert digest(changed(DUFFING, *path, value=value)) != digest(DUFFING)


@pytest.mark.slow
def test_source__is_the_same_whatever_was_read_before(run_python):
    """No word of a text and no memory of others stands in the generated code."""
    script = (
        "import json, sys\n"
        "from magpend_core.models import load_model\n"
        "table = json.loads(sys.stdin.read()) if False else json.loads({text!r})\n"
        "{before}"
        "print(load_model(table).source.text)\n"
    )
    text = json.dumps(PENDULUM)
    alone = run_python(script.format(text=text, before=""))
    after = run_python(script.format(text=text, before="load_model('pendulum-text').source\n"))
    assert alone == after
    assert not any(word in alone for word in ("ratio", "th", "pivot", "textbook"))


# ---- hostile texts -----------------------------------------------------------------------------


def mutated(chance: random.Random, value: Any, depth: int = 0) -> Any:
    """A value with something exchanged for what does not belong there."""
    strange = [
        None,
        True,
        3,
        float("nan"),
        float("inf"),
        10**400,
        "x",
        "import os",
        [],
        {},
        {"x": {}},
        ["x"] * 3,
        "x" * 9000,
        {str(i): "x" for i in range(300)},
        b"x",
        {1: 2},
        "1e999",
        {"value": "x"},
        object(),
        "sin",
        "\ud800",
        {"unit": "\x00"},
        "(lambda: 0)()",
        ("x", "x"),
    ]
    if depth > 5 or chance.random() < 0.12:
        return chance.choice(strange)
    if isinstance(value, dict) and value:
        made, key = dict(value), chance.choice(list(value))
        action = chance.randrange(4)
        if action == 0:
            del made[key]
        elif action == 1:
            made[chance.choice(["x", "drive", "sin", "import", "a" * 99, "", "x y", "\n", "v", "__init__"])] = made[key]
        else:
            made[key] = mutated(chance, value[key], depth + 1)
        return made
    if isinstance(value, str) and value:
        i = chance.randrange(len(value))
        return value[:i] + chance.choice(list("()*+-/.,<>=_'\"\\\n\x00 19xé{}[]:;@")) + value[i + chance.randrange(2) :]
    if isinstance(value, list) and value:
        return [mutated(chance, value[0], depth + 1), *value[1:]]
    return chance.choice(strange)


def test_read_model__stands_a_thousand_mutations():
    """One kind of error or a model, within milliseconds, whatever is exchanged in a good text."""
    chance = random.Random(11)
    good = changed(PENDULUM, "impacts", value=[{"of": "th - 1", "direction": "up", "set": {"w": "-w"}}])
    good["states"] |= {"z[1..4]": {"unit": "m"}}
    good["define"] |= {"gate(u, n)": "1/(1 + u**n)", "mean[i=1..2]": "sum(j=1..4, z[j])/i"}
    good["equations"] |= {"z[i=2..4]": "gate(z[i-1], i) - z[i] + mean[mod(i, 2) + 1]", "z1": "-z1"}
    refused, slowest = 0, 0.0
    for i in range(1000):
        table = good
        for _ in range(1 + i % 3):
            table = mutated(chance, table)
        begin = time.process_time()
        problems = ["model"]
        try:
            model = read_model(table)
        except ModelError as error:
            refused, problems = refused + 1, error.problems
        else:
            json.dumps(model.reference)
        slowest = max(slowest, time.process_time() - begin)
        assert all(p.startswith("model") and len(p) < 3000 for p in problems), problems
        assert problems
    assert refused > 300
    assert slowest < 10.0


@pytest.mark.parametrize("table", [None, 3, "x", [], {}, {"name": "a"}, {"states": 1, "name": 2, "equations": 3}])
def test_read_model__refuses_what_is_no_table_of_a_model(table):
    assert problems_of(table)


@pytest.mark.slow
def test_opening__needs_neither_compiler_nor_algebra(run_python):
    script = (
        "import sys, json\n"
        "import numpy as np\n"
        "from magpend_core.models import load_model, model_names\n"
        f"model = load_model({json.dumps(PENDULUM)!r})\n"
        "model.drawing.points(np.zeros((3, 2)), model.load()), model.classifier, model.digest\n"
        "[load_model(name).derived for name in model_names() if hasattr(load_model(name), 'derived')]\n"
        "print([m for m in ('numba', 'llvmlite', 'sympy', 'scipy') if m in sys.modules])\n"
    )
    assert run_python(script).strip() == "[]"


def test_remarks__name_parameters_and_definitions_that_nothing_uses():
    assert read_model(DUFFING).remarks == ()
    assert read_model(PENDULUM).remarks == ()  # l stands in the drawing and in a definition
    table = changed(DUFFING, "parameters", "dd", value=0.1)
    table = changed(table, "define", "friction", value="0.1*v")
    assert read_model(table).remarks == (
        "model.parameters.dd: nothing uses it; did you mean it where an expression has d? Else use it in an "
        "expression, or take it out (to sweep it would change nothing).",
        "model.define.friction: nothing uses it; use it in an expression, or take it out.",
    )
    used = changed(table, "impacts", value=[{"of": "x - dd", "direction": "up", "set": {"v": "-friction"}}])
    assert read_model(used).remarks == ()
    assert {name: load_model(name).remarks for name in model_names() if load_model(name).remarks} == {}


@pytest.mark.parametrize(("force", "n"), [("cos(2*pi*f*t)", 1), ("square(phase, 0.5)", 1), ("sin(x)", 0)])
def test_remarks__name_a_state_that_hides_the_drive(force, n):
    """A drive's angular frequency is called omega; without a drive the name is free."""
    equations = {"x": "omega", "omega": f"-x + {force}"}
    found = read_model({"name": "own", "states": {"x": "1", "omega": "1"}, "equations": equations}).remarks
    assert [line for line in found if "this state hides the drive's angular frequency" in line] == list(found[:n])
    assert len([line for line in found if "hides" in line]) == n


def turning(rates, more=(), **states):
    """A pendulum-like model by its rates; a state is declared by its table, if it is given one."""
    own = {name: states.get(name, {}) for name in rates}
    parameters = {"torque": 1.5, "k": 1.0, "zero": 0.0}
    return read_model({"name": "turning", "states": own, "parameters": parameters, "equations": rates, **dict(more)})


DROPPED = {"of": "th", "direction": "up", "set": {"w": "-w"}}
KICKED = {"of": "w - 9", "direction": "up", "set": {"w": "cos(th)", "th": "th + 1"}}


@pytest.mark.parametrize(
    ("model", "angles"),
    [
        (turning({"th": "w", "w": "torque - w - k*sin(th)"}), ["th"]),
        (turning({"th": "w", "w": "torque - w - k*sin(th)"}, th={"on_circle": True}), []),
        (turning({"th": "w", "w": "torque - w - 1e6*sin(th)*cos(2*pi*phase)"}), ["th"]),
        (turning({"a": "sin(b - a)", "b": "k - sin(b - a)"}), ["a", "b"]),
        (turning({"x": "sin(2*x)"}), ["x"]),
        (turning({"x": "-x"}), []),
        (turning({"x": "sin(x) - zero*x"}), []),
        (turning({"x": "sin(x/k)"}), []),
        (turning({"x": "sin(x) - 1e-6*x"}), []),
        (turning({"x": "-sign(x)", "y": "where(x < 0.01 and x > 0, 1, -1)"}), []),
        (turning({"x": "-x", "clock": "1", "work": "x**2"}), []),
        (turning({"th": "w", "w": "-sin(th)"}, {"impacts": [DROPPED]}), []),
        (turning({"th": "w", "w": "-sin(th)"}, {"impacts": [KICKED]}), ["th"]),
    ],
)
def test_remarks__name_angles_that_are_not_declared(model, angles):
    said = [line for line in model.remarks if "nothing uses it" not in line]
    assert said == list(model.angle_remarks)
    assert [line.split(":")[0] for line in said] == [f"model.states.{name}" for name in angles]
    assert all(f"{name} = {{ on_circle = true }}" in line for name, line in zip(angles, said, strict=True))


def test_autonomous__may_use_the_drives_names():
    """A parameter f of a flow without a drive is a parameter like any other, in all that reads the text."""
    table = {
        "name": "named",
        "states": {"x": {}, "y": {}},
        "parameters": {"f": 0.5, "phase": 2.0},
        "equations": {"x": "f*x - y - x**3 + (f - 0.5)*y**2", "y": "x + phase*y - y**3 + (phase - 2)*x**2"},
        "quantities": {"q": "f*x"},
        "mirror": {"signs": {"x": -1, "y": -1}},
        "classifier": {"words": {"up": "phase*x > f"}},
    }
    renamed = re.sub(r"\bf\b", "g", re.sub(r"\bphase\b", "h", json.dumps(table)))
    model, plain = read_model(table), read_model(json.loads(renamed))
    assert model.clock == STROBED
    assert model.remarks == ()
    assert model.source.text == plain.source.text
    states = np.array([[[0.3, -0.7]], [[1.3, 0.2]]])
    labels = [
        m.classifier.classify(states, None, None, dict(zip(m.parameter_names, (0.5, 2.0), strict=True)))
        for m in (model, plain)
    ]
    np.testing.assert_array_equal(*labels)
    iterated = {**table, "kind": "map", "parameters": {"f": 0.5}, "equations": {"x": "f*x", "y": "f"}}
    del iterated["classifier"]
    assert read_model({**iterated, "mirror": {"signs": {}}}).parameter_names == ("f",)
    defined = {
        "name": "a",
        "states": {"f": {}, "y": {}},
        "define": {"phase": "2*f"},
        "equations": {"f": "y", "y": "-phase"},
    }
    assert read_model(defined).clock == STROBED


@pytest.mark.parametrize("drive", ["cos(2*pi*t)", "square(phase, 0.5)"])
def test_driven__says_why_f_is_taken(drive):
    table = {"name": "a", "states": {"x": {}}, "parameters": {"f": 1.0}, "equations": {"x": f"{drive} - x"}}
    (problem,) = problems_of(table)
    assert "model.parameters.f: f belongs to the drive in equations with" in problem
    assert (
        "choose another name, such as f_, or take it out if it is the drive's: its frequency is given as frequency_hz"
        in problem
    )
