"""An analysis of another package: a folder and a line make command, method, function, table, CSV, figure and docs."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from tests.pipeline.factories import finished
from tests.programs import ROOT, fresh_python

RUN = """
kind = "sweep"
model = "duffing"
parameters.preset = "twin-well"
axes.frequency_hz.values = [0.15, 0.16]
initial_conditions = { kind = "list", points = [[-1.0, 0.0], [1.0, 0.0]] }
integration = { n_transient = 20, n_keep = 16 }
"""

USED = """
import sys

import magpend
from pipeline.cli.main import app
from pipeline.cli.reference import results
directory = sys.argv[1]
run = magpend.Run.open(directory)
ds = run.extent(last=8)
cube = run.cube()
part = cube["section"].isel(period_index=slice(-8, None))
assert (ds["low"] == part.min(["initial_condition", "period_index"])).all()
assert magpend.extent(directory, last=8).identical(ds)
assert ds["high"].attrs["long_name"] == "largest value"
assert list(run.table("extent").columns) == ["frequency", "state", "low", "high"]
assert "extent" in dir(run) and "extent" in dir(run.plot)
assert run.plot.extent(last=8).get_xlabel() == "drive frequency [Hz]"
assert "extent" in run.tree().children
assert "| `low` | swept parameters, `state` | states | least value |" in results().partition("## extent")[2]
app(["analyse", "--help"], standalone_mode=False)
app(["analyse", "extent", directory, "--last", "8", "--csv", sys.argv[2]], standalone_mode=False)
app(["plot", "extent", directory, "--last", "8"], standalone_mode=False)
"""


def package(folder: Path, name: str = "extent") -> Path:
    """Write the package of the page ``docs/own-analysis.md``, as pip would install it."""
    page = (ROOT / "docs/own-analysis.md").read_text("utf-8")
    for file, text in re.findall(r"<!-- file: (\S+) -->\n```python\n(.*?)```", page, re.DOTALL):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text, "utf-8")
    (folder / "extents/__init__.py").touch()
    (line,) = tomllib.loads(re.findall(r"```toml\n(.*?)```", page, re.DOTALL)[0])["project"]["entry-points"].items()
    about = folder / "extents-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: extents\nVersion: 1.0\n", "utf-8")
    (about / "entry_points.txt").write_text(f"[{line[0]}]\n{name} = {line[1]['extent']}\n", "utf-8")
    return folder


def told(site: Path, code: str, *words: object) -> str:
    lead = f"import sys; sys.path.insert(0, {str(site)!r}); sys.argv[1:] = {[str(word) for word in words]}\n"
    return fresh_python(lead + code).stdout


@pytest.mark.slow
def test_analysis_of_another_package__is_like_our_own(tmp_path: Path) -> None:
    directory, csv = finished(tmp_path / "made", RUN), tmp_path / "extent.csv"
    found = told(package(tmp_path / "site"), USED, directory, csv)
    # the command lists it with its sentence, and prints a row for each value and state
    assert re.search(r"Of other packages:\n  extent +Measure the range", found)
    assert re.search(r"frequency +state +low +high\n0.15 +x ", found)
    assert csv.read_text().splitlines()[0] == "frequency,state,low,high"
    assert len(csv.read_text().splitlines()) == 1 + 2 * 2
    assert list((directory / "figures").glob("extent*.png"))


@pytest.mark.slow
def test_analysis_of_another_package__that_cannot_be_used_is_left_out_with_a_reason(tmp_path: Path) -> None:
    used = """
import warnings
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    import magpend
    print(magpend.Run.basins.__name__, hasattr(magpend, "extent"), *(str(one.message) for one in said))
"""
    found = told(package(tmp_path / "taken", "basins"), used)
    reason = "its name is taken; rename it."
    assert found == f"basins False the analysis basins of another package (extents.declaration) is left out: {reason}\n"
    site = package(tmp_path / "broken")
    (site / "extents/declaration.py").write_text("import nowhere\n", "utf-8")
    assert "is left out: it cannot be imported (ModuleNotFoundError: No module named 'nowhere')" in told(site, used)
