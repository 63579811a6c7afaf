"""Find hysteresis: attractors that a continuation meets in one direction only, and its jumps between attractors.

The functions read attractor ids and integrate nothing.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.attractors.declaration import HysteresisOptions
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import parameter_name
from pipeline.products.product import Table
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import dense
from pipeline.results.run import OpenRun
from pipeline.results.tabular import (
    Row,
    Words,
    aligned,
    counted,
    header_of,
    plain,
    unit_of,
    value_with_error,
    values,
    words_of,
)


def find_hysteresis(ds: xr.Dataset, ids: xr.Dataset) -> xr.Dataset:
    """Find where a continuation meets different attractors on its way up and on its way down.

    Parameters
    ----------
    ds
        Cube of a continuation in both directions. Its attribute ``path`` names the axis of the continuation;
        without it, the axis is the only parameter dim.
    ids
        Result of `match` for it.

    Returns
    -------
    Dataset
        ``present`` (parameter dims, direction, attractor): whether a branch of that direction is on
        the attractor. ``differs`` (parameter dims): whether the sets of ids of both directions
        differ, if both have any.

        A loop is a sequence of neighbouring points of the path that differ. Dim `loop`: ``loop_from``,
        ``loop_to`` (first and last value of the path), ``loop_points`` (number of points), ``only_up`` and
        ``only_down`` (loop, attractor: number of points where only that direction meets the attractor), and
        the values of the other parameters under their names with the prefix ``loop_at_``.

        A jump is a change of a branch's id between successive points of its continuation; points where the
        branch has no id are skipped. Dim `jump`, one row per kind: ``jump_from``, ``jump_to`` (values of the
        path), ``jump_direction`` (1 up, -1 down), ``jump_from_id``, ``jump_to_id``, ``jump_count``
        (branches).

        The attribute ``path`` names the axis.

    Raises
    ------
    ValueError
        If the cube has no branches in both directions.
    """
    check_directions(ds)
    ids = dense(ids)
    # ignore sets that do not attract and cells that diverge
    cells = outcomes(ids).clip(min=-1)
    dims = [str(d) for d in cells.dims if d != "branch"]
    path = str(ds.attrs.get("path", dims[0] if len(dims) == 1 else ""))
    if path not in dims:
        raise ValueError(f"path = {path!r} must be one of the dims {', '.join(dims)}; set ds.attrs['path'].")
    order = [*(d for d in dims if d != path), path]
    values = cells.transpose(*order, "branch").values
    direction = ds["direction"].values
    present = np.stack(
        [_presence(values[..., direction == d], ids.sizes["attractor"]) for d in ("up", "down")], axis=-2
    )
    differs = (present[..., 0, :] != present[..., 1, :]).any(axis=-1) & present.any(axis=-1).all(axis=-1)
    result = xr.Dataset(
        {"present": ((*order, "direction", "attractor"), present), "differs": (tuple(order), differs)},
        coords={
            **{d: ids[d] for d in order if d in ids.coords},
            "direction": ["up", "down"],
            "attractor": ids["attractor"],
        },
    )
    along = ids[path].values if path in ids.coords else np.arange(ids.sizes[path])
    return (
        result.assign(_loops(present, differs, along, order, ids))
        .assign(_jumps(values, direction, along))
        .transpose(*dims, ...)
        .assign_attrs(path=path)
    )


def check_directions(ds: xr.Dataset) -> None:
    """Raise ValueError unless the result cube is of a continuation both up and down its parameter."""
    if "branch" not in ds["status"].dims or set(ds["direction"].values) != {"up", "down"}:
        raise ValueError('hysteresis needs a continuation with direction = "both".')


def _presence(values: np.ndarray, n_ids: int) -> np.ndarray:
    return (
        np.stack([(values == i).any(axis=-1) for i in range(n_ids)], axis=-1)
        if n_ids
        else np.zeros((*values.shape[:-1], 0), bool)
    )


def _loops(
    present: np.ndarray, differs: np.ndarray, along: np.ndarray, order: list[str], ids: xr.Dataset
) -> dict[str, Any]:
    rows: list[tuple[tuple[int, ...], int, int]] = []
    for index in np.ndindex(*differs.shape[:-1]):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], differs[index], [False]]).astype(np.int8)))
        rows += [(index, int(a), int(b)) for a, b in edges.reshape(-1, 2)]
    up, down = present[..., 0, :], present[..., 1, :]
    n = present.shape[-1]

    def counts(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.array([(a[i][s:e] & ~b[i][s:e]).sum(axis=0) for i, s, e in rows], np.int64).reshape(len(rows), n)

    loops: dict[str, Any] = {
        "loop_from": ("loop", np.array([along[s] for _, s, _ in rows])),
        "loop_to": ("loop", np.array([along[e - 1] for _, _, e in rows])),
        "loop_points": ("loop", np.array([e - s for _, s, e in rows], np.int64)),
        "only_up": (("loop", "attractor"), counts(up, down)),
        "only_down": (("loop", "attractor"), counts(down, up)),
    }
    for k, name in enumerate(order[:-1]):
        values = [ids[name].values[i[k]] for i, _, _ in rows]
        loops[f"loop_at_{name}"] = ("loop", np.array(values), dict(ids[name].attrs))
    return loops


def _jumps(values: np.ndarray, direction: np.ndarray, along: np.ndarray) -> dict[str, Any]:
    found: dict[tuple[int, int, int, int, int], int] = {}
    for index in np.ndindex(*values.shape[:-2]):
        for branch, word in enumerate(direction):
            sign = 1 if word == "up" else -1
            line = values[index][::sign, branch]
            at = np.flatnonzero(line >= 0)
            for a, b in itertools.pairwise(at.tolist()):
                if line[a] != line[b]:
                    before, after = (a, b) if sign > 0 else (len(line) - 1 - a, len(line) - 1 - b)
                    key = (-sign, before, after, int(line[a]), int(line[b]))
                    found[key] = found.get(key, 0) + 1
    kinds = sorted(found)
    rows = np.array(kinds, np.int64).reshape(-1, 5)
    counts = np.array([found[kind] for kind in kinds], np.int64)
    columns = {
        "jump_from": along[rows[:, 1]],
        "jump_to": along[rows[:, 2]],
        "jump_direction": (-rows[:, 0]).astype(np.int8),
        "jump_from_id": rows[:, 3].astype(np.int32),
        "jump_to_id": rows[:, 4].astype(np.int32),
        "jump_count": counts,
    }
    return {name: ("jump", values) for name, values in columns.items()}


def needs_directions(run: OpenRun, options: HysteresisOptions) -> None:
    """Raise ValueError unless the run is a continuation both up and down its parameter."""
    check_directions(run.cube())
    if options.events and len(run.spec.axes) > 1:
        raise ValueError(f"--events: events lie along one parameter, and the run sweeps {', '.join(run.spec.axes)}.")


def hysteresis(run: OpenRun, options: HysteresisOptions) -> xr.Dataset:
    """Compute the hysteresis loops of a run and the jumps between its attractors, with their events if asked for."""
    found = find_hysteresis(run.cube(), run.derive("attractors"))
    if not options.events:
        return found
    return with_events(found, run.derive("events", parameter=parameter_name(found.attrs["path"])))


def with_events(ds: xr.Dataset, events: xr.Dataset) -> xr.Dataset:
    """Add to each jump the event at which its attractor ends: where branches fall off.

    Parameters
    ----------
    ds
        Result of `find_hysteresis`.
    events
        Result of the analysis ``events`` along its path.

    Returns
    -------
    Dataset
        With ``jump_event`` (number of the event), ``jump_what`` (its name), ``jump_value`` and ``jump_value_error``
        (its parameter value). If the attractor does not end between the two values of a jump, the number is -1 and the
        name ``none``: branches leave an attractor that others stay on, or that goes on in another stretch.
    """
    rises, ids, ends = (events[name].values for name in ("rises", "attractor", "seen"))
    jumps = zip(*(ds[f"jump_{name}"].values for name in ("direction", "from_id", "from")), strict=True)
    numbers = []
    for direction, i, x in jumps:
        own = np.flatnonzero((rises == (direction > 0)) & (ids == i) & (ends == x))
        numbers.append(int(events["same_as"].values[own[0]]) if own.size else -1)
    known = np.array(numbers, np.int64)
    names = words_of(events["what"])
    columns = {"what": np.where(known >= 0, events["what"].values[known] + 1, 0) if len(events["what"]) else known + 1}
    for name in ("value", "value_error"):
        columns[name] = np.append(events[name].values, np.nan)[known]
    added: dict[str, Any] = {f"jump_{name}": ("jump", column) for name, column in columns.items()}
    found = ds.assign({"jump_event": ("jump", known), **added})
    found["jump_what"].attrs = code_flags(["none", *names])
    return found


def hysteresis_table(ds: xr.Dataset) -> Table:
    """Return the table of hysteresis. It has one row per kind of jump between two attractors, and text lines about the
    loops.
    """
    names = [f"jump_{name}" for name in ("from", "to", "from_id", "to_id", "count", "what", "value", "value_error")]

    def row_of(one: xr.Dataset) -> Row:
        told = {name.removeprefix("jump_"): value for name, value in values(one, *names).items()}
        return {"direction": "up" if one["jump_direction"] > 0 else "down", **told}

    rows = [row_of(ds.isel(jump=i)) for i in range(ds.sizes["jump"])]
    path, n = ds.attrs["path"], ds.sizes["loop"]
    unit = f"{path}{unit_of(ds, path)}" if path in ds.coords else path
    words = [
        {
            "direction": r["direction"],
            f"from {unit}": f"{r['from']:g}",
            "to": f"{r['to']:g}",
            "ids": f"{r['from_id']} -> {r['to_id']}",
            "branches": str(r["count"]),
            "event": _event_words(r) if "what" in r else None,
        }
        for r in rows
    ]
    lines = [
        f"{counted(n, 'loop') if n else 'no loops'}: neighbouring points where up and down meet other attractors",
        *aligned([_loop_words(ds.isel(loop=i), unit) for i in range(n)]),
        f"jumps of the branches: {sum(row['count'] for row in rows) or 'none'}",
        *aligned(words),
    ]
    return Table(rows, lines, header=header_of(ds, "jump", row_of))


def _event_words(row: Row) -> str:
    if not np.isfinite(row["value"]):
        return plain(row["what"])
    return f"{plain(row['what'])} at {value_with_error(row['value'], row['value_error'])}"


def _loop_words(loop: xr.Dataset, unit: str) -> Words:
    return {
        **{str(n).removeprefix("loop_at_"): f"{float(loop[n]):g}" for n in loop if "loop_at_" in str(n)},
        f"from {unit}": f"{float(loop['loop_from']):g}",
        "to": f"{float(loop['loop_to']):g}",
        "only up": _met(loop["only_up"].values),
        "only down": _met(loop["only_down"].values),
        "points": str(int(loop["loop_points"])),
    }


def _met(counts: np.ndarray) -> str:
    """Format the ids of attractors, each with the number of parameter points at which a continuation was on it."""
    return ", ".join(f"{i} ({counted(counts[i], 'point')})" for i in np.flatnonzero(counts)) or "-"
