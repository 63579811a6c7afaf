"""Say how complete a search was: of all orbits, or of all equilibria of a box, at values of the parameter; and which
ends are cut off.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import xarray as xr

from pipeline.layout.own_words import RATE, dims_in_own_words
from pipeline.layout.vocabulary import parameter_name
from pipeline.results.tabular import Row, aligned, counted, words_of
from pipeline.specification.tables import FREQUENCY

_VERDICTS = {
    "agrees": "as if none is missing",
    "missing": "orbits are missing",
    "diverged": "says nothing: cells diverged",
    "unfinished": "says nothing: cells are unfinished",
    "flow": "says nothing of a flow",
}


def _places(ds: xr.Dataset, dim: str) -> Iterator[tuple[xr.Dataset, Row]]:
    """Yield the results of a search at each place, and the parameter values there as words."""
    word = str(ds.attrs.get(RATE, FREQUENCY))
    own = [n for n in map(str, ds.data_vars) if n.startswith(f"{dim}_") and n not in (f"{dim}_value", f"{dim}_verdict")]
    axes = {f"{dim}_value": str(ds.attrs["parameter"]), **{n: n.removeprefix(f"{dim}_") for n in own}}
    for k in range(ds.sizes[dim]):
        one = ds.isel({dim: k})
        yield one, {parameter_name(dims_in_own_words([d], word)[0]): f"{float(one[n]):.7g}" for n, d in axes.items()}


def searched_lines(ds: xr.Dataset) -> list[str]:
    """Return text lines on the points at which all orbits were searched; none if there was no search."""
    if "searched_value" not in ds:
        return []
    rows = []
    for one, where in _places(ds, "searched"):
        told = {words_of(ds["index_verdict"])[code] for code in one["index_verdict"].values.tolist()}
        counts = zip(ds["times"].values.tolist(), one["n_orbits"].values, one["index_sum"].values, strict=True)
        rows.append(
            {
                **where,
                **{f"period {p}": f"{n} ({total:+d})" for p, n, total in counts},
                "coverage": f"{float(one['coverage']):.0%}" if np.isfinite(one["coverage"]) else "?",
                "sum": _VERDICTS["missing" if "missing" in told else told.pop()],
            }
        )
    head = ["", "all orbits searched: their number and, in brackets, the sum of their indices"]
    return [*head, *aligned(rows)]


_NUMBERS = {
    "proved": "proved by interval arithmetic",
    "border": "not proved: one lies on the border of the box; move the border",
    "undecided": "not proved: some touch or nearly touch",
    "jumps": "not proved: the rates jump",
    "no_text": "not proved: the model is no text",
}


def counted_lines(ds: xr.Dataset) -> list[str]:
    """Return text lines on the equilibria that were counted; none if there was no count."""
    if "box_verdict" not in ds:
        return []
    rows = [
        {
            **where,
            "equilibria": str(int(one["n_equilibria"])),
            "stable": str(int(one["n_stable_equilibria"])),
            "sum of indices": f"{int(one['equilibria_index_sum']):+d}",
            "their number": _NUMBERS[words_of(ds["box_verdict"])[int(one["box_verdict"])]],
        }
        for one, where in _places(ds, "box")
    ]
    return ["", f"all equilibria of the box, at {counted(len(rows), 'value')}", *aligned(rows)]


CUT = {"stuck": "stuck", "max_points": "after too many points", "bound": "at a bound"}
"""Ends at which branches and curves are cut off, with the words for figures."""


def cut_words(ds: xr.Dataset, chosen: Iterable[int] | None = None) -> str:
    """Return a short text on the ends at which branches or curves are cut off, for figures; empty if there is none."""
    lines = ds["parameter"].values
    found: dict[str, list[float]] = {why: [] for why in CUT}
    for i in range(len(lines)) if chosen is None else chosen:
        for name, point in (("first_end", 0), ("last_end", int(ds["n_points"].values[i]) - 1)):
            why = words_of(ds[name])[int(ds[name].values[i])]
            if why in found:
                found[why].append(float(lines[i, point]))
    told = [
        f"{len(at)} {CUT[why]}" + (f" ({', '.join(f'{x:.5g}' for x in sorted(set(at))[:3])})" if why != "bound" else "")
        for why, at in found.items()
        if at
    ]
    return f"ends: {', '.join(told)}" if told else ""
