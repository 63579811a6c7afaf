"""Pushes, stored shocks, noisy starts and bifurcation curves in a real browser."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.explorer.data.overlays import disturbances
from pipeline.explorer.data.parameter_plane import parameter_plane
from pipeline.results.ragged import dense
from pipeline.runs.derive import stored
from pipeline.store.run import RunDirectory
from tests.pipeline.explorer.browser.conftest import drawn, served
from tests.pipeline.explorer.browser.test_panels import QUIET, choose, note_of
from tests.pipeline.explorer.small_runs import SMOOTH

pytestmark = pytest.mark.slow

RATE = "x\u0307"
"""The velocity as the page writes it."""


@pytest.fixture(scope="module")
def address(wells: Path) -> Iterator[str]:
    with served(wells) as found:
        yield found


def pressed(page: Any, name: str) -> None:
    page.get_by_role("button", name=name).click()


def test_push__is_dragged_and_tried_and_shaken(visit: Callable[..., Any], address: str, wells: Path) -> None:
    found = dense(stored(RunDirectory.open(wells), "attractors"), points=True)
    assert found is not None
    ids = found["attractor_id"].transpose("amplitude", "x_0", "v_0").values.ravel()
    opened = drawn(visit(address, **QUIET))
    page = opened.page
    choose(opened, int(np.flatnonzero(ids == 0)[0]))
    shocks, edges = (disturbances(wells, {"amplitude": SMOOTH})[key] for key in ("shocks", "edges"))
    (shock,) = (s["shortest"] for s in shocks if s["attractor"] == 0)

    # what is stored is listed
    listed = page.locator(".disturbances > li")
    listed.nth(2).wait_for()
    texts = listed.all_text_contents()
    assert f"{shock['high']:.4g} of the scales" in texts[1]
    assert f"leads to {shock['leads_to']}" in texts[1]
    for value, _ in edges[0]["multipliers"]:
        assert f"{value:.4g}" in texts[2]
    assert "Between A and B: periodic orbit, period 1" in texts[2]

    # the stored shock leads away
    page.get_by_role("button", name=re.compile("Shortest way out .*: try it")).click()
    assert f"is led to {shock['leads_to']}:" in note_of(opened, "plane", "Pushed by .* after")

    # a shorter one, in numbers, does not
    for label, value in zip(("Impulse x", f"Impulse {RATE}"), shock["jump"], strict=True):
        page.get_by_label(label, exact=True).fill(repr(0.9 * value))
        page.get_by_label(label, exact=True).press("Tab")
    pressed(page, "Integrate after the push")
    assert "comes back to A:" in note_of(opened, "plane", "comes back")

    # dragged, the impulse ends under the pointer
    frame = page.locator(".panel-plane .frame")
    frame.scroll_into_view_if_needed()
    box = frame.bounding_box()
    page.mouse.move(box["x"] + 300, box["y"] + 90)
    page.mouse.down()
    page.mouse.move(box["x"] + 200, box["y"] + 120, steps=3)
    under = page.locator(".panel-plane .readout").text_content()
    page.mouse.up()
    told = note_of(opened, "plane", "Pushed by .* after")
    place = [float(v.replace("−", "-")) for v in re.findall(r"= (−?[\d.]+)", under)]
    impulse = [float(page.get_by_label(label, exact=True).input_value()) for label in ("Impulse x", f"Impulse {RATE}")]
    np.testing.assert_allclose(np.array(shock["from"]) + impulse, place, atol=2e-4)
    assert told.startswith(f"Pushed by x {'+' if impulse[0] > 0 else '−'}{abs(impulse[0]):.4g}"[:16])

    # with noise no attractor is named
    page.get_by_label(f"Noise on {RATE}").fill("0.05")
    pressed(page, "Integrate after the push")
    told = note_of(opened, "plane", "no attractor is named")
    assert told.startswith("Noisy: strength 0.05")
    assert "seed 0" in told
    page.get_by_label(f"Noise on {RATE}").fill("0")
    pressed(page, "Integrate this start")
    assert "ends on" in note_of(opened, "plane", "This start ends on")
    assert opened.complaints == []


PANEL = ".panel-parameter-plane"


def test_click_on_a_curve(bent: tuple[Path, Path], visit: Callable[..., Any]) -> None:
    """Over the map of another run; the pointer tells the curve, the click shows the orbit at that point."""
    line, plane = bent
    found = parameter_plane(RunDirectory.open(line))
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


def test_click_in_an_atlas(plane_with_atlas: Path, visit: Callable[..., Any]) -> None:
    """In a region its attractors and an orbit are shown, at a cross the reason and both cells; curves as ever."""
    plane = parameter_plane(RunDirectory.open(plane_with_atlas))
    found = plane["atlas"]
    with served(plane_with_atlas) as address:
        opened = drawn(visit(address))
        page = opened.page
        panel = page.locator(PANEL)
        assert panel.locator("h2").text_content() == "Atlas of two parameters"
        panel.locator(".legend li", has_text="not explained").wait_for()
        front = panel.locator(".frame canvas").nth(1)
        front.scroll_into_view_if_needed()
        box = front.bounding_box()

        # in the middle of the plane lies a region; the nearest point with cells is shown
        place = {"x": 56 + 0.5 * (box["width"] - 68), "y": 8 + 0.45 * (box["height"] - 44)}
        page.mouse.move(box["x"] + place["x"], box["y"] + place["y"])
        told = panel.locator(".readout").text_content()
        assert told.startswith("Region ")
        region = int(told.split()[1].rstrip(":"))
        front.click(position=place)
        panel.get_by_text("the nearest point with cells").wait_for()
        assert panel.locator(".atlas-told li").all_text_contents() == found["regions"][region]["attractors"]
        page.locator(".panels[data-shown]").wait_for()
        cell, point = (int(v) for v in page.locator(".panels").get_attribute("data-shown").split("-"))
        assert point == 0
        values = [float(v) for v in re.findall(r"= ([\d.]+)", panel.locator(".atlas-told").text_content())]
        assert values[0] == pytest.approx(1.1)
        assert cell // 12 == 1

        # a change that is not explained: both cells
        mark = found["marks"][0]
        panel.get_by_label("Atlas", exact=True).select_option("mark:0")
        assert mark["why"][1:] in panel.locator(".atlas-told").text_content()
        for k, one in enumerate(mark["cells"]):
            panel.locator(".atlas-told button").nth(k).click()
            page.locator(f".panels[data-shown='{one['cell']}-0']").wait_for()
        assert f"at.b={mark['cells'][1]['at']['b']}" in page.url or mark["cells"][1]["at"]["b"] == 0

        # and from a point of a curve back to the same cell
        front.focus()
        page.keyboard.press("ArrowRight")
        page.locator(".panels[data-shown^='curve-']").wait_for()
        assert not panel.locator(".atlas-told button").count()
        panel.get_by_label("Atlas", exact=True).select_option("mark:0")
        page.locator(f".panels[data-shown='{mark['cells'][0]['cell']}-0']").wait_for()
        assert opened.complaints == []
