"""The diagram in a real browser: the points drawn are those of the cube, and what is done to it shows."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from pipeline.store.run import open_run
from tests.pipeline.explorer.browser.conftest import HOSTILE, drawn, reused, served, until
from tests.pipeline.factories import finished

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cube(looked_at: Path) -> xr.Dataset:
    """Sections of the run whose page is looked at: cells in C order, then sections, then states."""
    return open_run(looked_at).load()


@pytest.fixture(scope="module")
def first(lasting: Callable[..., Any], explorer: str) -> Any:
    """The page once its diagram is drawn."""
    return drawn(lasting(explorer))


@pytest.fixture
def page(first: Any) -> Iterator[Any]:
    """The page as it begins, loaded once for all who use this."""
    with reused(first):
        yield first


@pytest.fixture
def own(visit: Callable[..., Any], explorer: str) -> Any:
    """A page for one test alone."""
    return drawn(visit(explorer))


def settled(page: Any) -> None:
    """Wait until nothing moves: the history is written half a second after the last change."""
    page.wait_for_timeout(700)


def state_of(page: Any) -> dict[str, Any]:
    return dict(page.evaluate("window.magpend.state.get()"))


def points_of(cube: xr.Dataset, state: str = "psi1") -> tuple[np.ndarray, np.ndarray]:
    """Frequency and value of every cell's sections, cells in C order."""
    dims = cube["status"].dims
    values = cube["section"].sel(state=state).transpose(*dims, "period_index").values
    frequency = np.broadcast_to(cube["frequency"].values[:, None], (values.shape[0], int(np.prod(values.shape[1:-1]))))
    assert dims[0] == "frequency"
    return frequency.ravel(), values.reshape(-1, values.shape[-1])


