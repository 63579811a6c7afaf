"""Export a run's interactive page for a browser without a server, as one file or as a folder.

A copy computes nothing: its orbits were integrated when it was made, and it lists its gaps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline.explorer.copies.columns import Fitted, fit
from pipeline.explorer.copies.content import Column, Copied, add_planes, column, gather
from pipeline.explorer.copies.html import inline_html
from pipeline.explorer.copies.orbits import Room, add_orbits, choose
from pipeline.explorer.copies.packing import packed, packed_json
from pipeline.explorer.data.explored import ExploredRun
from pipeline.layout.writing import write_atomically
from pipeline.products.reporting import track
from pipeline.store.errors import RefusedError
from pipeline.store.local import refuse_place, unwritable
from pipeline.store.run import RunDirectory

MOST_BYTES = 20_000_000
"""Size of a copy in one file: beyond some 20 to 30 MB, browsers have trouble with a page."""

MOST_ORBITS = 2000

ORBITS_SHARE, PLANES_SHARE = 0.25, 0.15
"""What orbits and planes may take of a copy in one file."""

RESERVE = 10_000
"""For what the page says of its columns [bytes]."""


@dataclass(frozen=True)
class Exported:
    """Result of an export: its path, its size, its number of orbits, and notes for the user.

    Attributes
    ----------
    size : int
        Size of everything written [bytes].
    sentences : list of str
        Notes that the export shows to its readers.
    """

    path: Path
    size: int
    orbits: int
    sentences: list[str] = field(default_factory=list)


def export_page(
    source: RunDirectory,
    out: Path,
    *,
    force: bool = False,
    quantities: Sequence[str] = (),
    most_orbits: int = MOST_ORBITS,
    most_bytes: int = MOST_BYTES,
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
    copied = gather(ExploredRun.of(source), quantities)
    columns, layers = read_columns(copied)
    copied.objects["cells"] = packed(layers)
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
    generator = f"magpend {copied.view['version']}"
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
    """Raise RefusedError if a file exists already or cannot be written, before anything is computed.

    Raises
    ------
    RefusedError
        Saying why.
    """
    if not out.parent.is_dir():
        raise RefusedError(f"{out.parent}: no such folder; make it first.")
    refuse_place(out)
    if problem := unwritable(out.parent):
        raise RefusedError(f"{problem}; give another place.")
    if out.is_dir():
        raise RefusedError(f"{out}: is a folder; give a file.")
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
    return {"view": packed_json({"view": copied.view, "about": about}), **copied.objects}


def notice(copied: Copied) -> str:
    """Return the notes that an exported page shows to its reader."""
    view = copied.view
    first = (
        f"This is a copy of the run {view['name']} (digest {view['digest'][:12]}), made by "
        f"magpend {view['version']}. Nothing is computed here: live integration is off."
    )
    return " ".join([first, *copied.sentences])
