"""The panel of bifurcation curves in a real browser: a click on a curve shows the orbit there."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.explorer.data.parameter_plane import parameter_plane
from pipeline.store.run import Run
from tests.pipeline.explorer.bent_resonance import made_line, made_plane
from tests.pipeline.explorer.browser.conftest import served
from tests.pipeline.explorer.browser.test_diagram import drawn

PANEL = ".panel-parameter-plane"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("bent-resonance")
    return made_line(folder), made_plane(folder)


def test_click_on_a_curve(runs: tuple[Path, Path], visit: Callable[..., Any]) -> None:
    """Over the map of another run; the pointer tells the curve, the click shows the orbit at that point."""
    line, plane = runs
    found = parameter_plane(Run.open(line))
    with served(plane, "--curves", str(line)) as address:
        opened = drawn(visit(address))
        page = opened.page
        front = page.locator(f"{PANEL} .frame canvas").nth(1)
        page.locator(f"{PANEL} .legend li", has_text="fold").wait_for()
        assert page.locator(f"{PANEL} .legend li", has_text="attractor").count() >= 1
        front.scroll_into_view_if_needed()
        front.focus()
        page.keyboard.press("ArrowRight")
        page.locator(".panels[data-shown='curve-0-0']").wait_for()
        told = page.locator(f"{PANEL} .readout").text_content()
        assert told.startswith("fold, period 1: frequency = ")
        curve = found["curves"][0]
        values = [float(v) for v in re.findall(r"= ([\d.]+)", told)]
        assert values == pytest.approx([curve["x"][0], curve["y"][0]], rel=1e-6)
        shown = page.locator(".panel-facts dt", has_text="Kind").locator("xpath=following-sibling::dd[1]")
        assert shown.text_content() == "fold, period 1"
        # and by a click, where the pointer is told that it is on a curve
        box = front.bounding_box()
        hits = []
        for k in range(2, 39):
            page.mouse.move(box["x"] + box["width"] * k / 40, box["y"] + box["height"] * 0.5)
            page.wait_for_timeout(20)
            text = page.locator(f"{PANEL} .readout").text_content()
            if text != told and not hits:
                hits.append(k)
                page.mouse.click(box["x"] + box["width"] * k / 40, box["y"] + box["height"] * 0.5)
        assert hits
        page.wait_for_function("!/curve-0-0$/.test(document.querySelector('.panels').dataset.shown)")
        assert page.locator(".panels").get_attribute("data-shown").startswith("curve-")
        assert opened.complaints == []


def test_no_curves(explorer: str, visit: Callable[..., Any]) -> None:
    """A run without curves has no such panel."""
    assert not drawn(visit(explorer)).page.locator(PANEL).is_visible()
