"""Imported models have the equations of the papers, and their trajectories those of an independent integration."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core.models import load_model
from magpend_core.models.text.numeric import rates_of
from magpend_core.trajectory import trajectory
from pipeline.importing.importing import import_file
from tests.pipeline.importing.published import PUBLISHED


@pytest.fixture(scope="module", params=PUBLISHED)
def both(request, tmp_path_factory):
    """A published model and its import."""
    one = PUBLISHED[request.param]
    path = tmp_path_factory.mktemp("published") / f"{request.param}.ode"
    path.write_text(one.text)
    return one, import_file(path)


def test_import__has_the_equations_of_the_paper(both):
    one, found = both
    definition = load_model(found.spec.reference).definition
    names = [s.name for s in definition.states]
    omega = found.spec.tables["parameters"].get("omega") if "parameters" in found.spec.tables else None
    assert omega == pytest.approx(one.omega)
    rng = np.random.default_rng(1)
    own = {p.name: definition.presets[0].values[p.name] for p in definition.parameters}
    assert {name: one.parameters[name] for name in own} == own
    for _ in range(20):
        y = np.array(one.start) + rng.normal(0.0, 0.2, len(one.start))
        t = float(rng.uniform(0.0, 1.4))
        clock = [t] if len(names) > len(y) else []
        known = dict(zip(names, [*y, *clock], strict=True))
        known |= {
            "t": t,
            "pi": math.pi,
            "f": (omega or 0.0) / (2 * math.pi),
            "phase": t * (omega or 0.0) / (2 * math.pi),
        }
        rates = rates_of(definition, {**own, **known})
        wanted = one.rates(t, y, one.parameters)
        assert [float(rates[n]) for n in names[: len(y)]] == pytest.approx(list(wanted), rel=1e-12, abs=1e-13)


def test_import__keeps_the_initial_values(both):
    one, found = both
    (points,) = found.spec.tables["initial_conditions"]["points"]
    assert tuple(points)[: len(one.start)] == pytest.approx(one.start)


@pytest.mark.slow
def test_import__has_the_trajectory_of_an_independent_integration(both):
    one, found = both
    model = load_model(found.spec.reference)
    if not model.clock.is_continuous:
        y = [np.array(one.start)]
        for n in range(20):
            y.append(np.array(one.rates(n, y[-1], one.parameters)))
        found = trajectory(model.load(), 1.0, one.start, np.arange(21.0))
        assert found == pytest.approx(np.array(y), abs=1e-8)
        return
    start = [*one.start, 0.0][: len(model.states)]
    frequency = (one.omega or 2 * math.pi) / (2 * math.pi)
    # sampled at ends of steps and periods, where nothing is interpolated
    times = np.arange(1, math.floor(one.time * frequency) + 1) / frequency
    solved = solve_ivp(
        one.rates,
        (0.0, one.time),
        one.start,
        "DOP853",
        times,
        args=(one.parameters,),
        rtol=1e-12,
        atol=1e-13,
        max_step=0.01,
    )
    own = trajectory(model.load(), frequency, start, times, rtol=1e-12, atol=1e-13)
    scale = np.abs(solved.y).max()
    assert own[:, : len(one.start)] / scale == pytest.approx(solved.y.T / scale, abs=1e-8)
