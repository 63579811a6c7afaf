"""The panels in a real browser: what they show is in the cube, what they compute ends as it says."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import xarray as xr

from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.data.orbits import orbit
from pipeline.layout.vocabulary import letter
from pipeline.results.ragged import dense
from pipeline.runs.derive import stored
from pipeline.store.run import RunDirectory, open_run
from tests.pipeline.explorer.browser.conftest import WAIT_MS, drawn, reused, served
from tests.pipeline.explorer.browser.test_diagram import click_on, places_of

pytestmark = pytest.mark.slow

QUIET = {"reduced_motion": "reduce"}  # no drawing moves unasked, so that time stands at the section


@pytest.fixture(scope="module")
def cube(looked_at: Path) -> xr.Dataset:
    return open_run(looked_at).load()


@pytest.fixture(scope="module")
def owners(looked_at: Path, cube: xr.Dataset) -> np.ndarray:
    """Attractor of each cell, in C order."""
    found = dense(stored(RunDirectory.open(looked_at), "attractors"), points=True)
    assert found is not None
    return found["attractor_id"].transpose(*cube["status"].dims).values.ravel()


@pytest.fixture(scope="module")
def section(cube: xr.Dataset) -> np.ndarray:
    """Section points of all cells, in C order."""
    found = cube["section"].transpose(*cube["status"].dims, "period_index", "state").values
    return found.reshape(-1, *found.shape[-2:])


@pytest.fixture
def page(visit: Callable[..., Any], explorer: str) -> Any:
    """A page for one test alone: its panels keep what was done with them."""
    return drawn(visit(explorer, **QUIET))


@pytest.fixture(scope="module")
def first(lasting: Callable[..., Any], explorer: str) -> Any:
    return drawn(lasting(explorer, **QUIET))


@pytest.fixture
def shown(first: Any) -> Iterator[Any]:
    """A page for tests that select something and look at it, loaded once."""
    with reused(first):
        yield first


def cells_of(cube: xr.Dataset) -> list[dict[str, float]]:
    """Start and frequency of every cell, in C order."""
    status = cube["status"]
    mesh = np.meshgrid(*(cube[d].values for d in status.dims), indexing="ij")
    columns = {d: grid.ravel() for d, grid in zip(status.dims, mesh, strict=True)}
    return [{d: float(column[i]) for d, column in columns.items()} for i in range(status.size)]


def choose(opened: Any, cell: int, point: int = 0) -> None:
    """Select a point of a cell as the address does, and wait for its orbit."""
    opened.page.evaluate("(selected) => magpend.state.set({ selected })", {"cell": cell, "point": point})
    opened.page.locator(f".panels[data-shown='{cell}-{point}']").wait_for()


def fact(opened: Any, name: str) -> str:
    """What stands beside a name in the card of facts."""
    return str(
        opened.page.locator(".panel-facts dt", has_text=name).locator("xpath=following-sibling::dd[1]").text_content()
    )


def numbers(text: str) -> list[float]:
    return [float(found.replace("−", "-")) for found in re.findall(r"= (−?[\d.]+(?:e−?\d+)?)", text)]


def note_of(opened: Any, panel: str, pattern: str) -> str:
    """Wait until a panel says something, and return what it says."""
    place = opened.page.locator(f".panel-{panel} .note", has_text=re.compile(pattern))
    place.first.wait_for(timeout=WAIT_MS)
    return str(place.first.text_content())


def alone(cube: xr.Dataset, owners: np.ndarray, section: np.ndarray) -> int:
    """A cell of period 1 whose points lie farthest from those of other attractors at its frequency."""
    frequency = np.array([cell["frequency"] for cell in cells_of(cube)])
    distances = {}
    for i in np.flatnonzero((cube["orbit_period"].values.ravel() == 1) & (owners >= 0)):
        others = section[(frequency == frequency[i]) & (owners != owners[i]), :, 0]
        distances[int(i)] = np.abs(others - section[i, 0, 0]).min() if others.size else np.inf
    return max(distances, key=lambda i: distances[i])


def test_click__shows_the_orbit_of_the_cube(shown, cube, owners, section):
    cell = alone(cube, owners, section)
    own = cells_of(cube)[cell]
    shown.page.evaluate("magpend.state.set({ y: 'psi1' })")
    x, y = np.array([own["frequency"]]), section[cell, :1, 0]
    click_on(shown.page, places_of(shown.page, x, y)[0])
    shown.page.locator(".panels[data-shown]").wait_for()
    selected = shown.page.evaluate("magpend.state.get().selected")
    point = section[selected["cell"], selected["point"]]
    assert owners[selected["cell"]] == owners[cell]
    assert abs(point[0] - y[0]) < 1e-3  # a pixel
    assert float(fact(shown, "frequency")) == pytest.approx(own["frequency"])
    assert fact(shown, "Period") == "1 drive period"
    assert fact(shown, "Attractor").startswith(f"{letter(int(owners[selected['cell']]))}:")
    told = numbers(shown.page.locator(".panel-series output").text_content())
    # four significant digits, at the section's own instant; the angles of the cube are within half a turn
    assert told[0] == 0.0
    assert told[1:] == pytest.approx(point.tolist(), rel=1e-3)
    shown.page.locator(".panel-facts summary", has_text="Starts that lead here").click()
    first = numbers(shown.page.locator(".panel-facts details li").first.text_content())
    leads = [i for i in np.flatnonzero(owners == owners[cell]) if cells_of(cube)[i]["frequency"] == own["frequency"]]
    starts = [[cells_of(cube)[i]["psi1_0"], cells_of(cube)[i]["psi2_0"]] for i in leads]
    assert any(first[:2] == pytest.approx(start, abs=1e-3) for start in starts)
    # compiled for, if nobody has looked yet
    shown.page.locator(".panel-multipliers .value").nth(3).wait_for()
    assert shown.complaints == []
    assert shown.outside == []


def test_spectrum__of_a_closed_orbit_has_its_lines(shown, looked_at, cube, owners, section):
    cell = alone(cube, owners, section)
    choose(shown, cell)
    found, _ = unpack_arrays(orbit(RunDirectory.open(looked_at), cell, 0))
    psi = found["states"][:, 0]
    psi = (psi - np.linspace(0.0, psi[-1] - psi[0], len(psi)))[:-1]
    lines = np.abs(2.0 * np.fft.rfft(psi) / len(psi))[1:11]
    order = np.argsort(-lines)[:2]
    told = re.findall(r"([\d.]+) at ([\d.]+)", note_of(shown, "spectrum", "Lines"))
    assert [int(place) for _, place in told[:2]] == (1 + order).tolist()
    assert [float(size) for size, _ in told[:2]] == pytest.approx(lines[order], rel=1e-3)


def test_live_start__ends_on_the_label_of_the_cube(page, cube, owners):
    starts = cells_of(cube)
    closed = {int(owners[i]): i for i in range(len(starts)) if cube["orbit_period"].values.ravel()[i] == 1}
    assert len(closed) > 1, "the run has no two attractors to tell apart"
    for attractor, cell in list(closed.items())[:2]:
        choose(page, cell)
        assert fact(page, "Attractor").startswith(f"{letter(attractor)}:")
        for label, state in (("Start ψ₁", "psi1_0"), ("Start ψ₂", "psi2_0")):
            field = page.page.get_by_label(label, exact=True)
            field.fill(repr(starts[cell][state]))
            field.press("Tab")
        page.page.get_by_role("button", name="Integrate this start").click()
        assert f"ends on {letter(attractor)}:" in note_of(page, "plane", "ends on")
        assert page.page.locator(".panel-plane .readout").text_content() != ""
    assert page.complaints == []


def test_plane__is_walked_by_keys_started_in_and_computed(page):
    choose(page, 0)
    plane = page.page.get_by_role("application", name="Plane of initial states")
    plane.focus()
    before = numbers(page.page.locator(".panel-plane .readout").text_content())
    plane.press("ArrowRight")
    plane.press("Shift+ArrowUp")
    after = numbers(page.page.locator(".panel-plane .readout").text_content())
    assert after[0] > before[0]
    assert after[1] > before[1]
    plane.press("Enter")
    assert "ends on" in note_of(page, "plane", "ends on")
    # a slice is refined, and can be cancelled
    page.page.get_by_label("Cells").select_option("512")
    page.page.get_by_role("button", name="Compute this slice").click()
    note_of(page, "plane", r"\d+ × \d+ of 512 × 512 starts")
    assert page.page.locator(".panel-plane .legend li").count() > 0
    page.page.get_by_role("button", name="Cancel").click()
    assert "Cancelled" in note_of(page, "plane", "Cancelled")
    assert page.page.get_by_role("button", name="Compute this slice").is_enabled()


def test_follow__takes_the_orbit_along_and_back(page, cube, owners):
    cell = int(np.flatnonzero((cube["orbit_period"].values.ravel() == 1) & (owners >= 0))[0])
    choose(page, cell)
    before = fact(page, "frequency")
    field = page.page.locator(".panel-follow").get_by_label("Value")
    field.fill("2.21")
    field.press("Tab")
    assert "stable" in note_of(page, "follow", "Followed to")
    assert float(fact(page, "frequency")) == pytest.approx(2.21)
    page.page.get_by_role("button", name="Back to the run's orbit").click()
    assert fact(page, "frequency") == before
    assert page.complaints == []
    # all controls have names, and time obeys keys
    unnamed = page.page.evaluate(
        """() => [...document.querySelectorAll('.panels :is(button, input, select, summary, [tabindex])')]
        .filter((e) => !(e.getAttribute('aria-label') || e.textContent.trim() || e.labels?.length))
        .map((e) => e.outerHTML)"""
    )
    assert unnamed == []
    slider = page.page.get_by_role("slider", name="Time")
    slider.focus()
    slider.press("End")
    told = page.page.locator(".panel-series output").text_content()
    assert not told.startswith("t = 0.000 s")
    play = page.page.get_by_role("button", name="Play")
    play.focus()
    play.press("Space")
    page.page.get_by_role("button", name="Pause").wait_for()


def test_save__gives_the_picture_and_the_data_of_a_panel(shown, cube):
    choose(shown, 4)
    card = shown.page.locator(".panel-portraits")
    card.locator("details.save summary").click()
    with shown.page.expect_download() as drawn_file:
        card.get_by_role("button", name="save as SVG").click()
    svg = ElementTree.fromstring(Path(drawn_file.value.path()).read_bytes())
    assert sum("path" in part.tag for part in svg.iter()) > 10
    with shown.page.expect_download() as table:
        card.get_by_role("button", name="save as CSV").click()
    lines = [line for line in Path(table.value.path()).read_text("utf-8").splitlines() if line[0] != "#"]
    assert "psi1_dot [rad/s]" in lines[0].split(",")
    assert len(lines) > 100


def test_connection__that_is_lost_is_said_and_sought(visit, looked_at):
    with served(looked_at) as address:
        opened = drawn(visit(address, **QUIET))
        choose(opened, 0)
    opened.page.get_by_text("Not connected to magpend").wait_for()
    opened.page.get_by_role("button", name="Integrate this start").click()
    note_of(opened, "plane", "connection to magpend was lost")
