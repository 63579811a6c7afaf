"""Programs that show notebooks: JupyterLab with a notebook of given cells, and any other that prints its address."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[4]

PATIENCE_S = 60.0  # a machine that is busy with other tests


@contextmanager
def started(words: list[str], folder: Path, pattern: str, **environment: str) -> Iterator[str]:
    """Start a program that serves notebooks, in a home of its own; gives the address that it prints."""
    homes = {name: str(folder / f".{name.lower()}") for name in ("HOME", "XDG_CONFIG_HOME", "IPYTHONDIR")}
    # what is compiled stays in the cache of all tests
    paths = os.pathsep.join([str(ROOT), str(ROOT / "pipeline" / "face"), os.environ.get("PYTHONPATH", "")])
    said = folder / "said.txt"
    with (
        said.open("w") as file,
        subprocess.Popen(
            [sys.executable, "-m", *words],
            cwd=folder,
            env={**os.environ, **homes, "PYTHONPATH": paths.rstrip(os.pathsep), "NO_COLOR": "1", **environment},
            stdout=file,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
        ) as process,
    ):
        try:
            end = time.monotonic() + PATIENCE_S
            while (found := re.search(pattern, said.read_text("utf-8"))) is None:
                assert process.poll() is None, said.read_text("utf-8")
                assert time.monotonic() < end, said.read_text("utf-8")
                time.sleep(0.1)
            yield found[0]
        finally:
            process.terminate()


def write_notebook(path: Path, cells: Mapping[str, str]) -> None:
    """Write a notebook with cells of code by their names."""
    written = [
        {"cell_type": "code", "id": name, "execution_count": None, "metadata": {}, "outputs": [], "source": text}
        for name, text in cells.items()
    ]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    content = {"cells": written, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    path.write_text(json.dumps(content), "utf-8")


def lab_directory() -> Path:
    """Where JupyterLab's own page is installed."""
    distribution = importlib.metadata.distribution("jupyterlab")
    index = next(f for f in distribution.files or () if str(f).endswith("share/jupyter/lab/static/index.html"))
    return Path(str(distribution.locate_file(index))).resolve().parents[1]


@contextmanager
def jupyterlab(folder: Path, cells: Mapping[str, str]) -> Iterator[str]:
    """Start JupyterLab on loopback in a folder, with a notebook of some cells; gives the notebook's address."""
    write_notebook(folder / "explorer.ipynb", cells)
    installed = lab_directory()
    names = ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR")
    places = {name: str(folder / f".{name.lower()}") for name in names}
    places |= {"JUPYTERLAB_DIR": str(installed), "JUPYTER_PATH": str(installed.parent)}
    settings = folder / ".settings" / "@jupyterlab" / "apputils-extension"
    settings.mkdir(parents=True)
    # it asks nobody for news, and does not ask whether it may
    (settings / "notification.jupyterlab-settings").write_text(
        '{"fetchNews": "false", "checkForUpdates": false}', "utf-8"
    )
    places["JUPYTERLAB_SETTINGS_DIR"] = str(folder / ".settings")
    words = [
        "jupyterlab", "--no-browser", "--allow-root", "--ServerApp.ip=127.0.0.1", "--ServerApp.port=0",
        "--IdentityProvider.token=secret", "--LabApp.expose_app_in_browser=True", "--LabApp.news_url=None",
        "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate", "--LabApp.extension_manager=readonly",
    ]  # fmt: skip
    with started(words, folder, r"http://127\.0\.0\.1:\d+/lab", **places) as address:
        yield f"{address}/tree/explorer.ipynb?token=secret"


class Lab:
    """A notebook in JupyterLab, a page of playwright: runs cells by name, and reads what they print."""

    def __init__(self, page: Any, names: Sequence[str], complaints: Sequence[str] = ()) -> None:
        self.page, self.names, self.complaints = page, names, complaints
        self.page.wait_for_selector(".jp-Notebook .jp-Cell")
        self.page.evaluate(
            """async () => {
              const panel = jupyterapp.shell.currentWidget;
              await panel.context.ready;
              await panel.sessionContext.ready;
              await panel.sessionContext.session.kernel.info;
            }"""
        )

    def run(self, name: str) -> Any:
        """Run a cell; give what it prints as JSON, if it prints."""
        outputs = self.page.evaluate(
            """async number => {
              const notebook = jupyterapp.shell.currentWidget.content;
              notebook.activeCellIndex = number;
              await jupyterapp.commands.execute("notebook:run-cell");
              return notebook.widgets[number].model.outputs.toJSON();
            }""",
            self.names.index(name),
        )
        errors = [output for output in outputs if output["output_type"] == "error"]
        assert errors == []
        texts = ["".join(output["text"]) for output in outputs if output["output_type"] == "stream"]
        return json.loads("".join(texts)) if texts else None

    def command(self, name: str, **arguments: Any) -> None:
        self.page.evaluate("([name, given]) => jupyterapp.commands.execute(name, given)", [name, arguments])
