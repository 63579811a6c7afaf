"""Kinetic models in SBML have the equations that one writes down by hand."""

from __future__ import annotations

import random

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core.models import load_model
from magpend_core.models.text.numeric import rates_of
from magpend_core.trajectory import trajectory
from pipeline.importing.assembly import assembled
from pipeline.importing.importing import Imported, import_file
from pipeline.importing.sbml import read
from pipeline.specification.problems import SpecError

pytest.importorskip("libsbml", reason="python-libsbml is not installed")

MATH = '<math xmlns="http://www.w3.org/1998/Math/MathML">{}</math>'


def apply(sign: str, *args: str) -> str:
    return f"<apply><{sign}/>{''.join(map(word, args))}</apply>"


def word(text: str) -> str:
    """Return a name or a number in MathML, and anything else as it is."""
    if text.startswith("<"):
        return text
    return f"<ci>{text}</ci>" if text[0].isalpha() else f"<cn>{text}</cn>"


def called(name: str, *args: str) -> str:
    return f"<apply><ci>{name}</ci>{''.join(map(word, args))}</apply>"


def math(formula: str) -> str:
    return MATH.format(word(formula))


def document(body: str, level: int = 3, version: int = 1) -> str:
    place = f"http://www.sbml.org/sbml/level{level}/version{version}{'/core' if level > 2 else ''}"
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<sbml xmlns="{place}" level="{level}" version="{version}">\n'
        f'<model id="made" name="A made model">\n{body}\n</model>\n</sbml>\n'
    )


def species(name: str, start: str, *, compartment: str = "cell", amount: bool = False, fixed: bool = False) -> str:
    return (
        f'<species id="{name}" compartment="{compartment}" {start} hasOnlySubstanceUnits="{str(amount).lower()}" '
        f'boundaryCondition="{str(fixed).lower()}" constant="false"/>'
    )


def reaction(name: str, reactants: dict[str, float], products: dict[str, float], law: str, local: str = "") -> str:
    def listed(kind: str, some: dict[str, float]) -> str:
        inner = "".join(
            f'<speciesReference species="{s}" stoichiometry="{n}" constant="true"/>' for s, n in some.items()
        )
        return f"<listOf{kind}>{inner}</listOf{kind}>" if some else ""

    return (
        f'<reaction id="{name}" reversible="false" fast="false">{listed("Reactants", reactants)}'
        f"{listed('Products', products)}<kineticLaw>{math(law)}{local}</kineticLaw></reaction>"
    )


def many(kind: str, *parts: str) -> str:
    return f"<listOf{kind}>{''.join(parts)}</listOf{kind}>"


def parameter(name: str, value: float | None = None, constant: bool = True) -> str:
    given = "" if value is None else f' value="{value}"'
    return f'<parameter id="{name}"{given} constant="{str(constant).lower()}"/>'


CELL = many("Compartments", '<compartment id="cell" size="2" constant="true" spatialDimensions="3"/>')
LOCAL = many("LocalParameters", '<localParameter id="k" value="0.5"/>')
CUBE = (
    f'<functionDefinition id="grown"><math xmlns="http://www.w3.org/1998/Math/MathML"><lambda><bvar><ci>p</ci></bvar>'
    f"<bvar><ci>q</ci></bvar>{apply('times', apply('power', 'p', '2'), 'q')}</lambda></math></functionDefinition>"
)
BRUSSELATOR = document(
    many("FunctionDefinitions", CUBE)
    + CELL
    + many(
        "Species",
        species("X", 'initialAmount="2.4"'),
        species("Y", 'initialConcentration="2.5"'),
        species("F", 'initialConcentration="1"', fixed=True),
        species("made", 'initialAmount="0"', amount=True),
    )
    + many("Parameters", parameter("b", 2.9), parameter("t", 1.0))
    + many(
        "Reactions",
        reaction("feed", {"F": 1}, {"X": 1}, apply("times", "cell", "F", "k"), LOCAL.replace("0.5", "1.1")),
        reaction("turn", {"X": 2, "Y": 1}, {"X": 3}, apply("times", "cell", called("grown", "X", "Y"))),
        reaction("swap", {"X": 1}, {"Y": 1}, apply("times", "cell", "b", "X")),
        reaction("leave", {"X": 1}, {"made": 1}, apply("times", "cell", "t", "X", "k"), LOCAL),
    )
)


def brusselator(t: float, y: np.ndarray) -> list[float]:
    x, y1, _ = y
    turn = x * x * y1
    return [1.1 + turn - 2.9 * x - 0.5 * x, 2.9 * x - turn, 2.0 * 0.5 * x]


