"""Stored critical shocks and edge states for the page, pushes and noisy starts, against DOP853 and runs."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pipeline.explorer import RequestError
from pipeline.explorer.answers import ANSWERS, Query
from pipeline.explorer.copies.content import gather, place_key
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.overlays import attractors, disturbances
from pipeline.explorer.live import starting
from pipeline.store.run import RunDirectory
from tests.pipeline.explorer.small_runs import FRACTAL, HZ, SMOOTH
from tests.pipeline.factories import finished

DAMPING, AMPLITUDES = 0.15, (0.1, 0.2)


@pytest.fixture
def watcher(watch, wells):
    return watch(wells)


def sections(state, amplitude, n):
    """Section points of x'' + .15 x' - x + x^3 = a cos t by DOP853, the first included."""

    def flow(t, y):
        return [y[1], -DAMPING * y[1] + y[0] - y[0] ** 3 + amplitude * np.cos(t)]

    times = 2.0 * np.pi * np.arange(n + 1)
    return solve_ivp(flow, (0.0, times[-1]), state, "DOP853", times, rtol=1e-10, atol=1e-10).y.T


def reached(state, at, wells):
    """Id of the attractor to which DOP853 leads a state."""
    last = sections(state, AMPLITUDES[at], 60)[-1]
    known = attractors(wells, {"amplitude": at})["attractors"]
    distances = {a["id"]: np.abs(np.array(a["section"]) - last).max(axis=1).min() for a in known}
    found = min(distances, key=lambda number: distances[number])
    assert distances[found] < 1e-4
    return found


@pytest.mark.slow
def test_shocks__part_the_motions(wells):
    found = disturbances(wells, {"amplitude": SMOOTH})
    json.dumps(found, allow_nan=False)
    known = attractors(wells, {"amplitude": SMOOTH})["attractors"]
    assert {s["attractor"] for s in found["shocks"]} == {a["id"] for a in known}
    for shock in found["shocks"]:
        way = shock["shortest"]
        start, jump = np.array(way["from"]), np.array(way["jump"])
        assert np.hypot(*jump) == pytest.approx(way["high"])  # both scales are 1
        assert reached(start + 1.0001 * jump, SMOOTH, wells) == way["to"] != shock["attractor"]
        assert reached(start + 0.999 * jump, SMOOTH, wells) == shock["attractor"]


@pytest.mark.slow
def test_shocks__between_sections_are_told_apart(wells):
    shocks = [s for at in (SMOOTH, FRACTAL) for s in disturbances(wells, {"amplitude": at})["shocks"]]
    for shock in shocks:
        assert shock["shortest"]["startable"]
        smallest = shock["smallest"]
        assert smallest["startable"] == (smallest["phase"] == 0.0)
        assert smallest["jump"][0] == 0.0  # a blow changes the rate alone
        assert shock["states"] == ["v"]
    assert {s["smallest"]["phase"] for s in shocks} == {0.0, 0.5}


@pytest.mark.slow
def test_edges__are_orbits_at_their_own_point(wells):
    found = disturbances(wells, {"amplitude": SMOOTH})
    (edge,) = found["edges"]
    assert (edge["between"], edge["kind"], edge["period"]) == (["A", "B"], "periodic orbit", 1)
    (point,) = edge["section"]
    np.testing.assert_allclose(sections(point, 0.1, 1)[1], point, atol=1e-8)
    larger, smaller = (m[0] for m in edge["multipliers"])
    assert larger > 1.0 > smaller
    assert larger * smaller == pytest.approx(np.exp(-DAMPING * 2.0 * np.pi))  # Liouville
    assert found["notes"] == []
    beside = disturbances(wells, {"amplitude": FRACTAL})
    assert beside["edges"] == []
    command = "magpend analyse edge DIR --between A B --at amplitude=VALUE"
    assert beside["notes"] == [f"edge states are not computed here: {command}"]


@pytest.mark.slow
def test_disturbances__refuse_an_index_off_the_axis(wells):
    with pytest.raises(RequestError, match="out of bounds"):
        disturbances(wells, {"amplitude": 2})


@pytest.mark.slow
def test_disturbances__are_answered_and_copied(wells):
    explored, at = ExploredRun.open(wells), {"amplitude": SMOOTH}
    answer = ANSWERS["disturbances"].give(explored, Query({"at.amplitude": str(SMOOTH)}), None)
    assert json.loads(answer.content) == disturbances(explored, at)
    kept = gather(explored).about["answers"]["disturbances"]
    assert place_key(explored, at) in kept["blocks"]


