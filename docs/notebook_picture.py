"""Make the picture of the explorer in JupyterLab: ``python docs/notebook_picture.py RUN FILE``.

JupyterLab and chromium are started on this machine alone, with a notebook of two cells. A point is selected from
Python, and the picture is taken once its orbit is shown.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.pipeline.explorer.browser.conftest import chromium  # noqa: E402
from tests.pipeline.explorer.browser.notebooks import Lab, jupyterlab  # noqa: E402

WIDTH, HEIGHT = 1500, 1130


def picture(run: Path, file: Path) -> None:
    """Write a picture of a run in JupyterLab, with a point selected by the second cell."""
    cells = {
        "widget": f'import magpend\n\nwidget = magpend.explorer("{run.name}")\nwidget',
        "selected": 'widget.selected = {"cell": 2944}\n'
        '{name: widget.selected[name] for name in ("frequency", "period", "state")}',
    }
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        (Path(folder) / run.name).symlink_to(run.resolve())
        browser = playwright.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
        with jupyterlab(Path(folder), cells) as address:
            page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            page.goto(address)
            lab = Lab(page, list(cells))
            lab.command("application:toggle-left-area")
            lab.run("widget")
            page.locator(".magpend-explorer .diagram[data-drawn]").wait_for(timeout=120_000)
            lab.run("selected")
            page.locator(".magpend-explorer .panels[data-shown]").wait_for(timeout=120_000)
            # multipliers come once their code is compiled
            page.locator(".magpend-explorer .panel-facts .note").wait_for(state="detached", timeout=120_000)
            page.wait_for_timeout(1000)  # the machine moves
            page.screenshot(path=file)
        browser.close()


if __name__ == "__main__":
    picture(Path(sys.argv[1]), Path(sys.argv[2]))
