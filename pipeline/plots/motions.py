"""Give names and colours to the classes of motion that a model's classifier distinguishes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from pipeline.analysis.sides import classify
from pipeline.layout.vocabulary import model_of
from pipeline.plots import style

COLOURS = (style.BLUE, style.VERMILLION, style.GREEN, style.PURPLE, style.ORANGE, style.SKY, "#5B3A1E", "#332288")
"""Of the words of a classifier, in their order; a ninth begins again."""

PLAIN = "#1A3A5C"
"""Colour of all motions where nothing tells them apart."""


@dataclass(frozen=True)
class Motions:
    """Names and colours of the classes of motion of a run, by code.

    Attributes
    ----------
    drawn : tuple of int
        Codes in the order of legends: motions, then what is neutral.
    """

    words: tuple[str, ...]
    colours: tuple[str, ...]
    drawn: tuple[int, ...]

    @property
    def told(self) -> bool:
        """Whether the model distinguishes classes of motion."""
        return len(self.words) > 1


def motions_of(ds: xr.Dataset) -> Motions:
    """Return the names and colours of a model's classes of motion; a model without a classifier has one class."""
    classifier = model_of(ds).classifier
    if classifier is None:
        plain = PLAIN if style.colours() == style.PALETTE else style.colours()[0]
        return Motions(("motion",), (plain,), (0,))
    own = [c for c in range(1, len(classifier.words)) if c not in classifier.neutral]
    colours = [style.GREY] * len(classifier.words)
    for k, code in enumerate(own):
        colours[code] = style.as_hex(COLOURS[k % len(COLOURS)])
    neutral = [c for c in range(1, len(classifier.words)) if c in classifier.neutral]
    return Motions(classifier.words, tuple(colours), (*own, *neutral))


def motion_codes(cells: xr.Dataset) -> xr.DataArray:
    """Return the class of motion of each cell, as a code."""
    found = classify(cells)
    return xr.zeros_like(cells["status"], dtype=np.int8) if found is None else found