# ---- pushes and noise ----------------------------------------------------------------------------


@pytest.mark.slow
def test_push__leads_where_the_analysis_says(wells, watcher):
    """The page sends the orbit's state plus the impulse."""
    for at, amplitude in enumerate(AMPLITUDES):
        for shock in disturbances(wells, {"amplitude": at})["shocks"]:
            way = shock["shortest"]
            ends = []
            for share in (1.0, 0.99):
                x, v = (a + share * b for a, b in zip(way["from"], way["jump"], strict=True))
                end = watcher.ask(do="start", parameters={"amplitude": amplitude}, frequency=HZ, state={"x": x, "v": v})
                ends.append(end["attractor"])
            assert ends == [way["to"], shock["attractor"]]


def noisy(watcher, **words):
    """Answer to a noisy start, and its section points."""
    start = {"parameters": {"amplitude": 0.2}, "frequency": HZ, "state": {"x": -0.5, "v": 0.25}}
    number = watcher.send(do="start", **start, **words)
    end = watcher.wait(number)
    return end, watcher.sections(number)


NOISY = f"""
kind = "sweep"
model = "duffing"
parameters = {{ preset = "twin-well-periodic", frequency_hz = {HZ} }}
axes.amplitude = {{ values = [0.1, 0.2] }}
initial_conditions.kind = "grid"
initial_conditions.x = {{ start = -0.5, stop = 0.5, num = 2 }}
initial_conditions.v = {{ start = 0.25, stop = 0.75, num = 2 }}
integration = {{ rtol = 1e-9, atol = 1e-9, n_transient = 0, n_keep = 40 }}
noise = {{ seed = 7, strengths = {{ v = 0.05 }} }}
"""


@pytest.mark.slow
def test_noisy_start__has_the_bits_of_a_noisy_run(watcher, tmp_path):
    directory = finished(tmp_path, NOISY)
    cell = RunDirectory.open(directory).cube().sel(amplitude=0.2, x_0=-0.5, v_0=0.25)
    end, section = noisy(watcher, noise=0.05, seed=7, periods=40)
    np.testing.assert_array_equal(section, cell["section"].transpose("period_index", "state").values)
    assert (end["kind"], end["noise"], end["seed"], end["noisy_states"]) == ("done", 0.05, 7, ["v"])
    assert (end["periods"], end["status"]) == (40, "bounded")
    # a noisy motion is never said to have settled
    assert [end[key] for key in ("label", "colour", "attractor", "number", "period")] == [None] * 5
    again, other = noisy(watcher, noise=0.05, seed=7, periods=40)[1], noisy(watcher, noise=0.05, seed=8, periods=40)[1]
    np.testing.assert_array_equal(again, section)
    assert np.abs(other - section).max() > 0.05


@pytest.mark.slow
def test_noisy_start__without_noise_is_the_plain_one(watcher):
    weak, plain = noisy(watcher, noise=1e-12, periods=2)[1], sections([-0.5, 0.25], 0.2, 2)[1:]
    np.testing.assert_allclose(weak, plain, atol=1e-4)  # steps of a 256th of a period
    assert noisy(watcher, noise=0.0)[0]["attractor"] is not None


@pytest.mark.slow
def test_noisy_start__is_refused_in_a_sentence(watcher, monkeypatch):
    assert "noise" in noisy(watcher, noise=-1.0)[0]["error"]
    assert "seed" in noisy(watcher, noise=0.1, seed=-1)[0]["error"]
    monkeypatch.setattr(starting, "LARGEST_CHANGE", 1e-12)
    assert "too few for this motion" in noisy(watcher, noise=0.1)[0]["error"]


@pytest.mark.slow
def test_noisy_start__takes_shorter_steps_where_it_must(watcher, monkeypatch):
    plain = noisy(watcher, noise=0.05, periods=1)[0]
    monkeypatch.setattr(starting, "LARGEST_CHANGE", plain["step_error"] / 1.5)
    finer = noisy(watcher, noise=0.05, periods=1)[0]
    assert plain["steps_per_period"] == starting.STEPS_PER_PERIOD
    assert finer["steps_per_period"] > starting.STEPS_PER_PERIOD
    assert finer["step_error"] <= starting.LARGEST_CHANGE
    # also later on the way
    monkeypatch.setattr(starting, "LARGEST_CHANGE", plain["step_error"] / 100.0)
    monkeypatch.setattr(starting._NoisyPath, "choose_steps", lambda path, job: None)
    assert "256 steps in a period are too few" in noisy(watcher, noise=0.05, periods=40)[0]["error"]
