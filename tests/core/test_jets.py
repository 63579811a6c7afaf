"""Power series of rates against sympy's derivatives of the same text."""

import numpy as np
import pytest
import sympy

from magpend_core.jets import monomials, rates_on
from tests.core.flows import model_of

TEXTS = {
    "products": "a*x^3*y^2 - 1.7*x*y/(1 + x^2) + (x + 2)^(5/2) - 1/(y + 3)^3",
    "exponentials": "exp(-a*x*y)*log(2 + x*y) + (2 + x)^(1.3*y) + sqrt(1 + x^2)",
    "circular": "sin(2*x - y)*cos(x*y) + tan(.3*x) + atan(x - 3*y) + asin(.3*x*y) + acos(.2*x) + atan2(1 + x, y - 2)",
    "hyperbolic": "tanh(2*x + y) + sinh(x)*cosh(y) - tanh(y - 1)",
    "corners": "abs(x - 2)*y + where(x < 1, x^2*y, y) + max(x*y, x^3 - 4) + min(x, sin(y)) + sign(y - 3)*x",
}


@pytest.mark.parametrize("name", TEXTS)
def test_rates_on__sympy(name):
    """All derivatives up to order five, along complex directions."""
    text, at, a = TEXTS[name], {"x": 0.43, "y": -0.61}, 1.3
    model = model_of({"x": text, "y": "x"}, {"a": a})
    of = monomials(2, 5)
    states = np.zeros((2, len(of.exponents)), complex)
    q = np.array([[0.7 + 0.2j, -0.3], [0.4j, 1.1 - 0.5j]])
    states[:, 0], states[:, 1:3] = list(at.values()), q
    found = rates_on(model.system, model.load().pack(), of, states)
    x, y, u, v = sympy.symbols("x y u v")
    written = text.replace("^", "**").replace("where(x < 1, x**2*y, y)", "x**2*y").replace("sign(y - 3)", "(-1)")
    written = (
        written.replace("abs(x - 2)", "(2 - x)")
        .replace("max(x*y, x**3 - 4)", "x*y")
        .replace("min(x, sin(y))", "sin(y)")
    )
    f = sympy.sympify(written, {"a": sympy.Float(a, 40)})
    slopes = {(i, j): complex(f.diff(x, i, y, j).evalf(40, subs=at)) for i in range(6) for j in range(6 - i)}
    series = sum(
        d
        * (q[0, 0] * u + q[0, 1] * v) ** i
        * (q[1, 0] * u + q[1, 1] * v) ** j
        / sympy.factorial(i)
        / sympy.factorial(j)
        for (i, j), d in slopes.items()
    )
    known = sympy.Poly(sympy.expand(series), u, v)
    for value, exponents in zip(found[0], of.exponents.tolist(), strict=True):
        wanted = complex(known.coeff_monomial(u ** exponents[0] * v ** exponents[1]))
        assert value == pytest.approx(wanted, rel=1e-12, abs=1e-12)
