"""The widget of a notebook without a browser: Python and the page select alike."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import magpend
from pipeline.explorer.notebook import explorer
from pipeline.specification.problems import SpecError
from pipeline.store.run import RunDirectory
from tests.pipeline.explorer.conftest import PATIENCE_S
from tests.pipeline.explorer.test_transports import LONG
from tests.programs import fresh_python

pytestmark = pytest.mark.slow


@pytest.fixture
def widget(little):
    pytest.importorskip("anywidget", reason="anywidget is not installed")
    found = explorer(little)
    yield found
    found.close()


def test_widget__a_closed_comm_cancels_its_jobs(widget):
    """Marimo closes the comm of a cell that runs again before the page can say that it leaves."""
    widget._connection.receive({"page": "one", "open": True})
    session = widget._connection._sessions["one"]
    widget.comm.close()
    widget._connection.receive({"page": "one", "live": LONG})
    session.join(PATIENCE_S)
    assert session.is_over


def test_selected__is_of_the_cube_and_shown_in_the_page(widget, little):
    seen = []
    widget.observe(lambda change: seen.append(change["new"]), "selected")
    widget.selected = {"cell": 2}
    cube = RunDirectory.open(little).cube().load()
    one = cube.isel(x_0=2)
    section = one["section"].transpose("period_index", "state").values
    found = widget.selected
    assert (found["cell"], found["point"]) == (2, len(section) - 1)
    assert found["state"] == {"x": section[-1, 0], "v": section[-1, 1]}
    assert found["start"] == {"x": float(one["x_0"]), "v": 0.1}
    assert found["period"] == int(one["orbit_period"])
    assert widget.view == "point=2,11"
    assert len(seen) == 1
    # the page selects, and keeps the rest of its view
    widget.view = "y=v&point=1,4"
    assert (widget.selected["cell"], widget.selected["point"]) == (1, 4)
    widget.selected = {"cell": 3, "point": 0}
    assert widget.view == "y=v&point=3,0"
    widget.selected = None
    assert (widget.view, len(seen)) == ("y=v", 4)
    # what the run does not have selects nothing
    widget.view = "point=99,0"
    assert widget.selected is None


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"cell": 99}, "cell"),
        ({"cell": 1, "point": 12}, "sections 0 to 11"),
        ({"cell": "1"}, '{"cell": 12}'),
        ({}, "give it as"),
    ],
)
def test_selected__what_does_not_exist_is_refused(widget, given, said):
    widget.selected = {"cell": 1}
    with pytest.raises(Exception, match="selected") as caught:
        widget.selected = given
    assert said in str(caught.value)
    assert widget.selected["cell"] == 1


def test_orbit__closes_and_begins_at_the_selected_point(widget):
    assert widget.orbit() is None
    widget.selected = {"cell": 1, "point": 4}
    orbit, state = widget.orbit(), widget.selected["state"]
    assert (orbit["x"].values[0], orbit["v"].values[0]) == (state["x"], state["v"])
    # sections of the run are closed orbits to its tolerance
    np.testing.assert_allclose([orbit["x"][-1] - orbit["x"][0], orbit["v"][-1] - orbit["v"][0]], 0.0, atol=1e-4)
    seconds = widget.selected["period"] / widget.selected["frequency"]
    np.testing.assert_allclose(orbit["time"].values[-1], seconds, rtol=1e-12)


def test_explore__is_a_method_of_a_run(little, widget):
    found = magpend.Run.open(little).explore(height=400)
    found.selected = {"cell": 1}
    assert (found.height, found.selected["cell"]) == (400, 1)
    found.close()


def test_explorer__says_what_is_missing(little, monkeypatch):
    monkeypatch.setitem(sys.modules, "anywidget", None)
    monkeypatch.delitem(sys.modules, "pipeline.explorer.widget", raising=False)
    with pytest.raises(SpecError, match=r"pip install '\.\[notebook\]'"):
        explorer(little)
    with pytest.raises(SpecError, match="height = 100: must be 320 pixels or more"):
        explorer(little, height=100)


def test_explorer__a_script_that_shows_nothing_starts_nothing(little, widget):
    """The widget of a script without a page ends with it, and says nothing."""
    done = fresh_python(f"from magpend import explorer; w = explorer({str(little)!r}); w.selected = {{'cell': 1}}")
    assert (done.stdout, done.stderr) == ("", "")
