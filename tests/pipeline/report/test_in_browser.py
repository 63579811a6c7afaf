"""Reports in a real browser: they load without complaints and requests, and fit a telephone."""

from __future__ import annotations

import shutil

import pytest

from pipeline.report.page import Outcome, Page, Part, Text, grid_of, picture_of, write
from pipeline.report.verdicts import Verdict

pytestmark = pytest.mark.slow

HOSTILE = "<img src=x onerror=\"document.title='run by a title'\"> a title of some length, without a break"
COMMAND = "magpend plot bifurcation " + "a-directory-with-a-long-name/" * 6


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """Open a page at a width; returns playwright's page and what it complained of or asked for."""
    api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium on this machine")
    path = tmp_path_factory.mktemp("page") / "report.html"
    write(page(), path)
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])

        def open_at(width, **context):
            seen = browser.new_context(viewport={"width": width, "height": 800}, **context).new_page()
            told = []
            seen.on("console", lambda message: told.append(message.text))
            seen.on("pageerror", lambda error: told.append(str(error)))
            seen.on("request", lambda r: told.append(r.url) if not r.url.startswith(("data:", "file:")) else None)
            seen.goto(path.as_uri())
            return seen, told

        yield open_at
        browser.close()


def page():
    from pipeline.plots import style

    figure = style.new_figure(2.0, None)
    figure.subplots().plot([0, 1])
    picture = picture_of(figure, HOSTILE, HOSTILE, COMMAND)
    rows = [{f"column_{k}": 1.0 / (k + 3) for k in range(12)}] * 3
    outcome = Outcome(HOSTILE, "somebody", "0.5 (0.4 to 0.6)", Verdict.NOT_MET, "", True, COMMAND)
    blocks = [Text(HOSTILE), picture, grid_of(rows, HOSTILE, COMMAND), outcome]
    return Page(HOSTILE, blocks, [Part(HOSTILE, blocks), Part("second", blocks)], "magpend")


@pytest.mark.parametrize("width", [1440, 390])
def test_page__loads_and_fits(opened, width):
    seen, told = opened(width)
    assert told == []
    assert seen.title() == HOSTILE
    assert seen.evaluate("document.documentElement.scrollWidth") <= width
    assert seen.evaluate("[...document.images].every(i => i.complete && i.naturalWidth > 500)")
    assert seen.locator("h1").inner_text() == HOSTILE
    seen.keyboard.press("Tab")
    assert seen.evaluate("document.activeElement.textContent") == "To the report"


def test_page__dark_and_printed(opened):
    ground = "getComputedStyle(document.body).backgroundColor"
    light, _ = opened(800, color_scheme="light")
    dark, _ = opened(800, color_scheme="dark")
    assert light.evaluate(ground) != dark.evaluate(ground)
    dark.emulate_media(media="print", color_scheme="light")
    assert dark.evaluate(ground) == "rgb(255, 255, 255)"
    assert not dark.locator("nav").is_visible()
    assert len(dark.pdf()) > 10_000
