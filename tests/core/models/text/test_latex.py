"""LaTeX of expressions: as they were written, brackets where they are needed and nowhere else."""

import pytest

from magpend_core.models import load_model
from magpend_core.models.text.grammar import parse
from magpend_core.models.text.latex import equations_of, latex_of, symbol_of
from magpend_core.models.text.reading import read_definition
from tests.core.flows import table


@pytest.mark.parametrize(
    ("text", "latex"),
    [
        ("a + b - c", "a + b - c"),
        ("a - (b - c)", r"a - \left(b - c\right)"),
        ("a*(b + c)", r"a \, \left(b + c\right)"),
        ("-a*b", r"-a \, b"),
        ("a - -b", r"a - \left(-b\right)"),
        ("a/b/c", r"\frac{a}{b \, c}"),
        ("a/(b/c)", r"\frac{a}{\frac{b}{c}}"),
        ("1/(1 + x)", r"\frac{1}{1 + x}"),
        ("x**2", "x^{2}"),
        ("-x**2", "-x^{2}"),
        ("(-x)**2", r"\left(-x\right)^{2}"),
        ("(x**a)**b", r"\left(x^{a}\right)^{b}"),
        ("2*3*x", r"2 \cdot 3 \, x"),
        ("2e-5*x", r"2 \cdot 10^{-5} \, x"),
        ("1e-5", "10^{-5}"),
        ("sqrt(a + b)", r"\sqrt{a + b}"),
        ("abs(x)*x", r"\left|x\right| \, x"),
        ("sin(2*pi*f*t)", r"\sin\left(2 \, \pi \, f \, t\right)"),
        ("floor(x)*ceil(a/b)", r"\left\lfloor x \right\rfloor \, \left\lceil \frac{a}{b} \right\rceil"),
        ("heaviside(x) + mod(x, b)", r"\Theta\left(x\right) + \operatorname{mod}\left(x, b\right)"),
        ("ln(x)/log10(x)", r"\frac{\ln\left(x\right)}{\log_{10}\left(x\right)}"),
        ("atan2(y, x)", r"\operatorname{atan2}\left(y, x\right)"),
        (
            "where(x > 0 and y <= 1, a, b)",
            r"\begin{cases} a & \text{if } x > 0 \land y \le 1 \\ b & \text{else} \end{cases}",
        ),
    ],
)
def test_latex_of__as_it_was_written(text, latex):
    assert latex_of(parse(text), {}) == latex


@pytest.mark.parametrize(
    ("name", "latex"),
    [
        ("x", "x"),
        ("theta", r"\theta"),
        ("drive", r"\mathrm{drive}"),
        ("x1", "x_{1}"),
        ("k_max", r"k_{\mathrm{max}}"),
        ("omega_0", r"\omega_{0}"),
        ("th", r"\mathrm{th}"),
    ],
)
def test_symbol_of__letters_words_and_indices(name, latex):
    assert symbol_of(name, {}) == latex


def test_equations_of__definitions_in_the_order_of_their_need_and_own_symbols():
    table = {
        "name": "probe",
        "states": {"th": {"unit": "rad", "symbol": r"\vartheta"}},
        "parameters": {"k": 1.0},
        "define": {"b": "a + 1", "a": "k*th", "idle": "2"},
        "equations": {"th": "-b"},
    }
    assert equations_of(load_model(table).definition) == [
        r"a &= k \, \vartheta",
        r"b &= a + 1",
        r"\frac{\mathrm{d}\vartheta}{\mathrm{d}t} &= -b",
    ]


# ---- symbols of states that are the rate of another


def symbols(states, equations):
    definition, problems = read_definition(table("one", equations, states=states))
    assert problems == []
    return [s.symbol for s in definition.states]


@pytest.mark.parametrize(
    ("state", "rate", "symbol"),
    [
        ("x", "x_dot", r"\dot{x}"),
        ("x", "xdot", r"\dot{x}"),
        ("x", "dx", r"\dot{x}"),
        ("x", "v", r"\dot{x}"),
        ("theta1", "theta1_dot", r"\dot{\theta}_{1}"),
        ("x", "y", ""),  # a name of its own
    ],
)
def test_symbol__of_a_state_that_is_a_rate(state, rate, symbol):
    assert symbols({state: "m", rate: "m/s"}, {state: rate, rate: f"-{state}"}) == ["", symbol]


def test_symbol__that_is_given_stays():
    states = {"x": {"symbol": "q"}, "v": {"symbol": "u"}}
    assert symbols(states, {"x": "v", "v": "-x"}) == ["q", "u"]
    assert symbols({"x": {"symbol": "q"}, "v": "1"}, {"x": "v", "v": "-x"}) == ["q", r"\dot{q}"]
    assert symbols({"x": "m", "v": "m/s"}, {"x": "-x + v", "v": "-x"}) == ["", ""]  # v is not the rate of x
