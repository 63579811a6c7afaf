"""The graph of events: its nodes are the stretches of attractors, its edges are the events between them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.events.kinds import RANGE_END
from pipeline.layout.own_words import RATE
from pipeline.layout.vocabulary import letter, parameter_name
from pipeline.results.intervals import binomial_interval
from pipeline.results.outcomes import DIVERGED, outcomes
from pipeline.results.selection import start_dims
from pipeline.results.tabular import Row, values
from pipeline.specification.tables import FREQUENCY, RATES

NOWHERE = {DIVERGED: "diverged", -1: "no attractor"}
"""Nodes of cells that end on no attractor."""


def at_ends(
    ds: xr.Dataset,
    axis: str,
    order: np.ndarray,
    rows: Sequence[tuple[int, int]],
    places: Sequence[Sequence[tuple[int, Sequence[int]]]],
) -> dict[str, object]:
    """Return the class of motion and the basin fraction at the first and the last value of each stretch.

    Parameters
    ----------
    ds
        Attractors along one axis.
    axis, order
        Its name, and the positions on it by rising value.
    rows
        Rows of each stretch at both ends.
    places
        By stretch and end: place in `order`, and ids of the attractor there.

    Returns
    -------
    dict
        ``stretch_side`` if the model has a classifier; ``stretch_fraction`` of all cells of the point,
        with its 95 % Wilson interval as in the analysis ``basins``. The fractions are NaN where the cells of a
        parameter point are no independent starts.
    """
    dims, shape = ("stretch", "end"), (len(rows), 2)
    found: dict[str, object] = {}
    if "side" in ds:
        found["stretch_side"] = (dims, ds["side"].values[np.array(rows, int).reshape(shape)], ds["side"].attrs)
    ids = outcomes(ds).transpose(axis, ...).values[order].reshape(len(order), -1)
    count, total = np.zeros(shape), np.zeros(shape)
    for k, ends in enumerate(places):
        for end, (place, own) in enumerate(ends):
            count[k, end], total[k, end] = np.isin(ids[place], own).sum(), ids.shape[1]
    is_sweep = start_dims(ds) not in ([], ["branch"])
    for name, share in zip(("", "_low", "_high"), (count / total, *binomial_interval(count, total)), strict=True):
        found[f"stretch_fraction{name}"] = (dims, share if is_sweep else np.full(shape, np.nan))
    return found


def nodes_of(ds: xr.Dataset) -> list[Row]:
    """Return the nodes: a row for each stretch, with the names of the events at its two ends.

    ``low`` and ``high`` have the unit of the swept parameter. Fractions are those at the first and the last value with
    cells; they are left out in continuations.
    """
    ended: dict[tuple[int, int], str] = {}
    for k in range(ds.sizes["event"]):
        one = ds.isel(event=k)
        what, of, after, rises = (values(one, n)[n] for n in ("what", "stretch_of", "stretch_after", "rises"))
        ended[of, rises] = what
        if after >= 0:
            ended[after, 1 - rises] = what
    # as the frequency rises, the period falls
    is_period = RATES[str(ds.attrs.get(RATE, FREQUENCY))].inverse
    ends = {"low": int(is_period), "high": int(not is_period)}
    return [_node(ds.isel(stretch=k), k, ends, ended) for k in range(ds.sizes["stretch"])]


def _node(one: xr.Dataset, k: int, ends: Mapping[str, int], ended: Mapping[tuple[int, int], str]) -> Row:
    told = values(one, "stretch_attractor", "stretch_set", "stretch_period", "stretch_low", "stretch_high")
    row: Row = {"id": k, "name": letter(told["stretch_attractor"])}
    row |= {name.removeprefix("stretch_"): value for name, value in told.items()}
    row["low"], row["high"] = sorted((row["low"], row["high"]))
    for (word, end), rises in zip(ends.items(), (0, 1), strict=True):
        there = one.isel(end=end)
        row[f"{word}_event"] = ended.get((k, rises), "")
        row |= {f"{word}_side": side for side in values(there, "stretch_side").values()}
        share = values(there, *(f"stretch_fraction{name}" for name in ("", "_low", "_high")))
        row |= {name.replace("stretch", word): x for name, x in share.items() if np.isfinite(x)}
    return row


def graph_of(ds: xr.Dataset, ends: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the graph of events as node-link data, which ``networkx.node_link_graph(data, edges="edges")`` reads.

    Parameters
    ----------
    ds
        From the analysis ``events``.
    ends
        A row for each end of an attractor, with the number of its event.
    rows
        The table: a row for each event.

    Returns
    -------
    dict
        ``nodes`` as in `nodes_of`. ``edges``: from the stretch that ends to each stretch on which its cells go on, with
        their number ``cells``, the number of the ``event`` and the row of this end; ``sentence`` tells the event in
        words. Attractors that end or begin at one event have edges with one number. The ends of the range are no
        events. Nodes ``diverged`` and ``no attractor`` are there if cells end so.
    """
    told = {row["event"]: row["sentence"] for row in rows}
    edges = [edge for k, end in enumerate(ends) for edge in _edges(ds, {**end, "sentence": told[end["event"]]}, k)]
    nodes = nodes_of(ds)
    nodes += [{"id": name, "name": name} for name in NOWHERE.values() if any(e["target"] == name for e in edges)]
    name, unit = parameter_name(str(ds.attrs["parameter"])), str(ds.attrs["parameter_units"])
    about = {"parameter": name, "units": unit, "model": str(ds.attrs.get("model", ""))}
    return {"directed": True, "multigraph": True, "graph": about, "nodes": nodes, "edges": edges}


def _edges(ds: xr.Dataset, row: Mapping[str, Any], k: int) -> Iterator[Row]:
    """Yield the edges of an end; an end that no cell shows leads to the stretch beyond it, or to no attractor."""
    if row["what"] == RANGE_END:
        return
    to, cells = ds["to_stretch"].values[k].tolist(), ds["to_cells"].values[k].tolist()
    going: dict[int, int] = {}
    for stretch, n in zip(to, cells, strict=True):
        if n:
            going[stretch] = going.get(stretch, 0) + n
    after = int(ds["stretch_after"].values[k])
    if after >= 0 or not going:
        going.setdefault(after, 0)
    for key, (stretch, n) in enumerate(going.items()):
        target = NOWHERE.get(stretch, stretch)
        yield {"source": int(ds["stretch_of"].values[k]), "target": target, "key": f"{k}.{key}", "cells": n,
               **row}  # fmt: skip
