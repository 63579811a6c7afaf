"""Saddle equilibria in chaotic sets, against closed forms; the crisis of Lorenz's equations is one of the events."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import magpend
from magpend_core.crossing import Crossing
from pipeline.analysis.branches.starting_orbits import family_of
from pipeline.analysis.events import connections
from pipeline.analysis.events.connections import (
    ConnectionSettings,
    Leaving,
    Rest,
    _sides,
    connection_of,
    rest_at,
    rests_in,
)
from pipeline.analysis.events.contact import Effort, SectionMap, sample_of
from pipeline.results.sets import Geometry
from tests.pipeline.analysis.events.test_events import lorenz_connection

LORENZ = magpend.load_model("lorenz")


EFFORT = Effort(128, 256, 3, 12, 1, is_flow=True)


def lorenz_map():
    """The map of the section z = 23 along rho."""
    system, packed, frequency = Crossing("z", 23.0, "down", 60.0).applied(LORENZ.load(rho=28.0).pack(), LORENZ.system)
    family = family_of(system, 1, float(frequency), packed, "rho", 6.0)
    return SectionMap(family, Geometry.of(LORENZ), 1e-9)


def test_rest_at__saddles_of_lorenz():
    """The origin has one unstable direction, the others a pair beyond their Hopf point at 24.74, and none before."""
    along = lorenz_map()
    rest = rest_at(along, 24.0, np.array([0.3, 0.3, 0.1]))
    rate = 0.5 * (np.sqrt(81.0 + 40.0 * 24.0) - 11.0)
    assert rest.rate == pytest.approx(rate)
    assert rest.direction == pytest.approx([1.0 / (1.0 + rate / 10.0), 1.0, 0.0])
    jacobian = np.array([[-10.0, 10.0, 0.0], [24.0, -1.0, 0.0], [0.0, 0.0, -8.0 / 3.0]])
    assert rest.covector @ jacobian == pytest.approx(rate * rest.covector)
    assert rest.covector @ rest.direction == pytest.approx(1.0)
    assert str(rest) == "(0, 0, 0)"
    for rho in (20.0, 26.0):
        x = np.sqrt(8.0 / 3.0 * (rho - 1.0))
        assert rest_at(along, rho, np.array([x, x, rho - 1.0])) is None
    # followed to another value, the direction keeps the sense that it had
    turned = Leaving(along, Rest(rest.state, -rest.direction, -rest.covector, rate), 24.0, np.ones(1))
    assert turned.rest_at(20.0).direction[1] == pytest.approx(-1.0)
    assert turned.rest_at(0.5) is None  # stable


def test_sides__of_a_linear_saddle():
    """Of x' = 2 x, y' = -y, the clearance is x where a trajectory comes within the radius, at y = 1/2."""
    x, t = np.array([1e-3, -2e-4, 0.03]), np.linspace(0.0, 3.0, 3001)
    states = np.stack([x[:, None] * np.exp(2.0 * t), np.broadcast_to(np.exp(-t), (3, len(t)))], axis=-1)
    rest = Rest(np.zeros(2), np.array([1.0, 0.0]), np.array([1.0, 0.0]), 2.0)
    along = SectionMap(lorenz_map().family, Geometry((False, False), (1.0, 1.0)), 1e-9)
    assert _sides(states, rest, 1e-3, 0.5, along) == pytest.approx(4.0 * x, rel=5e-3)
    assert len(_sides(states + 9.0, rest, 1e-3, 0.5, along)) == 0


@pytest.mark.slow
def test_rests_in__only_a_set_that_contains_one():
    along = lorenz_map()
    own = sample_of(along, 28.0, np.array([6.0, 5.0, 23.0]), EFFORT)
    (rest,) = rests_in(along, 28.0, own)
    assert rest.state == pytest.approx(np.zeros(3), abs=1e-9)
    # one trajectory, for one return, passes the origin on one side at most
    once = ConnectionSettings(returns=1)
    states, _ = connections.motion_of(along, 28.0, replace(own, starts=own.points[:1024]), once)
    nearest = np.abs(states).max(axis=2).min(axis=1).argsort()[:8]
    assert not any(rests_in(along, 28.0, replace(own, starts=own.points[k : k + 1]), once) for k in nearest.tolist())
    # and one that ends passes nothing
    assert rests_in(along, 5.0, own, once) == []


@pytest.mark.slow
def test_connection_of__on_another_section(monkeypatch):
    judged, lost = [], connections._lost
    monkeypatch.setattr(connections, "_lost", lambda *given: judged.append(given) or lost(*given))
    along = lorenz_map()
    own = sample_of(along, 26.0, np.array([6.0, 5.0, 23.0]), EFFORT)
    found = connection_of(along, own, (26.0, 24.0, 16.0), EFFORT)
    assert abs(found.contact.value - lorenz_connection()) < found.contact.error + 1e-9 < 3e-9
    assert found.saddle.period == 1
    assert (np.diff(found.means) > 0.0).all()
    assert 24.0579 < found.lives < 24.5
    # the set lives on
    assert "meet no unstable orbit" in connection_of(along, own, (26.0, 25.0, 16.0), EFFORT)
    # lifetimes that are too long show no loss
    ((_, _, edge, contact, far, _, settings),) = judged
    assert far == 16.0
    assert "do not show" in lost(along, own, edge, contact, 23.9, EFFORT, settings)
