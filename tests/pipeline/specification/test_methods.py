"""`integration.method`: what it does to a run, and with what it does not go."""

import numpy as np
import pytest

from pipeline.compute.task import compute
from pipeline.layout.cells import CellMap
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec


def spec_of(method, **more):
    return Spec.parse(
        {
            "kind": "sweep",
            "model": "duffing",
            "parameters": {"preset": "hardening", "frequency_hz": 0.2},
            "initial_conditions": {"kind": "list", "points": [[0.3, 0.1], [-0.2, 0.5]]},
            "integration": {"method": method, "n_transient": 20, "n_keep": 4, "rtol": 1e-10, "atol": 1e-10},
            **more,
        }
    )


def cells_of(spec):
    cells = CellMap(spec)
    return compute(spec, cells, tuple(slice(0, n) for n in cells.shape))


@pytest.mark.slow
def test_method__of_order_8_gives_the_same_motion_in_fewer_steps():
    fifth, eighth = (cells_of(spec_of(m, products={"lyapunov": {}})) for m in ("dopri5", "dop853"))
    np.testing.assert_allclose(eighth["section"], fifth["section"], atol=1e-6)
    np.testing.assert_allclose(eighth["lyapunov"], fifth["lyapunov"], atol=1e-3)
    assert (3 * eighth["n_steps"] < fifth["n_steps"]).all()


def test_method__is_part_of_what_a_run_is():
    assert spec_of("dop853").as_dict()["integration"]["method"] == "dop853"
    assert spec_of("dop853").as_dict() != spec_of("dopri5").as_dict()


def test_method__of_order_8_goes_with_nothing_that_looks_into_steps():
    extremes = {"extremes": {"quantities": ["energy"]}}
    assert spec_of("dopri5", products=extremes).products
    with pytest.raises(SpecError) as caught:
        spec_of("dop853", products=extremes)
    (problem,) = caught.value.problems
    assert problem == (
        'integration.method = "dop853": products.extremes looks within steps; drop one of the two, or set '
        'method = "dopri5".'
    )


def test_method__is_one_of_two():
    with pytest.raises(SpecError, match=r"integration.method = 'rk4'"):
        spec_of("rk4")
