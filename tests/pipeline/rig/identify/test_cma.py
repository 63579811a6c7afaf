"""Guesses by CMA-ES, where the local stage alone ends elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.rig.identify.search import search

from .test_fit import NOISE, make_problem, truth_of

pytestmark = pytest.mark.slow  # needs cma


def test_search__finds_guesses_by_cma():
    problem = make_problem(NOISE)
    free = tuple(replace(f, start=7.0) if f.name == "linear" else f for f in problem.free)
    fits = search(replace(problem, free=free), n_starts=2, seed=1, spread=0.5, method="cma")
    np.testing.assert_allclose(fits[0].theta, truth_of(problem), rtol=0.01)
