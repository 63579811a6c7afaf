"""Reports in a real browser: they load without complaints and requests, and fit a telephone."""

from __future__ import annotations

import pytest

from pipeline.plots import style
from pipeline.report.page import Outcome, Page, Part, Text, grid_of, picture_of, write
from pipeline.report.verdicts import Verdict

pytestmark = pytest.mark.slow

HOSTILE = "<img src=x onerror=\"document.title='run by a title'\"> a title of some length, without a break"
COMMAND = "magpend plot bifurcation " + "a-directory-with-a-long-name/" * 6


@pytest.fixture
def report(tmp_path):
    """Address of a report of hostile texts."""
    path = tmp_path / "report.html"
    write(page(), path)
    return path.as_uri()


def page():
    figure = style.new_figure(2.0, None)
    figure.subplots().plot([0, 1])
    picture = picture_of(figure, HOSTILE, HOSTILE, COMMAND)
    rows = [{f"column_{k}": 1.0 / (k + 3) for k in range(12)}] * 3
    outcome = Outcome(HOSTILE, "somebody", "0.5 (0.4 to 0.6)", Verdict.NOT_MET, "", True, COMMAND)
    blocks = [Text(HOSTILE), picture, grid_of(rows, HOSTILE, COMMAND), outcome]
    return Page(HOSTILE, blocks, [Part(HOSTILE, blocks), Part("second", blocks)], "magpend")


@pytest.mark.parametrize("width", [1440, 390])
def test_page__loads_and_fits(visit, report, width):
    opened = visit(report, width=width)
    seen = opened.page
    assert opened.complaints + opened.outside == []
    assert seen.title() == HOSTILE
    assert seen.evaluate("document.documentElement.scrollWidth") <= width
    assert seen.evaluate("[...document.images].every(i => i.complete && i.naturalWidth > 500)")
    assert seen.locator("h1").inner_text() == HOSTILE
    seen.keyboard.press("Tab")
    assert seen.evaluate("document.activeElement.textContent") == "To the report"


def test_page__dark_and_printed(visit, report):
    seen, grounds = visit(report, color_scheme="light").page, []
    for media in ({"color_scheme": "light"}, {"color_scheme": "dark"}, {"media": "print", "color_scheme": "light"}):
        seen.emulate_media(**media)
        grounds.append(seen.evaluate("getComputedStyle(document.body).backgroundColor"))
    assert grounds[0] != grounds[1]
    assert grounds[2] == "rgb(255, 255, 255)"
    assert not seen.locator("nav").is_visible()
    assert len(seen.pdf()) > 10_000
