"""Analyses integrate as finely as the run's cells: tolerances and limits of steps."""

import numpy as np
import pytest

from magpend_core.defaults import MOST_STEPS
from magpend_core.precision import Precision, limits_at, tolerances_at


def test_limits__follow_the_run():
    # atol as many times below rtol as in the run
    assert Precision(1e-9, 1e-18).limits(1e-12)["atol"] == pytest.approx(1e-21)
    # never above the run's, nor above the relative tolerance
    assert Precision(1e-9, 1e-18).limits(1e-6)["atol"] == pytest.approx(1e-18)
    assert Precision(1e-9, 1e-6).limits(1e-12)["atol"] == 1e-12
    # steps of order 5: a tolerance 1e5 times finer takes 10 times as many
    assert Precision(1e-7, 1e-7, 30_000).limits(1e-12)["max_steps_per_period"] == pytest.approx(300_000, abs=1)
    assert Precision(1e-7, 1e-7, 10).limits(1e-6)["max_steps_per_period"] == MOST_STEPS


def test_used__ends_with_its_context():
    plain = limits_at(1e-12)
    with Precision.of({"rtol": 1e-8, "atol": 1e-20, "title": "a run"}).used():
        assert tolerances_at(1e-12) == {"rtol": 1e-12, "atol": pytest.approx(1e-24)}
    assert limits_at(1e-12) == plain
    assert plain["rtol"] == plain["atol"] == 1e-12


@pytest.mark.slow
def test_polish_orbits__says_what_ended_it(monkeypatch):
    from magpend_core.status import Status
    from tests.core.flows import VAN_DER_POL
    from tests.core.test_flows import polish, seen

    guess = [[1.9, 0.0]]
    found = polish(seen(VAN_DER_POL, "v", direction="down"), guess)
    assert found.status.tolist() == [Status.PERIODIC]
    monkeypatch.setattr("magpend_core.precision.MOST_STEPS", 5)
    with Precision(max_steps=5).used():
        found = polish(seen(VAN_DER_POL, "v", direction="down"), guess)
    assert found.status.tolist() == [Status.STEP_LIMIT]
    assert np.isnan(found.residual).all()
