"""The public face: `import magpend`."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import magpend
from pipeline.products.registry import ANALYSES, COMMANDS

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", dir(magpend))
def test_magpend__every_name_is_there(name):
    if name == "__version__":
        return  # known to installed packages alone
    assert getattr(magpend, name) is not None


def test_magpend__completes_and_refuses_as_modules_do():
    names = dir(magpend)
    assert {"open_run", "run", "load_model", "sections", "trajectory", "plot_basins", *COMMANDS} <= set(names)
    with pytest.raises(AttributeError, match="no attribute 'atractors'"):
        magpend.atractors  # noqa: B018
    assert "Options:" in magpend.basins.__doc__
    assert ANALYSES["basins"].help in magpend.basins.__doc__


def test_magpend__imports_nothing_heavy():
    code = (
        "import sys, magpend\n"
        "dir(magpend), magpend.load_model('duffing').state_names\n"
        "print([m for m in ('numba', 'zarr', 'dask') if m in sys.modules])\n"
    )
    path = os.pathsep.join([str(ROOT), str(ROOT / "pipeline" / "face"), os.environ.get("PYTHONPATH", "")])
    found = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=True
    )
    assert found.stdout.strip() == "[]"


def test_load_model__warns_of_what_nothing_uses():
    table = {
        "name": "oscillator",
        "states": {"x": "m", "v": "m/s"},
        "parameters": {"c": 0.1, "k": 2.0},
        "equations": {"x": "v", "v": "-x - c*v + cos(2*pi*f*t)"},
    }
    with pytest.warns(UserWarning, match=r"model.parameters.k: nothing uses it; use it"):
        magpend.load_model(table)


def test_packages__are_all_shipped():
    """Every folder with modules is in the list of packages, and the face is mapped to its folder."""
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    listed = set(setup["packages"])
    found = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for top in ("magpend_core", "pipeline", "workflows")
        for path in (ROOT / top).rglob("__init__.py")
    }
    data = {name for name in listed if name.endswith(".presets")}
    assert found - {"pipeline.face.magpend"} == listed - data - {"magpend"}
    assert (ROOT / setup["package-dir"]["magpend"] / "__init__.py").is_file()
