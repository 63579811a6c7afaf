"""Export a run's interactive page for a browser without a server, as one file or as a folder.

A copy computes nothing: its orbits were integrated when it was made, and it lists its gaps. The page of a folder
loads its data when needed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline.explorer.copies.content import Column, Copied, Fitted, add_planes, column, fit, gather, place_of
from pipeline.explorer.copies.orbits import Room, add_orbits, choose
from pipeline.explorer.data.arrays import pack_zipped, zip_json
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.verticals import vertical
from pipeline.explorer.html import folder_html, inline_html, static_text
from pipeline.layout.writing import sync_folder, temporary_beside, write_atomically, writing
from pipeline.products.reporting import track
from pipeline.store.consolidate import Layer, write_cube
from pipeline.store.errors import RefusedError
from pipeline.store.files import CUBE, entry_of
from pipeline.store.local import refuse_place, remove_tree, unwritable
from pipeline.store.run import RunDirectory

ORBITS_SHARE, PLANES_SHARE = 0.25, 0.15
"""What orbits and planes may take of a copy in one file."""

RESERVE = 10_000
"""For what the page says of its columns [bytes]."""


@dataclass(frozen=True)
class Exported:
    """Result of an export: its path, its size, its number of orbits, and notes for the user."""

    path: Path
    size: int  # size of everything written [bytes]
    orbits: int
    sentences: list[str] = field(default_factory=list)  # notes that the export shows to its readers


def export_page(
    source: RunDirectory,
    out: Path,
    *,
    force: bool = False,
    quantities: Sequence[str] = (),
    most_orbits: int = 2000,
    most_bytes: int = 20_000_000,
) -> Exported:
    """Write the interactive page of a run as one HTML file.

    Parameters
    ----------
    source
        An opened run. What is not committed is shown as not computed.
    out
        File to write.
    force
        Whether a file at its place makes way.
    quantities
        Those of the model that can be on the vertical axis, besides states and kept extremes.
    most_orbits
        Orbits that are integrated for it, one for each attractor at each parameter point.
    most_bytes
        Size of the file. Where all does not fit, orbits become fewer, then numbers are rounded, then sections
        are left out, and the page says which.

    Raises
    ------
    SpecError
        If the model has no such quantity.
    RefusedError
        If something is at its place, nothing can be written there, or the run does not fit at all.
    DamagedError
        If what is read of the run is not what was written.
    """
    check_place(out, force)
    copied = gather(ExploredRun.open(source), quantities)
    columns, layers = read_columns(copied)
    copied.objects["cells"] = pack_zipped(layers)
    add_planes(copied, PLANES_SHARE * most_bytes * 3 / 4)
    room = Room(most_orbits, ORBITS_SHARE * most_bytes * 3 / 4, brief=True)
    orbits = add_all_orbits(copied, columns, layers, room)
    fitted = _fitted(copied, columns, most_bytes)
    for i, (name, content) in enumerate(fitted.objects.items()):
        copied.about["columns"][name] = f"column-{i}"
        copied.objects[f"column-{i}"] = content
    copied.sentences += fitted.sentences()
    html = _html(copied)
    if len(html) > most_bytes:
        raise RefusedError(f"{source.name}: the page takes {len(html):,} bytes of {most_bytes:,}; use --folder OUT.")
    write_atomically(out, html)
    return Exported(out, len(html), orbits, copied.sentences)


def _html(copied: Copied) -> bytes:
    # the digest says whose page this is: a page of the same run may be replaced
    generator = f"magpend {copied.view['version']}, run {copied.run.info.digest}"
    return inline_html(copied.run.info.title, generator, finished(copied)).encode()


def _fitted(copied: Copied, columns: Mapping[str, Column], most_bytes: int) -> Fitted:
    """Pack the diagram points in as much detail as fits into the file, beside the rest of the page."""
    # base64 makes four of three
    room = (most_bytes - len(_html(copied)) - RESERVE) * 3 / 4
    found = fit(columns, periods(copied.run), room) if room > 0 else None
    if found is None:
        raise RefusedError(
            f"{copied.run.name}: even one section of each cell does not fit into {most_bytes / 1e6:g} MB "
            "beside the rest of the page. Make a folder instead (--folder OUT), or a zoom of the run."
        )
    return found


def check_place(out: Path, force: bool) -> None:
    """Raise RefusedError if a file exists already or cannot be written, before anything is computed."""
    if out.is_dir():
        raise RefusedError(f"{out}: is a folder; give a file.")
    refuse_place(out)
    _check_new(out, force)


def _check_new(out: Path, force: bool) -> None:
    if not out.parent.is_dir():
        raise RefusedError(f"{out.parent}: no such folder; make it first.")
    if problem := unwritable(out.parent):
        raise RefusedError(f"{problem}; give another place.")
    if (out.exists() or out.is_symlink()) and not force:
        raise RefusedError(f"{out}: exists already and is not overwritten; give another name, or --force.")


def read_columns(copied: Copied) -> tuple[dict[str, Column], dict[str, np.ndarray]]:
    """Read the diagram points of all vertical axes, and the status and colours of the cells."""
    columns: dict[str, Column] = {}
    layers: dict[str, np.ndarray] = {}
    names = [str(v["name"]) for v in copied.view["verticals"]]
    for name in track(names, "copying columns"):
        columns[name], layers = column(copied.run, copied.x, name)
    return columns, layers


def periods(run: ExploredRun) -> np.ndarray:
    """Return the orbit period of each cell; 0 if the cell is not periodic."""
    return np.asarray(run.cube()["orbit_period"].values).ravel()


def add_all_orbits(copied: Copied, columns: Mapping[str, Column], layers: Mapping[str, np.ndarray], room: Room) -> int:
    """Integrate one orbit per attractor and parameter point, and add it to an export. Return the number of orbits."""
    run = copied.run
    count = columns[next(iter(columns))].count
    known = {**layers, "orbit_period": periods(run)}
    return add_orbits(copied, lambda n: choose(run, known, count, n), count, room)


def finished(copied: Copied) -> dict[str, bytes]:
    """Return all packed data of an export by name, with the description of the run."""
    about = {**copied.about, "notice": notice(copied)}
    return {"view": zip_json({"view": copied.view, "about": about}), **copied.objects}


def notice(copied: Copied) -> str:
    """Return the notes that an exported page shows to its reader."""
    view = copied.view
    first = (
        f"This is a copy of the run {view['name']} (digest {view['digest'][:12]}), made by "
        f"magpend {view['version']}. Nothing is computed here: live integration is off."
    )
    return " ".join([first, *copied.sentences])


INDEX, LIST, DATA, LICENCES = "index.html", "objects.json", "data", "LICENSES.txt"

QUANTITY = "quantity_"
"""What the names of quantities in the cube begin with."""


def export_folder(
    source: RunDirectory, out: Path, *, force: bool = False, quantities: Sequence[str] = (), most_orbits: int = 2000
) -> Exported:
    """Write the interactive page of a run, and its data, as a folder that any static web host can serve.

    In it are the page, the cube with its metadata in one file and its chunks cut by columns, and
    ``objects.json`` with the sha256 of every object, whose own sha256 stands in the page.

    Parameters
    ----------
    source
        An opened run. What is not committed reads as pending in the new cube, too.
    out
        Folder to make.
    force
        Whether a folder that an export has made there makes way; nothing else does.
    quantities
        Those of the model that can be on the vertical axis, besides states and kept extremes.
    most_orbits
        Orbits that are integrated for it, one for each attractor at each parameter point.

    Raises
    ------
    SpecError
        If the model has no such quantity.
    RefusedError
        If something is at its place, or nothing can be written there.
    DamagedError
        If what is read of the run is not what was written.
    """
    check_folder(out, force)
    temporary = temporary_beside(out)
    try:
        with writing(out):
            temporary.mkdir()
            exported = _write_folder(ExploredRun.open(source), temporary, quantities, most_orbits)
        if out.exists():
            before = temporary_beside(out)
            out.rename(before)
            temporary.rename(out)
            remove_tree(before)
        else:
            temporary.rename(out)
        sync_folder(out.parent)
    except BaseException:
        remove_tree(temporary)
        raise
    return Exported(out, exported.size, exported.orbits, exported.sentences)


def check_folder(out: Path, force: bool) -> None:
    """Raise RefusedError if a folder exists already or cannot be written, before anything is computed."""
    refuse_place(out.parent)
    _check_new(out, force)
    own = {INDEX, LIST, DATA, LICENCES, CUBE}
    if out.is_symlink() or (out.exists() and (not out.is_dir() or {p.name for p in out.iterdir()} - own)):
        raise RefusedError(f"{out}: is not a folder that magpend export has made, so --force leaves it; remove it.")


def _write_folder(run: ExploredRun, folder: Path, quantities: Sequence[str], most_orbits: int) -> Exported:
    most_bytes = 500_000_000  # of what orbits, and planes, may take of a folder each
    copied = gather(run, quantities)
    columns, codes = read_columns(copied)
    add_planes(copied, most_bytes)
    orbits = add_all_orbits(copied, columns, codes, Room(most_orbits, most_bytes, brief=False))
    layers = _layers_of(copied, codes)
    for name in columns:
        if name in quantities:
            layers[f"{QUANTITY}{name}"] = _quantity(run, name, columns[name])
            copied.about["columns"][name] = {"variable": f"{QUANTITY}{name}", "own": [None]}
        else:
            variable, own = place_of(run, vertical(run, name))
            copied.about["columns"][name] = {"variable": variable, "own": own}
    along = next((a.name for a in run.axes if a.swept), None)
    entries = write_cube(run, folder, along, layers)
    (folder / DATA).mkdir()
    for name, content in finished(copied).items():
        key = f"{DATA}/{name}.bin"
        (folder / key).write_bytes(content)
        entries[key] = entry_of(content)
    listed = json.dumps(entries, sort_keys=True, separators=(",", ":")).encode()
    (folder / LIST).write_bytes(listed)
    digest = hashlib.sha256(listed).hexdigest()
    html = folder_html(run.info.title, f"magpend {copied.view['version']}", digest).encode()
    (folder / INDEX).write_bytes(html)
    # code of others is in the page's script
    licences = static_text(LICENCES).encode()
    (folder / LICENCES).write_bytes(licences)
    size = sum(entry["size"] for entry in entries.values()) + len(listed) + len(html) + len(licences)
    return Exported(folder, size, orbits, copied.sentences)


def _quantity(run: ExploredRun, name: str, column: Column) -> Layer:
    """Return a quantity of the model at the drawn section points, in the shape of the cube; NaN elsewhere."""
    values = np.full((run.plan.n_cells, run.n_keep), np.nan)
    values[np.arange(run.n_keep) < column.count[:, None]] = column.y
    quantity = run.model.quantity(name)
    attrs = {"long_name": f"{quantity.meaning}, at the sections that are drawn", "units": quantity.unit}
    return Layer(values.reshape(*run.plan.shape, run.n_keep), attrs, ("period_index",))


def _layers_of(copied: Copied, layers: dict[str, np.ndarray]) -> dict[str, Layer]:
    """Return the colour codes of the cells in the shape of the result cube, with the meaning of each code."""
    shape = copied.run.plan.shape
    titles = {f"colour_{c['name']}": c for c in copied.view["colours"]}
    return {
        name: Layer(
            values.reshape(shape),
            {
                "long_name": titles[name]["title"],
                "flag_values": [c["id"] for c in titles[name]["categories"]],
                "comment": "; ".join(f"{c['id']} {c['label']}" for c in titles[name]["categories"]),
            },
        )
        for name, values in layers.items()
        if name != "status"
    }
