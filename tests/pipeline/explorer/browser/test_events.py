"""Events of attractors on the diagram's axis, in a real browser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.explorer.data.events import event_orbit, events
from pipeline.explorer.data.explored import ExploredRun
from pipeline.runs.derive import derive, shown_table
from pipeline.store.run import RunDirectory
from tests.pipeline.explorer.browser.conftest import drawn, served
from tests.pipeline.explorer.browser.test_panels import QUIET, fact
from tests.pipeline.explorer.small_runs import LINE
from tests.pipeline.factories import finished

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A continuation of a hardening oscillator both ways, whose two folds are located."""
    directory = finished(tmp_path_factory.mktemp("line") / "line", LINE)
    derive(directory, "branches", {"max_period": 1})
    derive(directory, "events")
    return directory


def folds_of(line: Path) -> list[dict[str, Any]]:
    return [one for one in events(RunDirectory.open(line), "frequency", {})["events"] if one["label"] == "LP"]


def test_events__lead_to_cells_on_the_orbits(line: Path) -> None:
    run = RunDirectory.open(line)
    rows = {row["event"]: row for row in shown_table("events", derive(line, "events")).rows}
    cube = run.cube().load()
    folds = folds_of(line)
    assert len(folds) == 2
    for one in folds:
        row = rows[one["event"]]
        assert (one["sentence"], one["x"]) == (row["sentence"], row["frequency_hz"])
        places = [ExploredRun.open(run).cell(one[name]) for name in ("before", "after")]
        assert [float(cube["frequency"][place["frequency"]]) for place in places] == [row["seen"], row["beyond"]]
        # the same branch of the continuation, in its direction, jumps to another orbit
        assert places[0]["branch"] == places[1]["branch"]
        assert str(cube["direction"][places[0]["branch"]].values) == ("up" if row["rises"] else "down")
        before, after = (cube["section"].isel(place).isel(period_index=-1).values for place in places)
        assert np.abs(before - after).max() > 0.3
        assert one["orbit"]
        assert len(event_orbit(run, "frequency", {}, one["event"])) > 1000


def test_events__are_clicked_on_the_axis(visit: Callable[..., Any], line: Path) -> None:
    fold = folds_of(line)[0]
    with served(line) as address:
        opened = drawn(visit(address, **QUIET))
        page = opened.page
        page.wait_for_selector(".panel-events select")
        px, py = page.evaluate(
            """(x) => {
              const d = magpend.diagram, { box } = d, [x0, x1] = d.window, edge = d.element.getBoundingClientRect();
              return [edge.left + box.left + (box.width * (x - x0)) / (x1 - x0), edge.top + box.top + box.height];
            }""",
            fold["x"],
        )
        page.mouse.click(px, py)
        sentence = page.locator(".event-sentence")
        sentence.filter(has_text="fold (LP)").wait_for()
        assert sentence.text_content() == fold["sentence"]
        for name, shown in (("Before", f"{fold['before']}-"), ("After", f"{fold['after']}-")):
            page.get_by_role("button", name=name, exact=True).click()
            page.locator(f".panels[data-shown^='{shown}']").wait_for()
        page.get_by_role("button", name="At the event").click()
        page.locator(f".panels[data-shown='event-{fold['event']}']").wait_for()
        assert float(fact(opened, "frequency [Hz]")) == pytest.approx(fold["x"], rel=1e-6)
        assert fact(opened, "Kind") == "fold, period 1"
        # a cell that was shown before is shown again
        page.get_by_role("button", name="After", exact=True).click()
        page.locator(f".panels[data-shown^='{fold['after']}-']").wait_for()
        assert (opened.complaints, opened.outside) == ([], [])
