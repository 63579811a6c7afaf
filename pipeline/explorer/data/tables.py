"""Export the numbers that the page shows (diagram, orbit, plane, ...) as CSV or NetCDF."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from pipeline.explorer import RequestError
from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.data.colours import Scheme, schemes
from pipeline.explorer.data.diagram import points
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.orbits import orbit
from pipeline.explorer.data.overlays import attractors, branches, curves
from pipeline.explorer.data.planes import plane_of
from pipeline.explorer.data.verticals import vertical
from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import told_by
from pipeline.layout.writing import netcdf_bytes
from pipeline.plots.figure import with_provenance
from pipeline.specification.problems import unknown_name
from pipeline.store.run import RunDirectory

FORMATS = {"csv": "text/csv; charset=utf-8", "nc": "application/x-netcdf"}
"""Formats by name, and what they are called in an answer."""


_ROWS_AT_ONCE = 65_536

Asked = Mapping[str, Any]


def table(run: RunDirectory, kind: str, asked: Asked, form: str = "csv") -> bytes:
    """Return the numbers of what the page shows as the bytes of a file, in one of `FORMATS`.

    `kind` is one of `_TABLES`; `asked` has the arguments that it takes of ``x``, ``y``, ``at``, ``cell`` and ``point``.
    Raise RequestError if one of these does not exist, or the rows are too many for CSV.
    """
    if kind not in _TABLES:
        raise RequestError(unknown_name("view", kind, list(_TABLES)))
    if form not in FORMATS:
        raise RequestError(unknown_name("format", form, list(FORMATS)))
    explored = ExploredRun.open(run)
    ds = _TABLES[kind](explored, asked)
    ds = ds.assign_attrs({"title": f"{kind} of a run", **ds.attrs})
    return _csv(ds) if form == "csv" else _netcdf(explored, ds)


# ---------------------------------------------------------------- datasets, one row per index of their dim


def _diagram(run: ExploredRun, asked: Asked) -> xr.Dataset:
    x, y = _needed(asked, "x"), _needed(asked, "y")
    upwards = vertical(run, y)
    found = points(run, x, y, asked["at"])
    ends = found.first.astype(np.int64)
    counts = ends[1:] - ends[:-1]
    numbers = np.repeat(np.arange(len(found.cell)), counts)
    ds = xr.Dataset(
        {
            "cell": ("row", found.cell.astype(np.int64)[numbers]),
            x: ("row", found.x[found.at[numbers]], {"units": _unit(run, x)}),
            y: ("row", found.y, {"units": upwards.unit}),
            "status": ("row", found.status[numbers]),
        }
    )
    for scheme in schemes(run):
        if scheme.name not in ("status", "seed"):
            ds[scheme.name] = ("row", _words(scheme)[found.codes[scheme.name][numbers]])
    return ds.assign_attrs(_place(run, x, asked["at"]))


def _words(scheme: Scheme) -> np.ndarray:
    words = np.full(1 << 16, "", f"U{max((len(c.label) for c in scheme.categories), default=1)}")
    for category in scheme.categories:
        words[category.number] = category.label
    return words


def _curves(run: ExploredRun, asked: Asked) -> xr.Dataset:
    x = _needed(asked, "x")
    rows = [
        (one["title"], one["group"], one["unit"], *numbers)
        for one in curves(run, x, asked["at"])["curves"]
        for numbers in zip(one["x"], one["y"], one.get("low", one["y"]), one.get("high", one["y"]), strict=True)
    ]
    names = ("curve", "group", "unit", x, "value", "low", "high")
    return _of_rows(rows, names).assign_attrs(_place(run, x, asked["at"]))


def _branches(run: ExploredRun, asked: Asked) -> xr.Dataset:
    x, y = _needed(asked, "x"), _needed(asked, "y")
    found = branches(run, x, y, asked["at"])
    rows = [
        (one["id"], one["period"], "stable" if part["stable"] else "unstable", k, value, height)
        for one in found["branches"]
        for k, part in enumerate(one["segments"])
        for value, height in zip(part["x"], part["y"], strict=True)
    ]
    rows += [
        (one["branch"], one["period"], one["kind"], -1, one["x"], height)
        for one in found["points"]
        for height in one["y"]
    ]
    names = ("branch", "period", "what", "segment", x, y)
    return _of_rows(rows, names).assign_attrs(_place(run, x, asked["at"]))


_SHOWN = ("kind", "stability", "evidence")


def _orbit(run: ExploredRun, asked: Asked) -> xr.Dataset:
    return orbit_dataset(run, _needed(asked, "cell"), _needed(asked, "point"))


def orbit_dataset(run: ExploredRun, cell: int, point: int) -> xr.Dataset:
    """Integrate the orbit through a section point; return its states and quantities over time, a row per instant."""
    arrays, attrs = unpack_arrays(orbit(run, cell, point))
    ds = xr.Dataset({"time": ("row", arrays["time"], {"units": "s"})})
    for k, state in enumerate(run.model.states):
        ds[state.name] = ("row", arrays["states"][:, k], {"units": state.unit})
    for k, quantity in enumerate(run.model.quantities):
        ds[quantity.name] = ("row", arrays["quantities"][:, k], {"units": quantity.unit})
    plain = ("cell", "point", "frequency", "status", "period", "motion", "attractor", *_SHOWN)
    return ds.assign_attrs(
        {key: attrs[key] for key in plain if attrs[key] is not None}
        | {f"parameter_{name}": value for name, value in attrs["parameters"].items()}
    )


def _plane(run: ExploredRun, asked: Asked) -> xr.Dataset:
    found = plane_of(run, asked["at"])
    across, upwards = found.states
    if found.source is None:
        u, v = found.starts.T
        label = found.start_label
    else:
        v, u = (a.ravel() for a in np.meshgrid(found.v, found.u, indexing="ij"))
        label = found.label.ravel()
    words = {c.number: c.label for c in found.categories}
    units = {s.name: s.unit for s in run.model.states}
    ds = xr.Dataset(
        {
            across: ("row", u, {"units": units[across]}),
            upwards: ("row", v, {"units": units[upwards]}),
            "label": ("row", label),
            "name": ("row", np.array([words.get(int(code), "") for code in label], dtype=str)),
        }
    )
    fixed = {f"fixed_{name}": value for name, value in found.fixed.items()}
    return ds.assign_attrs({**_place(run, "", asked["at"]), **fixed})


_OF_SET = ("id", "name", *_SHOWN, "period", "motion", "share", "low", "high")


def _attractors(run: ExploredRun, asked: Asked) -> xr.Dataset:
    rows = [
        (*(one[key] for key in _OF_SET), k, *point)
        for one in attractors(run, asked["at"])["attractors"]
        for k, point in enumerate(one["section"])
    ]
    names = (*_OF_SET, "point", *run.model.state_names)
    return _of_rows(rows, names).assign_attrs(_place(run, "", asked["at"]))


_TABLES: dict[str, Callable[[ExploredRun, Asked], xr.Dataset]] = {
    "diagram": _diagram,
    "curves": _curves,
    "branches": _branches,
    "orbit": _orbit,
    "plane": _plane,
    "attractors": _attractors,
}


def _needed(asked: Asked, name: str) -> Any:
    if asked.get(name) in (None, ""):
        raise RequestError(f"{name} is missing.")
    return asked[name]


def _unit(run: ExploredRun, axis: str) -> str:
    coordinate = run.cube().coords.get(axis)
    return "1" if coordinate is None else shown_unit(coordinate.attrs)


def _place(run: ExploredRun, x: str, at: Mapping[str, int]) -> dict[str, float]:
    return {f"at_{n}": float(run.axis(n).values[i]) for n, i in run.place(at, but=x).items()}


def _of_rows(rows: list[tuple[Any, ...]], names: tuple[str, ...]) -> xr.Dataset:
    variables = {}
    for name, column in zip(names, zip(*rows, strict=True) if rows else [()] * len(names), strict=True):
        if any(isinstance(value, str) for value in column):
            variables[name] = ("row", np.array(["" if v is None else v for v in column], dtype=str))
        else:
            variables[name] = ("row", np.array([np.nan if v is None else v for v in column]))
    return xr.Dataset(variables)


# ---------------------------------------------------------------- files


def _csv(ds: xr.Dataset) -> bytes:
    most = 2_000_000  # rows of a table as CSV; what is larger is for NetCDF, or for Python
    n = ds.sizes.get("row", 0)
    if n > most:
        raise RequestError(f"{n:,} rows are too many for CSV, {most:,} at most; take NetCDF.")
    text = io.StringIO()
    for name, value in ds.attrs.items():
        text.write(f"# {name}: {' '.join(str(value).split())}\n")
    names = [str(name) for name in ds.data_vars]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([_heading(ds, name) for name in names])
    writer.writerows(_rows([ds[name].values for name in names]))
    return text.getvalue().encode()


def _heading(ds: xr.Dataset, name: str) -> str:
    unit = shown_unit(ds[name].attrs)
    return name if unit in ("", "1") else f"{name} [{unit}]"


def _rows(columns: list[np.ndarray]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a table as plain Python values, with an empty text for NaN."""
    n = len(columns[0]) if columns else 0
    for first in range(0, n, _ROWS_AT_ONCE):  # as objects, numbers take ten times their room
        yield from zip(*(_plain(c[first : first + _ROWS_AT_ONCE]) for c in columns), strict=True)


def _plain(column: np.ndarray) -> list[Any]:
    values = column.tolist()
    if column.dtype.kind == "f":
        return ["" if v != v else v for v in values]
    return [_word(v) for v in values] if column.dtype.kind == "U" else values


def _word(text: str) -> str:
    """Put a quote before a text that a spreadsheet program would read as a formula."""
    formula = text[:1] in ("=", "+", "-", "@", "\t")
    return f"'{text}" if formula else text


def _netcdf(run: ExploredRun, ds: xr.Dataset) -> bytes:
    cube = run.cube()
    provenance: dict[str, Any] = {
        "source": str(cube.attrs.get("source", "magpend")),
        "run": run.info.title,
        "digest": run.info.digest,
        "cube_digest": run.digest,
        **{k: str(v) for k, v in told_by(cube.attrs).items()},
    }
    filled = ds.drop_vars([name for name, variable in ds.variables.items() if variable.size == 0])
    return netcdf_bytes(with_provenance(filled, provenance))
