"""Export the interactive page of a run as a folder for any static web host; the page loads its data when needed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.explorer.copies.content import Column, Copied, add_planes, gather, place_of
from pipeline.explorer.copies.export import MOST_ORBITS, Exported, add_all_orbits, finished, read_columns
from pipeline.explorer.copies.html import folder_html, static_text
from pipeline.explorer.copies.orbits import Room
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.verticals import vertical
from pipeline.layout.writing import sync_folder, temporary_beside, writing
from pipeline.store.consolidate import Layer, write_cube
from pipeline.store.errors import RefusedError
from pipeline.store.files import CUBE, entry_of
from pipeline.store.local import refuse_place, remove_tree, unwritable
from pipeline.store.run import RunDirectory

INDEX, LIST, DATA, LICENCES = "index.html", "objects.json", "data", "LICENSES.txt"

QUANTITY = "quantity_"
"""What the names of quantities in the cube begin with."""

MOST_BYTES = 500_000_000
"""What orbits, and planes, may take of a folder each."""


def export_folder(
    source: RunDirectory,
    out: Path,
    *,
    force: bool = False,
    quantities: Sequence[str] = (),
    most_orbits: int = MOST_ORBITS,
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
            exported = _write(ExploredRun.of(source), temporary, quantities, most_orbits)
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
    """Raise RefusedError if a folder exists already or cannot be written, before anything is computed.

    Raises
    ------
    RefusedError
        Saying why.
    """
    if not out.parent.is_dir():
        raise RefusedError(f"{out.parent}: no such folder; make it first.")
    refuse_place(out.parent)
    if problem := unwritable(out.parent):
        raise RefusedError(f"{problem}; give another place.")
    if not (out.exists() or out.is_symlink()):
        return
    if not force:
        raise RefusedError(f"{out}: exists already and is not overwritten; give another name, or --force.")
    own = {INDEX, LIST, DATA, LICENCES, CUBE}
    if out.is_symlink() or not out.is_dir() or {p.name for p in out.iterdir()} - own:
        raise RefusedError(f"{out}: is not a folder that magpend export has made, so --force leaves it; remove it.")


def _write(run: ExploredRun, folder: Path, quantities: Sequence[str], most_orbits: int) -> Exported:
    copied = gather(run, quantities)
    columns, codes = read_columns(copied)
    add_planes(copied, MOST_BYTES)
    orbits = add_all_orbits(copied, columns, codes, Room(most_orbits, MOST_BYTES, brief=False))
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
    """Return a quantity of the model at the section points of the diagram, in the shape of the result cube; NaN
    elsewhere.
    """
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
