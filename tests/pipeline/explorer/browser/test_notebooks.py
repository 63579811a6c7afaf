"""The explorer as a widget: in JupyterLab and in marimo, each started once, with their own kernels and pages."""

from __future__ import annotations

import json
import socket
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.store.run import open_run
from tests.pipeline.explorer.browser.notebooks import Lab, jupyterlab, started

pytestmark = pytest.mark.slow

JUPYTER = {
    "widget": "import json, magpend\nw = magpend.explorer({run!r})\nseen = []\nw.observe(seen.append, 'selected')\nw",
    "other": "other = magpend.explorer({run!r}, height=480)\nother",
    "read": "print(json.dumps([w.selected, other.selected, len(seen)]))",
    "write": "other.selected = {{'cell': 7, 'point': 3}}\nw.selected = None",
    "jobs": (
        "import time\nend = time.monotonic() + 30\n"
        "def busy():\n    return [s for s in w._answering.live._sessions if not s.is_over]\n"
        "while time.monotonic() < end and busy():\n    time.sleep(0.05)\n"
        "print(json.dumps([len(w._connection._sessions), len(busy())]))"
    ),
}

MARIMO = """
import marimo

app = marimo.App(width="full")

@app.cell
def _():
    import json
    import magpend
    import marimo as mo
    return json, magpend, mo

@app.cell
def _(magpend, mo):
    w = mo.ui.anywidget(magpend.explorer({run!r}))
    w
    return (w,)

@app.cell
def _(json, mo, w):
    mo.Html("<pre id='read'>" + json.dumps(w.selected) + "</pre>")
    return

if __name__ == "__main__":
    app.run()
"""


@pytest.fixture(scope="module")
def lab(lasting: Callable[..., Any], looked_at: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    pytest.importorskip("jupyterlab", reason="JupyterLab is not installed")
    cells = {name: text.format(run=str(looked_at)) for name, text in JUPYTER.items()}
    with jupyterlab(tmp_path_factory.mktemp("lab"), cells) as address:
        opened = lasting(address, 1440, 1300)
        yield Lab(opened.page, list(cells), opened.complaints)


# ---- what is looked at


def drawn(page: Any, n: int = 0) -> Any:
    """An explorer of a notebook, once its diagram is drawn."""
    page.locator(".magpend-explorer .diagram[data-drawn]").nth(n).wait_for()
    return page.locator(".magpend-explorer").nth(n)


def state_of(explorer: Any) -> dict[str, Any]:
    return dict(explorer.evaluate("element => element.magpend.state.get()"))


def click_on(explorer: Any, run: Path) -> tuple[int, int]:
    """Click where, by the cube and the page's axes, the most solitary point is; give its cell and its section."""
    cube = open_run(run).load()
    values = cube["section"].sel(state="psi1").transpose(*cube["status"].dims, "period_index").values
    y = values.reshape(-1, values.shape[-1])
    x = np.repeat(cube["frequency"].values, y.shape[0] // cube.sizes["frequency"])[:, None]
    box, (x0, x1, y0, y1) = explorer.evaluate("({ magpend: { diagram } }) => [diagram.box, diagram.window]")
    left, top = box["left"] + (x - x0) / (x1 - x0) * box["width"], box["top"] + (y1 - y) / (y1 - y0) * box["height"]
    places = np.stack(np.broadcast_arrays(left, top), axis=-1).reshape(-1, 2)
    distances = np.linalg.norm(places[:, None] - places, axis=-1) + np.where(np.eye(len(places)), np.inf, 0.0)
    chosen = int(distances.min(axis=1).argmax())
    explorer.locator(".diagram").click(position={"x": float(places[chosen, 0]), "y": float(places[chosen, 1])})
    explorer.locator(".panels[data-shown]").wait_for()
    cell, point = divmod(chosen, y.shape[-1])
    return cell, point


def is_of_the_cube(selected: dict[str, Any], cell: int, point: int, run: Path) -> None:
    """Check what is read in Python against the cube, to the last bit."""
    cube = open_run(run).load()
    assert (selected["cell"], selected["point"]) == (cell, point)
    one = cube.isel(dict(zip(cube["status"].dims, np.unravel_index(cell, cube["status"].shape), strict=True)))
    section, names = one["section"].transpose("period_index", "state").values[point], cube["state"].values.tolist()
    assert selected["state"] == dict(zip(names, section.tolist(), strict=True))
    assert selected["start"] == {name: float(one[f"{name}_0"]) for name in names}
    assert selected["frequency"] == float(one["frequency"])
    kept = tomllib.loads(cube.attrs["parameters"])
    assert {name: selected["parameters"][name] for name in kept} == kept


# ---- JupyterLab


def test_jupyter__a_click_is_read_in_python_and_python_selects(lab: Lab, looked_at: Path) -> None:
    lab.run("widget")
    lab.run("other")
    one, other = drawn(lab.page), drawn(lab.page, 1)
    cell, point = click_on(one, looked_at)
    for _ in range(100):  # a click reaches the kernel some time after the page shows it
        first, second, n_seen = lab.run("read")
        if first:
            break
        lab.page.wait_for_timeout(100)
    is_of_the_cube(first, cell, point, looked_at)
    # the other widget of the notebook is left alone
    assert (second, n_seen) == (None, 1)
    assert state_of(other)["selected"] is None

    lab.run("write")
    other.locator(".panels[data-shown='7-3']").wait_for()
    assert state_of(one)["selected"] is None
    _, second, _ = lab.run("read")
    is_of_the_cube(second, 7, 3, looked_at)


def test_jupyter__jobs_end_with_the_output(lab: Lab, looked_at: Path) -> None:
    one = drawn(lab.page)
    click_on(one, looked_at)
    one.locator("label:text-is('Cells') + select").select_option("512")
    one.get_by_role("button", name="Compute this slice").click()
    one.locator(".panel-plane .note:has-text('of 512 × 512 starts')").wait_for()
    lab.page.evaluate("() => { jupyterapp.shell.currentWidget.content.activeCellIndex = 0; }")
    lab.command("notebook:clear-cell-output")
    assert lab.run("jobs") == [0, 0]
    assert [text for text in lab.complaints if "magpend" in text or "script" in text] == []


# ---- marimo


@pytest.fixture(scope="module")
def marimo_page(
    lasting: Callable[..., Any], looked_at: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Any]:
    pytest.importorskip("marimo", reason="marimo is not installed")
    folder = tmp_path_factory.mktemp("marimo")
    (folder / "notebook.py").write_text(MARIMO.format(run=str(looked_at)), "utf-8")
    with socket.socket() as free:  # the program prints no port that it found itself
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = ["marimo", "run", "notebook.py", "--headless", "--no-token", "--host", "127.0.0.1", "--port", str(port)]
    with started(words, folder, r"URL: http://"):
        yield lasting(f"http://127.0.0.1:{port}", 1440, 1100)


def test_marimo__a_click_runs_the_cells_that_read_it(marimo_page: Any, looked_at: Path) -> None:
    page = marimo_page.page
    one = drawn(page)
    assert page.locator("#read").inner_text() == "null"
    cell, point = click_on(one, looked_at)
    page.wait_for_function("document.querySelector('#read')?.innerText.startsWith('{')")
    selected = json.loads(page.locator("#read").inner_text())
    is_of_the_cube(selected, cell, point, looked_at)
    # live computation in marimo: what a thread sends arrives
    one.get_by_role("button", name="Integrate this start").click()
    one.locator(".panel-plane .note:has-text('This start ends on')").wait_for()
