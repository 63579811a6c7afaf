"""Progress of the search for attractors: it does not promise an end that is far away."""

import re

import numpy as np

from pipeline.analysis.attractors.finding import requests
from pipeline.analysis.attractors.finding.requests import EXTENDING, Leg, Polish, answer_all
from pipeline.cli.console import Display
from pipeline.products.reporting import reporting
from pipeline.runs.progress import duration

LEG_S = 1.0


def point(n_legs):
    """Work on a parameter point: an orbit is polished, and cells are extended by some legs."""
    yield Polish(None)
    for _ in range(n_legs):
        yield Leg(np.zeros((1, 1)), np.zeros(1))
    return n_legs


def test_answer_all__tells_no_time_left_that_is_wrong(monkeypatch):
    now, lines = [0.0], []
    display = Display("analyse", terminal=False, clock=lambda: now[0])

    def legs(asked, points, settings):
        for _ in range(4):  # the display shows lines between reports, too
            now[0] += LEG_S / 4
            lines.append((now[0], display._work.line(now[0])))
        return dict.fromkeys(asked)

    monkeypatch.setitem(requests._ANSWERS, Leg, legs)
    monkeypatch.setitem(requests._ANSWERS, Polish, lambda asked, points, settings: dict.fromkeys(asked))
    with reporting(display):
        found = answer_all({(i,): point(100 if i >= 15 else 1) for i in range(20)}, {}, None)
    assert found == {(i,): 100 if i >= 15 else 1 for i in range(20)}
    assert any("15 of 20 (75 %)" in line for _, line in lines)
    for at, line in lines:
        left = re.search(r"([\d.]+) s left", line)
        assert left is None or float(left[1]) > 0.5 * (now[0] - at), line
    assert lines[-1][1] == f"{EXTENDING}: 15 of 20 (75 %), {duration(now[0])} so far"

    def work():
        for spent in (0.0, 0.25, 0.5):
            yield Leg(np.zeros((1, 1)), np.zeros(1), spent)

    told = []
    monkeypatch.setitem(requests._ANSWERS, Leg, lambda asked, points, settings: dict.fromkeys(asked))
    with reporting(lambda what, done, total, expected_s=0.0: told.append((done, total))):
        answer_all({(0,): work(), (1,): work()}, {}, None)
    assert list(dict.fromkeys(told)) == [(0, 2), (0.5, 2), (1.0, 2), (2, 2)]


def test_answer_all__integrates_once_for_all_points_that_wait_for_it(monkeypatch):
    """One point asks for an orbit twice before its leg, one for none, one ends: two calls of the engine."""

    def work(n_polish, n_legs):
        for _ in range(n_polish):
            yield Polish(None)
        for _ in range(n_legs):
            yield Leg(np.zeros((1, 1)), np.zeros(1))
        return n_polish

    called = []

    def legs(asked, points, settings):
        called.append(sorted(asked))
        return dict.fromkeys(asked)

    monkeypatch.setitem(requests._ANSWERS, Leg, legs)
    monkeypatch.setitem(requests._ANSWERS, Polish, lambda asked, points, settings: dict.fromkeys(asked))
    works = {(0,): work(2, 1), (1,): work(0, 2), (2,): work(1, 0)}
    assert answer_all(works, {}, None) == {(0,): 2, (1,): 0, (2,): 1}
    assert called == [[(0,), (1,)], [(1,)]]
