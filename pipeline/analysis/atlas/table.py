"""List what an atlas contains: its regions, the audit of its changes, and its curves."""

from __future__ import annotations

from collections import Counter

import numpy as np
import xarray as xr

from pipeline.analysis.atlas.ends import GOES_ON
from pipeline.analysis.branches.kinds import CURVE_KINDS, LABELS, NAMES
from pipeline.analysis.events.kinds import EVENTS, LIVES_ON, UNDECIDED
from pipeline.layout.vocabulary import letter
from pipeline.products.product import Table
from pipeline.results.tabular import Row, aligned, counted, plain, words_of

MOST = 12
"""Most lines of a kind that are printed; all are in --csv and --json."""


def audit_of(ds: xr.Dataset) -> dict[str, int]:
    """Count the changes of an atlas: seen, on curves, on lines, not found by cells, and not explained."""
    what = np.array(words_of(ds["what"]), object)[ds["what"].values] if ds.sizes["change"] else np.zeros(0, object)
    seen = what != GOES_ON
    on_curve = seen & (ds["on_curve"].values >= 0)
    unseen, open_ = what == LIVES_ON, what == UNDECIDED
    return {
        "seen": int(seen.sum()),
        "on_curves": int(on_curve.sum()),
        "on_lines": int((seen & ~on_curve & ~unseen & ~open_).sum()),
        "not_found": int(unseen.sum()),
        "not_explained": int(open_.sum()),
    }


def open_changes(ds: xr.Dataset) -> list[int]:
    """Return the numbers of the changes of an atlas that are not explained."""
    return np.flatnonzero(ds["what"].values == words_of(ds["what"]).index(UNDECIDED)).tolist()


def told_change(ds: xr.Dataset, change: int) -> str:
    """Return the attractor of a change and its place, as a text."""
    names = [(str(ds.attrs[f"{which}_parameter"]), f"change_{which}") for which in ("first", "second")]
    at = ", ".join(f"{name} {float(ds[place][change]):.6g}" for name, place in names)
    kind = plain(words_of(ds["change_set"])[int(ds["change_set"][change])])
    period = f" of period {int(ds['change_period'][change])}" if ds["change_period"][change] else ""
    return f"{letter(int(ds['change_attractor'][change]))}, {kind}{period}, at {at}"


def listed_kinds(ds: xr.Dataset) -> str:
    """Return the kinds of what explains the changes of an atlas, with the number of changes of each."""
    what = [words_of(ds["what"])[code] for code in ds["what"].values.tolist()]
    kinds = Counter(one for one in what if one not in (UNDECIDED, LIVES_ON, GOES_ON))
    return ", ".join(f"{n} {kind_text(kind)}" for kind, n in kinds.most_common())


def kind_text(kind: str) -> str:
    """Return what explains a change, as a text."""
    return EVENTS[kind].text if kind in EVENTS else plain(kind)


def atlas_table(ds: xr.Dataset) -> Table:
    """Return the table of an atlas: a row for each change, and lines on regions, audit and curves."""
    return Table(
        _rows(ds),
        [*_region_lines(ds), "", *_audit_lines(ds), *_searched_lines(ds), "", *_curve_lines(ds)],
        header=("attractor_id", "set", "period", "what", "curve", "line", "cells", "why"),
    )


def _rows(ds: xr.Dataset) -> list[Row]:
    names = [str(ds.attrs[f"{which}_parameter"]) for which in ("first", "second")]
    what, sets = words_of(ds["what"]), words_of(ds["change_set"])
    columns = {
        "attractor_id": ds["change_attractor"].values.tolist(),
        "set": [sets[code] for code in ds["change_set"].values.tolist()],
        "period": ds["change_period"].values.tolist(),
        "period_after": ds["period_after"].values.tolist(),
        "what": [what[code] for code in ds["what"].values.tolist()],
        "curve": ds["on_curve"].values.tolist(),
        "line": ds["on_line"].values.tolist(),
        "cells": ds["change_cells"].values.tolist(),
    }
    for role in ("change", "here", "there"):
        for name, which in zip(names, ("first", "second"), strict=True):
            columns[name if role == "change" else f"{role}_{name}"] = ds[f"{role}_{which}"].values.tolist()
    columns["why"] = [str(text) for text in ds["why"].values]
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _region_lines(ds: xr.Dataset) -> list[str]:
    n, thin = ds.sizes["region"], int(ds["is_thin"].sum())
    head = f"{counted(n, 'region')}, {counted(ds.sizes['curve'], 'curve')}, {counted(ds.sizes['line'], 'line')}"
    lines = [
        {
            "region": str(k),
            "of the plane": f"{100.0 * float(ds['area'][k]):.3g} %",
            "points": str(int(ds["region_points"][k])),
            "cells": f"{int(ds['region_cells'][k])}{' (too few for 1 %)' if ds['is_thin'][k] else ''}",
            "attractors": str(ds["region_label"].values[k]),
        }
        for k in range(min(n, MOST))
    ]
    more = [f"  and {n - MOST} smaller ones"] if n > MOST else []
    told = f"; in {thin} of them a basin of 1 % may be missing, as fewer than 299 cells are known there" if thin else ""
    return [f"{head}{told}", *aligned(lines), *more]


def _audit_lines(ds: xr.Dataset) -> list[str]:
    n = audit_of(ds)
    listed = listed_kinds(ds)
    lines = [
        f"{counted(n['seen'], 'change')} of attractors between neighbouring points",
        f"  explained: {n['on_curves']} on curves, {n['on_lines']} on lines{f' ({listed})' if listed else ''}",
        f"  not found by cells: {n['not_found']} (the orbit is stable at both points)",
        f"  not explained: {n['not_explained']}",
    ]
    left = open_changes(ds)
    lines += [f"    {told_change(ds, k)}: {ds['why'].values[k]}" for k in left[:MOST]]
    return lines + ([f"    and {len(left) - MOST} more"] if len(left) > MOST else [])


def _searched_lines(ds: xr.Dataset) -> list[str]:
    if "searched" not in ds.dims:
        return []
    missing = int((ds["index_verdict"].values == words_of(ds["index_verdict"]).index("missing")).sum())
    told = f"; at {counted(missing, 'point')} their indices show that some are missing" if missing else ""
    n, hidden = ds.sizes["searched"], int(ds["n_hidden"].sum())
    stable = f"{counted(hidden, 'stable orbit')} on which no cell ends"
    return ["", f"all orbits were searched at {counted(n, 'point')}: {stable}{told}"]


def _curve_lines(ds: xr.Dataset) -> list[str]:
    lines = []
    for k in range(min(ds.sizes["curve"], 4 * MOST)):
        kind, period = CURVE_KINDS[int(ds["kind"][k])], int(ds["orbit_period"][k])
        crossed, effects = int(ds["n_crossed"][k]), int(ds["n_effects"][k])
        lines.append(
            {
                "curve": str(k),
                "": LABELS[kind],
                "kind": f"{NAMES[kind]}, {f'period {period}' if period else 'equilibria'}",
                "pairs with a change": f"{effects} of {crossed}",
                "elsewhere": str(ds["effect"].values[k]),
            }
        )
    return aligned(lines)
