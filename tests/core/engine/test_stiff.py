"""Stiff problems: their known ends."""

import numpy as np
import pytest

from tests.core.cells import run_cells
from tests.core.stiff import CONTACT, HIRES, HODGKIN_HUXLEY


def end_of(problem, method, tolerance):
    """Return the end of a problem by the engine, and its steps."""
    found = run_cells(
        problem.model.system,
        problem.model.load().pack(),
        1.0 / problem.time,
        [problem.start],
        rtol=tolerance,
        method=method,
        max_steps_per_period=1_000_000,
    )
    return found.section[0, 0, 0], found.n_steps[0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("problem", [HIRES, HODGKIN_HUXLEY, CONTACT], ids=lambda p: p.table["name"])
def test_stiff__ends_are_those_of_an_explicit_method(problem):
    found, _ = end_of(problem, "dopri5", 1e-12)
    np.testing.assert_allclose(found, problem.end, rtol=1e-10, atol=1e-12)
