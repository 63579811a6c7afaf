"""What a system is: its checks, its positions by name."""

import numpy as np
import pytest

from magpend_core.engine.jit import inline, kernel
from magpend_core.engine.system import positions

AT = positions(("mass", "stiffness", "q"))


@inline
def _rate(p):
    return p[AT.stiffness] / p[AT.mass]


def test_positions__are_constants_of_compiled_code():
    by_name = kernel(lambda p: _rate(p) + AT.q, kept=None)
    assert AT == (0, 1, 2)
    assert by_name(np.array([2.0, 6.0, 0.0])) == 5.0


@pytest.mark.parametrize("names", [("a", "a"), ("a", "class"), ("_a",), ("two words",)])
def test_positions__refuses_names_that_cannot_be_attributes(names):
    with pytest.raises(ValueError, match="ield name"):
        positions(names)
