"""Tell events in words, and tabulate them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from magpend_core.troubleshooting import see
from pipeline.analysis.events.graph import graph_of
from pipeline.analysis.events.kinds import EVENTS, LIVES_ON, RANGE_END, UNDECIDED
from pipeline.layout.vocabulary import letter, parameter_name
from pipeline.products.product import Table
from pipeline.results.outcomes import DIVERGED
from pipeline.results.tabular import (
    MOST_ROWS,
    Row,
    Words,
    aligned,
    counted,
    plain,
    value_with_error,
    values,
    with_interval,
)

_NAMES = (
    *("attractor", "set", "period", "period_after", "rises", "what", "criticality", "value", "value_error", "seen"),
    *("beyond", "bifurcation", "branch", "other_branch", "is_own", "n_cells", "ratio", "met_period", "exponent"),
    *("exponent_error", "rotation", "twin", "lives_beyond", "evidence"),
)


def events_table(ds: xr.Dataset) -> Table:
    """Return the table of events: a row for each, with its sentence and evidence.

    ``event`` is the number of its end that leads, see ``same_as`` in the schema; the sentence names the others.
    ``NAME`` and ``NAME_error`` are the value of the swept parameter and its error; ``seen`` and ``beyond`` are the
    values of the run between which cells leave the attractor, ``to_attractor`` is the id on which most of them go on.
    In JSON the table is a graph, see `pipeline.analysis.events.graph`.
    """
    ends = [_row(ds, k) for k in range(ds.sizes["event"])]
    rows = [_with_others(ds, row, ends) for k, row in enumerate(ends) if row["event"] == k]
    own = [row for row in rows if row["what"] not in (RANGE_END, LIVES_ON)]
    n_open = sum(row["what"] == UNDECIDED for row in own)
    lines = [f"{counted(len(own), 'event')}, {n_open} not decided{' ' + see('not-decided') if n_open else ''}"]
    told = [row for row in rows if row["what"] != RANGE_END]
    lines += [f"  {row['sentence']}" for row in told[:MOST_ROWS]]
    if len(told) > MOST_ROWS:
        lines.append(f"  and {len(told) - MOST_ROWS} more; all are in --csv and --json")
    bounds = sorted({(row["seen"], row["attractor"]) for row in rows if row["what"] == RANGE_END})
    for end in dict.fromkeys(x for x, _ in bounds):
        ids = ", ".join(letter(i) for x, i in bounds if x == end)
        lines.append(f"the range ends at {parameter_name(str(ds.attrs['parameter']))} = {end:.10g}: {ids}")
    if ds.attrs.get("refined"):
        more = f"{counted(int(ds.attrs['n_further']), 'further value')} of {parameter_name(str(ds.attrs['parameter']))}"
        lines.append(f"rests on {more} in {ds.attrs['refined']}, whose letters these are")
    graph = graph_of(ds, ends, rows)
    nodes = [node for node in graph["nodes"] if "attractor" in node]
    length = max(node["high"] for node in nodes) - min(node["low"] for node in nodes) if nodes else 1.0
    digits = int(9 - np.floor(np.log10(length or 1.0)))
    lines += aligned([_node_words(node, str(ds.attrs["parameter_units"]), digits) for node in nodes[:MOST_ROWS]])
    name = parameter_name(str(ds.attrs["parameter"]))
    named = {"value": name, "value_error": f"{name}_error"}
    rows = [{named.get(key, key): value for key, value in row.items()} for row in rows]
    return Table(rows, lines, "" if rows else "no cell ends on an attractor", graph)


def _node_words(node: Row, unit: str, digits: int) -> Words:
    """Return a line on an attractor: where it lives, and its basin fractions at both ends."""
    words = {"attractor": f"{node['name']} ({_own(node)})"}
    for end, head in (("low", "from"), ("high", "to")):
        words[head + ("" if unit == "1" else f" {unit}")] = f"{round(node[end], digits) + 0.0:.10g}"
    for end, head in (("low", "first"), ("high", "last")):
        if f"{end}_side" in node:
            words[f"{head} side"] = plain(node[f"{end}_side"])
        if f"{end}_fraction" in node:
            names = [f"{end}_fraction{name}" for name in ("", "_low", "_high")]
            words[f"{head} fraction"] = with_interval(node, names, ".4f")
    return words


def _own(row: Row) -> str:
    return f"period {row['period']}" if row["period"] else plain(row["set"])


def _row(ds: xr.Dataset, k: int) -> Row:
    """Return the row of an end, with the number of its event."""
    one = ds.isel(event=k)
    row = {"event": int(one["same_as"]), **values(one, *_NAMES)}
    to, cells = one["to_attractor"].values.tolist(), one["to_cells"].values.tolist()
    row |= {"to_attractor": to[0], "to_cells": cells[0]}
    return {"label": EVENTS[row["what"]].label, **row}


def _with_others(ds: xr.Dataset, row: Row, ends: Sequence[Row]) -> Row:
    """Return the row of an event, whose sentence names all attractors that begin, change or end there."""
    one = ds.isel(event=row["event"])
    to, cells = one["to_attractor"].values.tolist(), one["to_cells"].values.tolist()
    going = {i: n for i, n in zip(to, cells, strict=True) if n}
    doublings = [x for x in one["doublings"].values.tolist() if np.isfinite(x)]
    others = [end for k, end in enumerate(ends) if end["event"] == row["event"] != k]
    return {**row, "sentence": _sentence(ds, {**row, "doublings": doublings}, going, _where(row, others))}


def _where(row: Row, others: Sequence[Row]) -> str:
    """Say which other attractors begin, change or end at an event."""
    begin = [f"{letter(end['attractor'])} ({_own(end)})" for end in others if end["rises"] != row["rises"]]
    same = [f"{letter(end['attractor'])} ({_own(end)})" for end in others if end["rises"] == row["rises"]]
    told = [f"{' and '.join(begin)} begin{'s' * (len(begin) == 1)}"] if begin else []
    verb = "change" if row["period_after"] >= 0 else "end"
    told += [f"{' and '.join(same)} {verb}{'s' * (len(same) == 1)} too"] if same else []
    return f", where {' and '.join(told)}" if told else ""


def _sentence(ds: xr.Dataset, row: Row, to: dict[int, int], where: str) -> str:
    name, unit = parameter_name(str(ds.attrs["parameter"])), str(ds.attrs["parameter_units"])
    unit = "" if unit == "1" else f" {unit}"
    own, way = _own(row), "rises" if row["rises"] else "falls"
    who, seen, beyond = f"{letter(row['attractor'])} ({own})", row["seen"], row["beyond"]
    cells = f"; {_going_on(row['attractor'], to)}" if to else ""
    if row["what"] == RANGE_END:
        return f"{who} reaches the end of the range, {name} = {seen:.10g}{unit}"
    if row["what"] == LIVES_ON:
        return f"{who} stays stable as {name} {way} beyond {seen:.10g}{unit}, but no cell finds it{cells}"
    if row["what"] == UNDECIDED:
        where = " and ".join(f"{x:.10g}" for x in sorted((seen, beyond)))
        return f"{who} ends between {name} = {where}{unit} as it {way}: not decided ({row['evidence']}){cells}"
    kind, at = EVENTS[row["what"]], f"{name} = {value_with_error(row['value'], row['value_error'])}{unit}"
    if row["period_after"] == row["period"] or (row["period_after"] >= 0 and kind.two_sided):
        return f"{who} changes at {at} as it {way}: {kind.told(row)}{where}"
    if row["period_after"] >= 0:
        changes = f"{letter(row['attractor'])} changes from {own} to period {row['period_after']}"
        return f"{changes} at {at} as it {way}: {kind.told(row)}{where}"
    late = (row["value"] - beyond) * (1 if row["rises"] else -1) > row["value_error"]
    unseen = f" (no cell finds it beyond {seen:.10g})" if late else ""
    return f"{who} ends at {at} as it {way}{unseen}: {kind.told(row)}{where}{cells}"


def _going_on(attractor: int, to: dict[int, int]) -> str:
    words = {DIVERGED: "diverge", -1: "reach no attractor", attractor: "stay"}
    parts = [(words.get(i, f"go on to {letter(i)}"), n) for i, n in to.items()]
    if len(parts) == 1:
        return f"its cells {parts[0][0]}"
    return "of its cells " + ", ".join(f"{n} {text}" for text, n in parts)
