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
reveal_type(run.plot.lyapunov(as_map=True))
reveal_type(run.plot.lyapunov())
reveal_type(magpend.open_run("runs/first"))
reveal_type(magpend.open_run("runs/first", tree=True))
reveal_type(magpend.basins("runs/first", confidence=0.9))
run.attractors(treshold=0.2)
run.basins(interval="wald")
run.curves(second="q")
run.table("atractors")
run.plot.bifurcation(degrees="yes")
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
11: error: Unexpected keyword argument "treshold"
12: error: Argument "interval" to "basins" of "Analyses" has incompatible type
13: error: Missing named argument "second_low"
14: error: Argument 1 to "table" of "Run" has incompatible type
15: error: No overload variant of "bifurcation" of "Plots" matches
16: error: Unexpected keyword argument "confidense" for "basins"
"""


def checked(path: Path) -> list[str]:
    """Lines of mypy on a file, with the package's own settings."""
    api = pytest.importorskip("mypy.api")
    cache = Path(os.environ["MAGPEND_CACHE_DIR"]) / "mypy"
    config = ["--config-file", str(ROOT / "pyproject.toml"), "--follow-imports", "silent", "--cache-dir", str(cache)]
    before = Path.cwd()
    os.chdir(ROOT)
    try:
        out, errors, _ = api.run([*config, str(path)])
    finally:
        os.chdir(before)
    assert not errors
    # a result from the cache has the path of an earlier test
    return [re.sub(r"^\S+\.py:", "", line) for line in out.splitlines()]


@pytest.mark.parametrize("page", ["docs/python.md", "docs/python-start.md", "README.md"])
def test_examples__have_types(page, tmp_path):
    module = tmp_path / "example.py"
    blocks = _PYTHON.findall((ROOT / page).read_text("utf-8"))
    module.write_text("\n".join(blocks), "utf-8")
    assert len(blocks) >= 1
    assert checked(module) == ["Success: no issues found in 1 source file"]


def test_mistakes__are_seen(tmp_path):
    module = tmp_path / "mistakes.py"
    module.write_text(MISTAKES, "utf-8")
    said = checked(module)
    for line in SAID.splitlines():
        assert any(one.startswith(line) for one in said), "\n".join(said)