def rule(kind: str, variable: str, formula: str) -> str:
    return f'<{kind}Rule variable="{variable}">{math(formula)}</{kind}Rule>'


ONE = many("Compartments", '<compartment id="cell" size="1" constant="true" spatialDimensions="3"/>')
SATURATED = apply("divide", apply("times", "VM1", "C"), apply("plus", "C", "Kc"))
# Goldbeter, Proc. Natl. Acad. Sci. USA 88, 9107, 1991: the mitotic oscillator
MITOSIS = document(
    ONE
    + many("Species", *(species(n, 'initialConcentration="0.01"') for n in "CMX"))
    + many(
        "Parameters",
        *(parameter(n, v) for n, v in {"VM1": 3.0, "VM3": 1.0, "Kc": 0.5, "vi": 0.025, "vd": 0.25, "Kd": 0.02}.items()),
        *(parameter(n, v) for n, v in {"kd": 0.01, "V2": 1.5, "V4": 0.5, "K": 0.005}.items()),
        parameter("V1", constant=False),
        parameter("V3", constant=False),
    )
    + many("Rules", rule("assignment", "V1", SATURATED), rule("assignment", "V3", apply("times", "M", "VM3")))
    + many(
        "Reactions",
        reaction("r1", {}, {"C": 1}, apply("times", "cell", "vi")),
        reaction("r2", {"C": 1}, {}, apply("times", "kd", "C")),
        reaction("r3", {"C": 1}, {}, apply("divide", apply("times", "vd", "X", "C"), apply("plus", "C", "Kd"))),
        *(
            reaction(f"up{n}", {}, {n: 1}, apply("divide", apply("times", v, rest), apply("plus", "K", rest)))
            for n, v, rest in (("M", "V1", apply("minus", "1", "M")), ("X", "V3", apply("minus", "1", "X")))
        ),
        *(
            reaction(f"down{n}", {n: 1}, {}, apply("divide", apply("times", v, n), apply("plus", "K", n)))
            for n, v in (("M", "V2"), ("X", "V4"))
        ),
    )
)


def mitosis(t: float, y: np.ndarray) -> list[float]:
    c, m, x = y
    v1, v3 = 3.0 * c / (c + 0.5), m
    return [
        0.025 - 0.01 * c - 0.25 * x * c / (c + 0.02),
        v1 * (1 - m) / (0.005 + 1 - m) - 1.5 * m / (0.005 + m),
        v3 * (1 - x) / (0.005 + 1 - x) - 0.5 * x / (0.005 + x),
    ]


def hill(p: str) -> str:
    return apply("divide", "alpha", apply("plus", "1", apply("power", p, "n")))


# Elowitz and Leibler, Nature 403, 335, 2000: the repressilator, with rate rules and an initial assignment
REPRESSILATOR = document(
    many(
        "Parameters",
        *(parameter(n, v) for n, v in {"alpha0": 0.2, "beta": 5.0, "n": 2.0, "half": 100.0}.items()),
        parameter("alpha"),
        *(parameter(f"{kind}{i}", 1.0 + i, False) for kind in "mp" for i in range(3)),
    )
    + many(
        "InitialAssignments",
        f'<initialAssignment symbol="alpha">{math(apply("times", "2", "half"))}</initialAssignment>',
        f'<initialAssignment symbol="p0">{math(apply("plus", "m1", "3"))}</initialAssignment>',
    )
    + many(
        "Rules",
        *(
            rule("rate", f"m{i}", apply("plus", apply("minus", f"m{i}"), hill(f"p{(i + 2) % 3}"), "alpha0"))
            for i in range(3)
        ),
        *(
            rule("rate", f"p{i}", apply("times", apply("minus", "beta"), apply("minus", f"p{i}", f"m{i}")))
            for i in range(3)
        ),
    )
)


def repressilator(t: float, y: np.ndarray) -> list[float]:
    m, p = y[:3], y[3:]
    return [*(-m + 200.0 / (1.0 + p[[2, 0, 1]] ** 2) + 0.2), *(-5.0 * (p - m))]


PUBLISHED = {
    "brusselator": (BRUSSELATOR, brusselator, [1.2, 2.5, 0.0]),
    "mitosis": (MITOSIS, mitosis, [0.01, 0.01, 0.01]),
    "repressilator": (REPRESSILATOR, repressilator, [1.0, 2.0, 3.0, 5.0, 2.0, 3.0]),
}


def imported(folder, text: str) -> Imported:
    path = folder / "made.xml"
    path.write_text(text, "utf-8")
    return import_file(path)


