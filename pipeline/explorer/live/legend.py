"""Give names and colours to the attractors that live trajectories reach, if possible those of the run's figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from magpend_core.status import Status
from pipeline.analysis.ragged import dims_of, isel
from pipeline.explorer.data.colours import rgb
from pipeline.explorer.live.catalog import Catalog, Entry
from pipeline.layout.vocabulary import ABSENT, ATTRACTS, EQUILIBRIUM, STABILITIES
from pipeline.plots.motions import COLOURS as MOTION_COLOURS
from pipeline.plots.palette import COLOURS, GREY_OF, GREYS, OTHERS, cast_of


class Legend:
    """Names and colours for the entries of a catalog of attractors.

    Parameters
    ----------
    catalog
        The entries.
    attractors
        Attractors of the run; None if they are not known.
    """

    def __init__(self, catalog: Catalog, attractors: xr.Dataset | None) -> None:
        self._catalog, self._model = catalog, catalog.model
        self._known = attractors is not None
        ids = [e.attractor for e in catalog.entries if e.attractor is not None]
        self._names: dict[int, str] = {}
        self._colours: dict[int, str] = {}
        if attractors is not None:
            index = catalog.place.index
            part = attractors if index is None else isel(attractors, dict(zip(dims_of(attractors), index, strict=True)))
            cast = cast_of(attractors, part)
            self._names, self._colours = cast.names, cast.colours
        taken = {self._colours[i] for i in ids}
        self._free = [colour for colour in COLOURS if colour not in taken] or [OTHERS]

    def lines(self) -> list[dict[str, Any]]:
        """Return the number, label, colour and attractor id of every catalog entry, sorted by number."""
        new = 0
        found: list[dict[str, Any]] = []
        for entry in sorted(list(self._catalog.entries), key=lambda e: e.number):
            colour = self._colour(entry, new)
            new += entry.attractor is None and entry.kind != ABSENT and entry.stability == ATTRACTS
            name = self.name(entry)
            again = sum(line["label"].partition(" #")[0] == name for line in found)
            found.append(
                {
                    "id": entry.number,
                    "label": f"{name} #{again + 1}" if again else name,
                    "colour": colour,
                    "attractor": entry.attractor,
                }
            )
        return found

    def line(self, entry: Entry) -> dict[str, Any]:
        """Return the number, label, colour and attractor id of one catalog entry."""
        return next(line for line in self.lines() if line["id"] == entry.number)

    def name(self, entry: Entry) -> str:
        """Return the name of a catalog entry, such as ``period 3``."""
        if entry.attractor is not None:
            return self._names[entry.attractor]
        if entry.status:
            return _status_word(entry.status)
        if entry.kind == EQUILIBRIUM:
            told = "at rest"
        elif entry.period:
            told = f"period {entry.period}"
        elif np.isfinite(entry.seconds):
            told = f"limit cycle ({entry.seconds:.4g} s)"
        else:
            told = "not periodic"
        motion = self.motion(entry.motion)
        text = ", ".join(filter(None, (told, motion, _shown(entry.stability))))
        return f"not among the run's: {text}" if self._known and entry.kind != ABSENT else text

    def motion(self, code: int) -> str:
        """Return the name of a class of motion from its code; an empty text if it has none."""
        classifier = self._model.classifier
        if classifier is None or not code or code in classifier.neutral:
            return ""
        return classifier.words[code]

    def _colour(self, entry: Entry, new: int) -> str:
        if entry.status:
            return rgb(GREYS.get(_status_word(entry.status), GREYS["failed"]))
        if entry.kind != ABSENT and entry.stability in GREY_OF:
            return rgb(GREY_OF[entry.stability])
        if entry.attractor is not None:
            return self._colours[entry.attractor]
        if entry.kind != ABSENT:
            return self._free[new % len(self._free)]
        motion = self.motion(entry.motion)
        # paler than any attractor's: a class of cells is none
        return (
            _pale(rgb(MOTION_COLOURS[(entry.motion - 1) % len(MOTION_COLOURS)]))
            if motion
            else rgb(GREYS["not settled"])
        )


def _status_word(status: int) -> str:
    if status in (Status.STEP_LIMIT, Status.STEP_UNDERFLOW, Status.UNREACHED):
        return "failed"
    return Status(status).name.lower().replace("_", " ")


def _shown(stability: int) -> str:
    return "" if stability in (0, ATTRACTS) else STABILITIES[stability].replace("_", " ")


def _pale(colour: str) -> str:
    parts = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return "#" + "".join(f"{(part + 2 * 235) // 3:02x}" for part in parts)