def places_of(page: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Places on the page [px] of values in the diagram, from the page's own box and window."""
    box, (x0, x1, y0, y1) = page.evaluate("[magpend.diagram.box, magpend.diagram.window]")
    around = page.locator(".diagram").bounding_box()
    left = around["x"] + box["left"] + (x - x0) / (x1 - x0) * box["width"]
    top = around["y"] + box["top"] + (y1 - y) / (y1 - y0) * box["height"]
    return np.stack([left, top], axis=-1)


def click_on(page: Any, place: np.ndarray) -> None:
    page.mouse.click(float(place[0]), float(place[1]))
    until(page, "magpend.state.get().selected !== null")


def nearest(places: np.ndarray, to: np.ndarray) -> tuple[float, int, int]:
    """Least distance [px] of the points of all cells to a place, and whose it is."""
    distances = np.linalg.norm(places - to, axis=-1)
    cell, point = np.unravel_index(int(distances.argmin()), distances.shape)
    return float(distances.min()), int(cell), int(point)


def test_diagram__loads_without_complaints_and_asks_nobody_else(page: Any, cube: xr.Dataset) -> None:
    n_cells, n_keep = cube["status"].size, cube.sizes["period_index"]
    assert f"{n_cells * n_keep:,} points of {n_cells} cells" in page.page.locator(".facts-line").inner_text()
    settled(page.page)
    assert page.complaints == []
    assert page.outside == []
    assert not page.page.locator(".panel-parameter-plane").is_visible()  # a run without curves
    # a hostile title stays text
    assert page.page.locator("h1").inner_text() == HOSTILE
    assert page.page.title().startswith(HOSTILE)
    assert page.page.locator("img").count() == 0


def test_diagram__bitmap_has_the_cubes_points_and_nothing_else(page: Any, cube: xr.Dataset) -> None:
    x, y = points_of(cube)
    pixels = page.page.evaluate("""async () => {
        const { diagram } = magpend, { box, window } = diagram;
        const size = { width: Math.round(box.width), height: Math.round(box.height) };
        const asked = { bounds: window, ...size, scale: 1, keep: true };
        const { bitmap } = await diagram.points.ask("render", asked);
        const canvas = new OffscreenCanvas(size.width, size.height), ctx = canvas.getContext("2d");
        ctx.drawImage(bitmap, 0, 0);
        const { data } = ctx.getImageData(0, 0, size.width, size.height), alpha = [];
        for (let k = 3; k < data.length; k += 4) if (data[k]) alpha.push((k - 3) / 4);
        return { ...size, window, alpha };
    }""")
    x0, x1, y0, y1 = pixels["window"]
    column = np.floor((x - x0) / (x1 - x0) * pixels["width"]).astype(int)[:, None]
    row = np.floor((y1 - y) / (y1 - y0) * pixels["height"]).astype(int)
    drawn_at = np.zeros((pixels["height"], pixels["width"]), bool)
    drawn_at.ravel()[pixels["alpha"]] = True
    assert drawn_at[row, np.broadcast_to(column, row.shape)].all()
    near = np.zeros_like(drawn_at)
    for r, c in set(zip(row.ravel().tolist(), np.broadcast_to(column, row.shape).ravel().tolist(), strict=True)):
        near[max(0, r - 4) : r + 5, max(0, c - 4) : c + 5] = True
    assert not (drawn_at & ~near).any()


def test_diagram__a_click_selects_the_nearest_point_of_the_cube(page: Any, cube: xr.Dataset) -> None:
    x, y = points_of(cube)
    places = places_of(page.page, x[:, None] + 0 * y, y)
    target = places[-1, 3] + np.array([3.0, 2.0])
    least, _, _ = nearest(places, np.round(target))
    click_on(page.page, np.round(target))
    selected = state_of(page.page)["selected"]
    chosen = places[selected["cell"], selected["point"]]
    assert np.linalg.norm(chosen - np.round(target)) <= least + 1e-6
    told = page.page.locator("p.sr-only[role=status]").inner_text()
    assert f"cell {selected['cell']}, section {selected['point'] + 1}" in told
    shown = float(re.search(r"= (−?[\d.]+) rad", told).group(1).replace("−", "-"))  # type: ignore[union-attr]
    assert shown == pytest.approx(y[selected["cell"], selected["point"]], rel=1e-4)
    # the pointer tells values of the cube
    page.page.mouse.move(*places[0, 0].tolist())
    page.page.wait_for_selector(".tip:not([hidden])")
    lines = page.page.locator(".tip > div").all_inner_texts()
    assert float(lines[0].split("= ")[1].split()[0]) == pytest.approx(x[0])
    hovered = float(lines[1].split("= ")[1].split()[0].replace("−", "-"))
    assert np.abs(y[x == x[0]] - hovered).min() <= 1e-4 * abs(hovered)
    page.page.mouse.move(5, 5)
    page.page.wait_for_selector(".tip", state="hidden")


def test_diagram__address_restores_the_view(
    own: Any, visit: Callable[..., Any], explorer: str, cube: xr.Dataset
) -> None:
    one = own.page
    one.select_option("select[name=y]", "psi2_dot")
    until(one, "magpend.diagram.vertical.name === 'psi2_dot' && !document.querySelector('.diagram[aria-busy]')")
    one.select_option("select[name=colour]", "attractor")
    one.locator(".legend-entry").first.click()
    one.locator(".legend-entry").first.click()
    one.locator(".legend-entry").last.click()
    x, y = points_of(cube, "psi2_dot")
    places = places_of(one, x[:, None] + 0 * y, y)
    one.mouse.move(*places[0, 0].tolist())
    for _ in range(3):
        one.mouse.wheel(0, -200)
    settled(one)
    one.locator(".diagram").focus()
    one.keyboard.press("Enter")
    until(one, "magpend.state.get().selected !== null")
    settled(one)
    there = state_of(one)
    assert there["window"] is not None
    assert there["hidden"]["attractor"]
    assert there["y"] == "psi2_dot"
    other = drawn(visit(one.url)).page
    assert state_of(other) == there
    one.keyboard.press("Escape")
    settled(one)
    one.go_back()
    settled(one)
    assert state_of(one) == there


def test_diagram__keys_zoom_move_walk_and_tell(page: Any, cube: xr.Dataset) -> None:
    one, says = page.page, page.page.locator("p.sr-only[role=status]")
    one.locator(".diagram").focus()
    full = one.evaluate("magpend.diagram.window")
    one.keyboard.press("+")
    inside = one.evaluate("magpend.diagram.window")
    assert full[0] < inside[0] < inside[1] < full[1]
    assert full[2] < inside[2] < inside[3] < full[3]
    one.keyboard.press("ArrowRight")
    moved = one.evaluate("magpend.diagram.window")
    assert moved[0] > inside[0]
    assert moved[1] - moved[0] == pytest.approx(inside[1] - inside[0])
    one.keyboard.press("0")
    assert one.evaluate("magpend.diagram.window") == full
    one.keyboard.press("Enter")
    until(one, "magpend.state.get().selected !== null")
    x, y = points_of(cube)
    begin = state_of(one)["selected"]
    one.keyboard.press("ArrowRight")
    until(one, f"magpend.state.get().selected.cell !== {begin['cell']}")
    after = state_of(one)["selected"]
    grid = np.unique(x)
    assert x[after["cell"]] == grid[np.searchsorted(grid, x[begin["cell"]]) + 1]
    column = y[x == x[after["cell"]]]
    least = np.abs(column - y[begin["cell"], begin["point"]]).min()
    assert abs(y[after["cell"], after["point"]] - y[begin["cell"], begin["point"]]) == pytest.approx(least)
    assert f"cell {after['cell']}," in says.inner_text()
    one.keyboard.press("Escape")
    assert state_of(one)["selected"] is None
    one.keyboard.press("Tab")
    assert one.evaluate("document.activeElement.closest('.diagram')") is None


def test_diagram__a_lost_server_is_said_and_tried_again(own: Any) -> None:
    one = own.page
    one.route("**/api/diagram*", lambda route: route.abort())
    one.select_option("select[name=y]", "psi2")
    one.wait_for_selector(".banner:not([hidden])")
    assert "The server does not answer" in one.locator(".banner").inner_text()
    one.unroute("**/api/diagram*")
    one.get_by_role("button", name="Try again").click()
    one.wait_for_selector(".banner", state="hidden")
    assert one.evaluate("magpend.diagram.vertical.name") == "psi2"
    # a refusal is shown as the server says it
    asked = "magpend.source.diagram({ x: 'frequency', y: 'nothing', at: {} })"
    answer = one.evaluate(f"{asked}.catch((error) => error.message)")
    assert "nothing" in answer
    # the switch of colours is kept
    one.locator(".theme-switch").click()
    assert one.evaluate("document.documentElement.dataset.theme") == "dark"
    assert "dark" not in one.url
    one.reload()
    one.wait_for_selector(".diagram[data-drawn]")
    assert one.evaluate("document.documentElement.dataset.theme") == "dark"


CONTRAST = """() => {
    const parse = (colour) => colour.match(/[\\d.]+/g).map(Number);
    const linear = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
    const weights = [0.2126, 0.7152, 0.0722];
    const light = (rgb) => weights.reduce((sum, weight, k) => sum + weight * linear(rgb[k] / 255), 0);
    const ground = (element) => getComputedStyle(element).backgroundColor;
    const found = [];
    for (const element of document.querySelectorAll("h1, h2, p, button, summary, label, select, .run-name")) {
        if (!element.checkVisibility() || !element.textContent.trim()) continue;
        let behind = element;
        while (behind.parentElement && ground(behind) === "rgba(0, 0, 0, 0)") behind = behind.parentElement;
        const pair = [getComputedStyle(element).color, ground(behind)].map((c) => light(parse(c)) + 0.05);
        found.push([element.textContent.trim().slice(0, 40), Math.max(...pair) / Math.min(...pair)]);
    }
    return found;
}"""

SMALL_TARGETS = """() => [...document.querySelectorAll("button, select, summary")]
    .filter((element) => element.checkVisibility())
    .map((element) => [element.textContent, element.getBoundingClientRect()])
    .filter(([, { width, height }]) => Math.min(width, height) < 43.5)
    .map(([text, { width, height }]) => [text, width, height])"""


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_diagram__texts_can_be_read(page: Any, scheme: str) -> None:
    one = page.page
    one.emulate_media(color_scheme=scheme)
    paper = one.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (int(re.findall(r"\d+", paper)[0]) < 128) == (scheme == "dark")
    found = one.evaluate(CONTRAST)
    # 4.5 is level AA of the guidelines on accessible content (WCAG 2.2, 1.4.3)
    assert len(found) > 8
    assert [entry for entry in found if entry[1] < 4.5] == []


def test_diagram__narrow_pages_have_tabs_and_large_targets(
    visit: Callable[..., Any], explorer: str, cube: xr.Dataset
) -> None:
    one = drawn(visit(explorer, width=390, height=844, has_touch=True, reduced_motion="reduce")).page
    assert one.evaluate("document.documentElement.scrollWidth") <= 390
    assert one.evaluate(SMALL_TARGETS) == []
    x, y = points_of(cube)
    place = places_of(one, x[:1], y[0, :1])[0]
    one.touchscreen.tap(*place.tolist())
    until(one, "magpend.state.get().selected !== null")
    one.locator("#tab-orbit").click()
    assert one.locator(".diagram").is_hidden()
    assert one.locator(".side-column").is_visible()
    assert json.loads(one.evaluate("JSON.stringify(magpend.state.get().panel)")) == "orbit"
    assert one.evaluate("document.documentElement.scrollWidth") <= 390
    one.locator(".panels[data-shown]").wait_for()
    heights = one.evaluate("""() => [...document.querySelectorAll(".panels :is(button, select, summary)")]
        .map((e) => e.getBoundingClientRect()).filter((r) => r.width > 0).map((r) => r.height)""")
    assert min(heights) >= 44
    one.get_by_role("button", name="Play").tap()
    one.get_by_role("button", name="Pause").wait_for()


def test_diagram__zoom_here_gives_the_window_as_a_specification_and_runs_it(page: Any, looked_at: Path) -> None:
    one = page.page
    one.evaluate("magpend.diagram.moveTo([2.22, 2.28, ...magpend.diagram.window.slice(2)])")
    settled(one)
    menu = one.locator(".toolbar summary", has_text="Zoom here")
    menu.click()
    with one.expect_download() as waiting:
        one.get_by_role("button", name="Download its specification").click()
    spec = tomllib.loads(Path(waiting.value.path()).read_text("utf-8"))
    axis = spec["axes"]["frequency_hz"]
    assert (axis["start"], axis["stop"]) == pytest.approx((2.22, 2.28))
    before = set(looked_at.parent.iterdir())
    menu.click()
    one.get_by_role("button", name="Run it here").click()
    until(one, "document.querySelector('.progress-line')?.textContent.includes('Computed')")
    (new,) = {path for path in looked_at.parent.iterdir() if path.is_dir()} - before
    assert new.name in one.locator(".progress-line").inner_text()
    computed = open_run(new)["frequency"].values
    assert (computed.min(), computed.max()) == pytest.approx((2.22, 2.28))
    assert page.complaints == []


def test_diagram__of_a_run_that_is_not_complete_says_so_and_other_axes_are_chosen(
    visit: Callable[..., Any], made: Any
) -> None:
    total = made.plan.n_cells
    with served(made.info.directory) as address:
        opened = drawn(visit(address))
        page, note, inside = (opened.page, opened.page.locator(".note-line"), opened.page.locator(".diagram-note"))
        assert f"{total} of {total} cells are pending" in note.inner_text()
        assert "No cell of this run is computed yet" in inside.inner_text()
        made.commit(0)
        note.get_by_role("button", name="Look again").click()
        page.wait_for_selector(".diagram-note", state="hidden")
        drawn(opened)
        assert f"{total - made.plan.cells_in(0)} of {total} cells are pending" in note.inner_text()
        for index in range(1, made.plan.n_tasks):
            made.commit(index)
        note.get_by_role("button", name="Look again").click()
        note.wait_for(state="detached")
        _choose_other_axes(drawn(opened).page, open_run(made.info.directory).load())
        assert opened.complaints == []


def _choose_other_axes(page: Any, cube: xr.Dataset) -> None:
    """Another value of the other axis, then that axis itself: what is drawn is the cube's part."""
    shown, at = state_of(page)["x"], state_of(page)["at"]
    (other,) = at
    page.select_option(f"select[name='at.{other}']", "1")
    drawn_of = "[...magpend.diagram.data.cell].join()"
    part = cube.assign(number=(cube["status"].dims, np.arange(cube["status"].size).reshape(cube["status"].shape)))
    cells = part["number"].isel({other: 1}).transpose(shown, ...).values.ravel()
    until(page, f"{drawn_of} === '{','.join(map(str, cells))}'")
    page.select_option("select[name=x]", other)
    until(page, f"magpend.diagram.data.attrs.x === '{other}'")
    assert state_of(page)["at"] == {shown: 0}
    assert page.evaluate("[...magpend.diagram.data.x]") == sorted(cube[other].values.tolist())


COLOURED = """(() => {
    const canvas = document.querySelector('.strip[aria-label=Fractions]:not([hidden]) canvas');
    if (!canvas?.width) return 0;
    const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
    let n = 0;
    for (let k = 0; k < data.length; k += 4) {
        const [r, g, b, a] = data.subarray(k, k + 4);
        n += a > 128 && Math.max(r, g, b) - Math.min(r, g, b) > 60;
    }
    return n;
})()"""
"""Number of coloured pixels in the strip of fractions: axes and texts are grey."""


def test_fractions__are_drawn_if_their_answer_comes_before_the_diagrams(own: Any) -> None:
    held, opened = [], own
    opened.page.route("**/api/diagram*", lambda route: held.append(route))
    opened.page.reload()
    until(opened.page, "document.querySelector('.strip[aria-label=Fractions]:not([hidden]) canvas')?.width > 300")
    opened.page.wait_for_timeout(100)  # the strip is painted in the next frame
    held.pop().continue_()
    drawn(opened)
    until(opened.page, f"{COLOURED} > 200")
    assert opened.complaints == []


def test_diagram__shows_the_drives_rate_as_omega(visit: Callable[..., Any], tmp_path: Path) -> None:
    """The unit, the numbers beside the diagram and those at the pointer are those of the specification."""
    run = finished(
        tmp_path,
        """
kind = "sweep"
model = "duffing"
parameters.preset = "twin-well-periodic"
axes = { omega = { values = [0.9, 1.0, 1.1] }, amplitude = { values = [0.2, 0.25] } }
initial_conditions = { kind = "list", points = [[1.0, 0.0]] }
integration = { rtol = 1e-7, atol = 1e-7, n_transient = 100, n_keep = 4 }
""",
    )
    with served(run) as address:
        page = drawn(visit(address)).page
        names = page.locator('select[name="x"] option').all_inner_texts()
        assert names == ["ω [rad/s]", "amplitude [m/s2]"]
        said = page.evaluate(
            "window.magpend.diagram.described({ index: 0, point: 0, x: 1.1 / (2 * Math.PI), y: 0 })[0]"
        )
        assert said == "ω = 1.1 rad/s"
        page.locator('select[name="x"]').select_option("amplitude")
        shown = page.locator('select[name="at.frequency"] option').all_inner_texts()
        assert shown == ["0.9 rad/s", "1 rad/s", "1.1 rad/s"]