@pytest.mark.parametrize("name", PUBLISHED)
def test_import__has_the_equations_and_the_start_of_the_paper(tmp_path, name):
    text, rates, start = PUBLISHED[name]
    found = imported(tmp_path, text)
    assert found.spec.tables["initial_conditions"]["points"] == [start]
    definition = load_model(found.spec.reference).definition
    own = {p.name: definition.presets[0].values[p.name] for p in definition.parameters}
    rng = np.random.default_rng(2)
    for _ in range(10):
        y = rng.uniform(0.1, 0.9, len(start))
        known = dict(zip((s.name for s in definition.states), y, strict=True))
        found_rates = rates_of(definition, {**own, **known, "pi": np.pi})
        np.testing.assert_allclose([float(v) for v in found_rates.values()], rates(0.0, y), rtol=1e-12, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_import__has_the_trajectory_of_an_independent_integration(tmp_path, name):
    text, rates, start = PUBLISHED[name]
    model = load_model(imported(tmp_path, text).spec.reference)
    times = np.arange(1.0, 31.0)
    own = trajectory(model.load(), 1.0, start, times, rtol=1e-12, atol=1e-13)
    solved = solve_ivp(rates, (0.0, 30.0), start, "DOP853", times, rtol=1e-12, atol=1e-13)
    scale = np.abs(solved.y).max()
    np.testing.assert_allclose(own / scale, solved.y.T / scale, atol=1e-8)


EVENT = document(
    many("Parameters", parameter("k", 0.5), parameter("x", 3.0, False), parameter("n", 0.0, False))
    + many("Rules", rule("rate", "x", apply("minus", apply("times", "k", "x"))))
    + many(
        "Events",
        '<event id="dose" useValuesFromTriggerTime="true"><trigger initialValue="true" persistent="true">'
        + math(apply("lt", "x", "1"))
        + "</trigger>"
        + many(
            "EventAssignments",
            *(
                f'<eventAssignment variable="{v}">{math(f)}</eventAssignment>'
                for v, f in (("x", apply("plus", "x", "2")), ("n", apply("plus", "n", "x")))
            ),
        )
        + "</event>",
    )
)


def test_event__assignments_take_the_values_before_it(tmp_path):
    (impact,) = imported(tmp_path, EVENT).spec.tables["model"]["impacts"]
    assert (impact["of"], impact["direction"]) == ("x - 1", "down")
    assert impact["set"] == {"n": "n + x", "x": "x + 2"}
    assert list(impact["set"]) == ["n", "x"]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("<trigger", f"<delay>{math('k')}</delay><trigger", "dose has a delay"),
        (apply("lt", "x", "1"), apply("and", apply("lt", "x", "1"), apply("gt", "n", "0")), "must be one comparison"),
        ('<parameter id="k" value="0.5"', '<parameter id="k"', "k has no value"),
        ("<rateRule variable", "<algebraicRule metaid", "an algebraic rule defines"),
        (apply("times", "k", "x"), apply("factorial", "x"), "factorial: the text of a model has no such function"),
        (apply("plus", "x", "2"), apply("plus", "n", "2"), "exchange values"),
        (apply("times", "k", "x"), apply("times", "q", "x"), "q is not defined"),
    ],
)
def test_read__refuses_with_line_and_reason(tmp_path, old, new, problem):
    assert old in EVENT
    text = EVENT.replace(old, new)
    if "algebraic" in new:
        text = text.replace("</rateRule>", "</algebraicRule>").replace(' metaid="x"', "")
    with pytest.raises(SpecError, match=problem) as caught:
        imported(tmp_path, text)
    assert all(one.startswith("made.xml, line ") for one in caught.value.problems)


def test_read__damaged_files(tmp_path):
    """Of damaged files each becomes a model or is refused in words."""
    rng, path, good, bad = random.Random(4), tmp_path / "damaged.xml", 0, 0
    texts = [BRUSSELATOR, MITOSIS, EVENT]
    for _ in range(400):
        text = rng.choice(texts)
        for _ in range(rng.choice((1, 1, 2, 4))):
            at, other = rng.randrange(len(text)), rng.choice(texts)
            begin = rng.randrange(len(other))
            bits = ("", other[begin : begin + 80], "-", "1e999", "<ci>t</ci>", "nan", text[at : at + 9] * 20)
            text = text[:at] + rng.choice(bits) + text[at + rng.randint(0, 12) :]
        path.write_text(text, "utf-8")
        try:
            assembled(read(path))
            good += 1
        except SpecError as error:
            bad += all(error.problems)
    assert good + bad == 400
    assert good > 0
