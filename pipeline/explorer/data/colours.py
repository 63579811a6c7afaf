"""Define the colour schemes of a diagram: a code for each cell, and a label and a colour for each code."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from magpend_core.status import Status
from pipeline.layout.vocabulary import BRANCH, split_dims
from pipeline.plots import palette, style
from pipeline.plots.palette import motion_codes, motions_of
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import N_IDS

if TYPE_CHECKING:
    import xarray as xr

    from pipeline.explorer.data.explored import ExploredRun

NO_CODE = 65535
"""Code of a cell that has none."""


_DIRECTIONS = ("up", "down")

_STATUS = {
    Status.PERIODIC: style.BLUE,
    Status.BOUNDED: style.VERMILLION,
    Status.INFERRED: style.SKY,
    Status.DIVERGED: "#000000",
    Status.STEP_LIMIT: "#595959",
    Status.STEP_UNDERFLOW: "#595959",
    Status.UNREACHED: "#8C8C8C",
    Status.NO_RETURN: "#404040",
    Status.CHATTER: "#2E2619",
    Status.PENDING: "#BFBFBF",
}


@dataclass(frozen=True)
class Category:
    """One code of a colour scheme, with its label and its colour."""

    number: int
    label: str
    colour: str

    def describe(self) -> dict[str, Any]:
        """Return the code as a dictionary for the page."""
        return {"id": self.number, "label": self.label, "colour": self.colour}


@dataclass(frozen=True)
class Scheme:
    """A colour scheme for cells: a function that computes their codes, and the labels and colours of the codes."""

    name: str
    title: str
    categories: tuple[Category, ...]
    # ``codes(block)``: code of each cell of a loaded part of the cube, an array that broadcasts to those of
    # ``status``; negative for none
    codes: Callable[[xr.Dataset], xr.DataArray]
    needs: tuple[str, ...] = ()  # variables of the cube that `codes` reads besides ``status``

    def describe(self) -> dict[str, Any]:
        """Return the colour scheme as a dictionary for the page."""
        return {"name": self.name, "title": self.title, "categories": [c.describe() for c in self.categories]}


def schemes(run: ExploredRun) -> list[Scheme]:
    """Return the colour schemes that a run's diagram can have, the default first."""
    return run.remembered("schemes", lambda: list(_schemes(run)))


def _schemes(run: ExploredRun) -> Iterator[Scheme]:
    cube = run.cube()
    motions = motions_of(cube)
    if motions.told:
        yield Scheme(
            "motion",
            "motion",
            tuple(Category(c, motions.words[c], rgb(motions.colours[c])) for c in motions.drawn),
            lambda block: _told(motion_codes(block)),
            ("section", "turns"),
        )
    if (found := run.kept("attractors")) is not None:
        cast, (codes, others) = palette.cast_of(found), _ends(found)
        yield Scheme(
            "attractor",
            "attractor",
            (*(Category(i, cast.names[i], rgb(cast.colours[i])) for i in sorted(cast.names)), *others),
            lambda block: codes.isel({d: block[f"_{d}"].values for d in codes.dims}),
        )
    if BRANCH in run.plan.dims:
        present = [d for d in _DIRECTIONS if d in set(cube["direction"].values.tolist())]
        if len(present) > 1:
            yield Scheme(
                "direction",
                "direction of the walk",
                tuple(
                    Category(_DIRECTIONS.index(d), d, rgb(c))
                    for d, c in zip(present, (style.BLUE, style.ORANGE), strict=False)
                ),
                lambda block: _directions(block["direction"]),
            )
    yield from _seeds(run)
    yield Scheme(
        "status",
        "what became of the cell",
        tuple(Category(int(s), s.name.lower().replace("_", " "), rgb(c)) for s, c in _STATUS.items()),
        lambda block: block["status"],
    )


def _seeds(run: ExploredRun) -> Iterator[Scheme]:
    """Yield the colour scheme by initial state, if there are few initial states."""
    most = 64  # initial states that are told apart by colour: more could not be
    cube, dims = run.cube(), run.start_dims
    sizes = [run.plan.shape[run.plan.dims.index(d)] for d in dims]
    walked = BRANCH in dims
    count = int(cube["seed"].max()) + 1 if walked else int(np.prod(sizes, dtype=np.int64))
    if not 2 <= count <= most:
        return
    n_colours = len(palette.COLOURS)
    categories = tuple(Category(k, f"start {k}", rgb(palette.COLOURS[k % n_colours])) for k in range(count))

    def codes(block: xr.Dataset) -> xr.DataArray:
        if walked:
            return block["seed"]
        number = block[f"_{dims[0]}"]
        for dim, size in zip(dims[1:], sizes[1:], strict=True):
            number = number * size + block[f"_{dim}"]
        return number

    yield Scheme("seed", "initial state", categories, codes)


def _ends(found: xr.Dataset) -> tuple[xr.DataArray, tuple[Category, ...]]:
    """Return a code for each cell (its attractor, or a grey such as an unstable set), and the greys that occur.

    Cells that diverged, failed or are pending have none.
    """
    codes = outcomes(found).astype(np.int32)
    codes = codes.where(codes >= 0, -1)
    dims, starts = split_dims(codes)
    table, others = codes.transpose(*dims, *starts), []
    for name, which in palette.other_cells(found).items():
        if name in palette.SETS:
            number = int(found.attrs[N_IDS]) + list(palette.GREYS).index(name)
            table = table.where(~which, number)
            others.append(Category(number, name, rgb(palette.GREYS[name])))
    return table, tuple(others)


def _told(codes: xr.DataArray) -> xr.DataArray:
    return codes.where(codes > 0, -1)


def _directions(words: xr.DataArray) -> xr.DataArray:
    return words.copy(data=np.array([_DIRECTIONS.index(str(w)) for w in words.values], np.int16))


def rgb(colour: str) -> str:
    """Convert a matplotlib colour to ``#rrggbb``."""
    return style.as_hex(colour)
