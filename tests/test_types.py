"""What a type checker says of the documented examples, and of mistakes in them."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from tests.programs import ROOT

pytestmark = pytest.mark.slow

_PYTHON = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)

MISTAKES = """\
import magpend
run = magpend.Run.open("runs/first")
reveal_type(magpend.run("quickstart"))
reveal_type(run.plot.bifurcation())
reveal_type(run.plot.bifurcation(layout="side"))
reveal_type(run.plot.fractions(ax=None))
reveal_type(run.plot.gallery())
reveal_type(magpend.open_run("runs/first"))
reveal_type(magpend.open_run("runs/first", tree=True))
reveal_type(run.basins(confidence=0.9, workers=2))
reveal_type(magpend.basins("runs/first", confidence=0.9))
run.attractors(treshold=0.2)
run.basins(interval="wald")
run.atractors()
run.plot.bifurcation(degrees="yes")
run.plot.regims()
magpend.basins("runs/first", confidense=0.9)
"""
SAID = """\
3: note: Revealed type is "magpend._runs.Run"
4: note: Revealed type is "matplotlib.axes._axes.Axes"
5: note: Revealed type is "numpy.ndarray[
6: note: Revealed type is "matplotlib.axes._axes.Axes"
7: note: Revealed type is "numpy.ndarray[
8: note: Revealed type is "xarray.core.dataset.Dataset"
9: note: Revealed type is "xarray.core.datatree.DataTree"
10: note: Revealed type is "xarray.core.dataset.Dataset"
11: note: Revealed type is "xarray.core.dataset.Dataset"
12: error: No overload variant
13: error: No overload variant
14: error: "Run" has no attribute "atractors"
15: error: No overload variant
16: error: "Plots" has no attribute "regims"
17: error: No overload variant
"""


PAGES = {"python": "docs/python.md", "start": "docs/python-start.md", "readme": "README.md"}


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """Lines of mypy, with the package's own settings, on the examples of each page and on the mistakes; one run."""
    api = pytest.importorskip("mypy.api")
    folder = tmp_path_factory.mktemp("types")
    texts = {name: "\n".join(_PYTHON.findall((ROOT / page).read_text("utf-8"))) for name, page in PAGES.items()}
    for name, text in {**texts, "mistakes": MISTAKES}.items():
        assert text
        (folder / f"{name}.py").write_text(text, "utf-8")
    cache = Path(os.environ["MAGPEND_CACHE_DIR"]) / "mypy"
    # functions of users, which become models, need no types
    config = [
        "--config-file",
        str(ROOT / "pyproject.toml"),
        "--allow-untyped-defs",
        "--follow-imports",
        "silent",
        "--cache-dir",
        str(cache),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        out, errors, _ = api.run([*config, *map(str, folder.glob("*.py"))])
    assert not errors
    found = re.findall(r"^(?:.*/)?(\w+)\.py:(\d+: .*)$", out, re.MULTILINE)
    return {name: [line for file, line in found if file == name] for name in (*PAGES, "mistakes")}


@pytest.mark.parametrize("page", PAGES)
def test_examples__have_types(said, page):
    assert said[page] == []


def test_mistakes__are_seen(said):
    for line in SAID.splitlines():
        assert any(one.startswith(line) for one in said["mistakes"]), "\n".join(said["mistakes"])
