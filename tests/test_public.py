"""The public face: `import magpend`."""

from __future__ import annotations

import tomllib

import pytest

import magpend
from pipeline.products.registry import ANALYSES
from tests.programs import ROOT, fresh_python


@pytest.mark.parametrize("name", dir(magpend))
def test_magpend__every_name_is_there(name):
    if name == "__version__":
        return  # known to installed packages alone
    assert getattr(magpend, name) is not None


def test_magpend__completes_and_refuses_as_modules_do():
    names = dir(magpend)
    assert {"open_run", "run", "load_model", "sections", "trajectory", "plot_basins", *ANALYSES.listed} <= set(names)
    with pytest.raises(AttributeError, match="no attribute 'atractors'"):
        magpend.atractors  # noqa: B018
    assert magpend.basins is magpend.Run.basins


ACCESSOR = """\
import magpend
assert "xarray" not in sys.modules
import xarray as xr
assert not any(type(f).__name__ == "_AccessorRegistration" for f in sys.meta_path)
assert "DatasetAccessor" in str(xr.Dataset().magpend)"""
HELP = """\
from pipeline.cli.main import app
try:
    app(["--help"])
except SystemExit:
    pass"""
OPTIONS = """\
from pipeline.products.registry import ANALYSES, CELL_PRODUCTS, FIGURES
assert all(p.options for r in (ANALYSES, CELL_PRODUCTS, FIGURES) for p in r.values())"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "heavy"),
    [
        ("import magpend; dir(magpend), magpend.load_model('duffing').state_names", "numba zarr dask"),
        (HELP, "numba numpy dask zarr xarray matplotlib pydantic scipy"),
        (
            "import pipeline.plots",
            "numba zarr dask distributed matplotlib.pyplot pipeline.compute.execute pipeline.store.run",
        ),
        (OPTIONS, "numba numpy xarray zarr dask matplotlib"),
        # the accessor is there once both are imported
        (ACCESSOR, ""),
    ],
    ids=["magpend", "help", "plots", "options", "accessor"],
)
def test_imports__are_light(code, heavy):
    said = fresh_python(f"import sys\n{code}\nprint([m for m in {heavy.split()!r} if m in sys.modules])").stdout
    assert said.splitlines()[-1] == "[]"


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
