"""Define the analyses ``identified`` and ``attractors`` of a run, and tabulate attractors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from magpend_core.troubleshooting import see
from pipeline.analysis.attractors.declaration import AttractorOptions, IdentifyOptions
from pipeline.layout.small_states import small_states
from pipeline.layout.vocabulary import ATTRACTS, STABILITIES, letter, model_of, split_dims
from pipeline.products.product import Table
from pipeline.results.intervals import binomial_interval
from pipeline.results.outcomes import other_cells, pointed, sentence, share_interval, shares_of_others
from pipeline.results.ragged import N_IDS, N_POINTS, ROW_SIZE, SAMPLE, SET, places_of_rows, row_of_cells
from pipeline.results.run import OpenRun
from pipeline.results.tabular import (
    FEW_POINTS,
    FRACTION,
    Row,
    Words,
    counted,
    distinct,
    in_scale,
    largest_share,
    leading,
    number,
    plain,
    point_table,
    points_of,
    ranges,
    state_columns,
    summary,
    with_interval,
    words_of,
)

if TYPE_CHECKING:
    from magpend_core.models.model import Model


RUN_AWAY = {"diverged", "growing", "not settled"}
"""What is said of cells one of whose states grows without bound, as an angle does that is not declared."""

_NUMBERS = ("lyapunov_max", "lyapunov_low", "lyapunov_high", "mean_lifetime", "lifetime_low", "lifetime_high")


WITHOUT_DIGITS = "without_digits"
"""Attribute with a line for each state that falls below the run's `atol` and comes back."""


def identified(run: OpenRun, options: IdentifyOptions) -> xr.Dataset:
    """Find the attractors of a run at each parameter point, without ids that connect the points."""
    from pipeline.analysis.attractors.attractors import identify

    return identify(run.cube(), options)


def attractors(run: OpenRun, options: AttractorOptions) -> xr.Dataset:
    """Find the attractors of a run, and give them ids that stay the same along the swept parameters."""
    from pipeline.analysis.attractors.attractors import match

    found = run.derive("identified", **options.part(IdentifyOptions))
    found = match(found, threshold=options.threshold, look_back=options.look_back, connect=options.connect)
    return found.assign_attrs({WITHOUT_DIGITS: "\n".join(small_states(run.spec.values, run.cube))})


def attractors_table(ds: xr.Dataset) -> Table:
    """Return the table of attractors. It has rows per parameter point or, if there are many points, per attractor
    id.
    """
    rows = _rows(ds)
    dims, _ = split_dims(ds["attractor_id"])
    n_points = int(np.prod([ds.sizes[d] for d in dims]))
    attracting = np.unique(ds["attractor"].values[ds["stability"].values == ATTRACTS])
    model = model_of(ds)
    n, others = attracting.size, int(ds.attrs[N_IDS]) - attracting.size
    lines = [f"{counted(n, 'attractor')} at {counted(n_points, 'parameter point')}"]
    if others:
        lines[0] += f", and {counted(others, 'other set')} on which cells end"
    if n_points > FEW_POINTS:
        shown, more = _largest(rows)
        lines += [*summary(ds, shown, dims, _id_summary, "attractor_id"), *more]
    else:
        rest = _others_lines(ds)
        for i, (_, where) in enumerate(points_of(ds, dims)):
            shown, more = _largest([row for row in rows if all(row[k] == v for k, v in where.items())])
            table = point_table(ds, where, shown, lambda row: _attractor_words(row, n_points, model))
            lines += [*table, *more, *rest[i]]
    return Table(rows, [*lines, pointed(sentence(ds), bool(other_cells(ds))), *_remarks(ds, rows)])


def _largest(rows: Sequence[Row]) -> tuple[list[Row], list[str]]:
    """Return the rows of the ids with the largest shares or the most cells, and a line on the others."""
    shown, n_others = leading(rows, "attractor_id", "n_cells")
    if not n_others:
        return shown, []
    kept = {row["attractor_id"] for row in shown}
    kinds = {row["attractor_id"]: row for row in reversed(rows) if row["attractor_id"] not in kept}
    period = {i: f" of period {row['orbit_period']}" if row["orbit_period"] else "" for i, row in kinds.items()}
    counts = Counter(f"{_kind(row)}{period[i]}" for i, row in kinds.items())
    told = ", ".join(f"{n} {name}" for name, n in counts.most_common())
    return shown, [f"  and {len(kinds)} smaller ones: {told}; all are in --csv and --json"]


def _others_lines(ds: xr.Dataset) -> list[list[str]]:
    """Return for each parameter point the lines with the share of the cells that end on no attractor, by reason."""
    n_points = int(np.prod([ds.sizes[d] for d in split_dims(ds["attractor_id"])[0]]))
    lines: list[list[str]] = [[] for _ in range(n_points)]
    n_cells = ds["attractor_id"].size // n_points
    for name, share in shares_of_others(ds).items() if _has_shares(ds) else ():
        low, high = binomial_interval(np.rint(share * n_cells), np.full(n_points, n_cells))
        for i in np.flatnonzero(share).tolist():
            row = {"fraction": share[i], "low": low[i], "high": high[i]}
            lines[i].append(f"  on no attractor: {with_interval(row, FRACTION, '.4f')} {name}")
    return lines


def _has_shares(ds: xr.Dataset) -> bool:
    """Return whether cells are a sample of initial conditions; the branches of a continuation are none."""
    return split_dims(ds["attractor_id"])[1] not in ((), ("branch",))


def _rows(ds: xr.Dataset) -> list[Row]:
    """Return one table row for each set (attractor or other) at each parameter point.

    `fraction` is a share of all cells, with its interval; it is NaN for a set that does not attract. The columns
    ``rest_REASON`` have the shares of the cells of this point that end on no attractor. A continuation has no
    fractions: its branches are no sample of initial conditions.
    """
    dims, start_dims = split_dims(ds["attractor_id"])
    columns = dict(zip(dims, (axis.astype(object) for axis in places_of_rows(ds, dims)), strict=True)) | _columns(ds)
    if _has_shares(ds):
        attracts, share = ds["stability"].values == ATTRACTS, ds["share"].values
        shares = (np.where(attracts, share, np.nan), *share_interval(ds["n_cells"].values, share))
        columns |= {name: values.astype(object) for name, values in zip(FRACTION, shares, strict=True)}
        point = np.repeat(np.arange(ds[ROW_SIZE].size), ds[ROW_SIZE].values.ravel())
        rest = shares_of_others(ds)
        columns |= {f"rest_{name.replace(' ', '_')}": share[point].astype(object) for name, share in rest.items()}
    words = words_of(ds["decision"])
    decided = np.zeros((ds.sizes[SET], len(words)), np.int64)
    cells = row_of_cells(ds)
    how = ds["decision"].transpose(*dims, *start_dims).values
    np.add.at(decided, (cells[cells >= 0], how[cells >= 0]), 1)
    columns |= {f"by_{name}": decided[:, k].astype(object) for k, name in enumerate(words) if k}
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _columns(ds: xr.Dataset) -> dict[str, np.ndarray]:
    """Return the table's columns, one Python object for each row of a set, without the quantities that the model
    lacks.
    """
    found: dict[str, np.ndarray] = {}

    def array_of(name: str) -> np.ndarray:
        return np.asarray(ds[name].transpose(SET, ...).values)

    def add(*names: str) -> None:
        for name in names:
            if name in ds:
                labelled = "flag_meanings" in ds[name].attrs
                array = np.array(words_of(ds[name]), object)[array_of(name)] if labelled else array_of(name)
                found[name] = array.astype(object)

    found["attractor_id"] = ds["attractor"].values.astype(object)
    add("kind", "stability", "evidence", "orbit_period", "period_s", "side")
    if "rotation" in ds:
        dim = str(ds["rotation"].dims[-1])
        names = ds[dim].values if dim in ds.coords else range(ds.sizes[dim])
        parts = np.moveaxis(array_of("rotation").astype(object), -1, 0)
        found |= {f"rotation_{n}": part for n, part in zip(names, parts, strict=True)}
    size = np.hypot(array_of("multiplier_real"), array_of("multiplier_imag"))
    # of a limit cycle sampled at equal times the first is 1, along the flow, as a section omits it
    first = (found["orbit_period"] == 0).astype(int)[..., None]
    size = np.take_along_axis(np.pad(size, [(0, 0)] * (size.ndim - 1) + [(0, 1)], constant_values=np.nan), first, -1)
    largest = size[..., 0]
    found["multiplier_modulus"] = largest.astype(object)
    add("multiplier_error", *_NUMBERS, "n_sampled", "n_left", "closes_above", "dimension")
    confidence = float(ds.attrs.get("identify_lifetime_confidence", 0.95))
    found["lifetime_confidence"] = np.full(largest.shape, confidence, object)
    if "eigenvalue_real" in ds:
        found["eigenvalue_real"] = array_of("eigenvalue_real")[..., 0].astype(object)
        found["eigenvalue_imag"] = np.abs(array_of("eigenvalue_imag")[..., 0]).astype(object)
    add("mirror_partner", "mirror_distance", "n_cells", "match_basis")
    begins = np.cumsum(ds[N_POINTS].values) - ds[N_POINTS].values
    first = ds["attractor_points"].isel({SAMPLE: (SET, begins)})
    for part, array in (("section", first), ("min", ds["state_min"]), ("max", ds["state_max"])):
        for name in ds["state"].values:
            one = array.sel(state=name)
            found[f"{part}_{name}"] = one.values.astype(object)
    return found


def _remarks(ds: xr.Dataset, rows: Sequence[Row]) -> list[str]:
    """Return the remarks below the table, for instance that the flow is conservative or that the integration budget ran
    out.
    """
    lines, what = _growing_lines(ds), f"the {model_of(ds).clock.kind}"
    lines += ds.attrs.get(WITHOUT_DIGITS, "").splitlines()
    if any(row["evidence"] == "volume" for row in rows):
        if any(row["stability"] == STABILITIES[ATTRACTS] for row in rows):
            lines.append(f"{what} preserves volume on some sets: none of them attracts")
        else:
            lines.append(f"{what} preserves volume: a conservative system has no attractors")
        if any(row["evidence"] == "volume" and row["kind"] == "bounded_set" and row["n_cells"] > 1 for row in rows):
            lines.append("cells of a bounded set that is neutral are each on an orbit or a torus of their own")
    stayed = [row for row in rows if row["evidence"] == "stayed"]
    if stayed and ds[ROW_SIZE].size > FEW_POINTS:
        least = min(stayed, key=lambda row: float(row["lifetime_low"]))
        text = f"{number(least['lifetime_low'], '.0f')} {model_of(ds).clock.periods} {_confidence(least)}"
        lines.append(f"sets that attract by staying: lifetimes above {text}")
    above = sorted({row["closes_above"] for row in rows if row["closes_above"]})
    longest = int(ds.attrs.get("identify_max_orbit_period", 0))
    unsettled = [row for row in rows if row["stability"] == "not_settled"]
    if above:
        text = ", ".join(map(str, above))
        lines.append(
            f"cells return after {text} periods, which is above the longest detected period: --max-orbit-period "
            f"{above[-1]} (now {longest}) detects such orbits {see('not-settled')}"
        )
    elif any(row["kind"] == "bounded_set" and row["lyapunov_high"] < 0.0 for row in unsettled):
        lines.append(
            f"cells that are not settled contract: they may close with a period above {longest}; "
            f"--max-orbit-period detects longer ones {see('not-settled')}"
        )
    if int(ds.attrs.get("identify_extend", 1)) == 0 and unsettled:
        lines.append(f"nothing was extended (--no-extend): without it, samples are extended {see('not-settled')}")
    elif int(ds["ran_out"].sum()):
        n = int(ds["ran_out"].sum())
        lines.append(
            f"the extension reached its budget before all sets were classified at {counted(n, 'parameter point')}: "
            f"--budget {2.0 * float(ds.attrs.get('identify_budget', 1.0)):g} allows twice as much {see('not-settled')}"
        )
    if RUN_AWAY & set(other_cells(ds)):
        lines += model_of(ds).flow.angle_remarks
    return lines


def _growing_lines(ds: xr.Dataset) -> list[str]:
    """Return a line on the cells that grow, with the evidence, by the point with the fastest growth."""
    cells = other_cells(ds).get("growing")
    if cells is None:
        return []
    n, rates = int(cells.sum()), ds["growth_rate"].values
    at = np.unravel_index(int(np.nanargmax(rates)), rates.shape)
    factor, length = float(ds["growth_factor"].values[at]), int(ds["growth_length"].values[at])
    verbs = "grows without returning and is" if n == 1 else "grow without returning and are"
    return [
        f"{counted(n, 'cell')} {verbs} on no set: the distance from where they began grew {factor:.3g} times over "
        f"{length} sections, at the end at a rate of {rates[at]:.3g} per {model_of(ds).clock.unit}"
    ]


def _attractor_words(row: Row, n_points: int, model: Model) -> Words:
    turns = [f"{round(v, 3) + 0.0:.3f}" for k, v in row.items() if k.startswith("rotation_")]
    decided = [f"{n} {plain(k.removeprefix('by_'))}" for k, n in row.items() if k.startswith("by_") and n]
    flow = "eigenvalue_real" in row  # returns of a flow differ in length
    open_set = row["kind"] in ("torus", "chaotic_set", "bounded_set")
    words = {
        "id": str(row["attractor_id"]),
        "kind": _kind(row),
        "stability": plain(row["stability"]),
        "period": str(row["orbit_period"] or "-"),
        "seconds": number(row["period_s"], ".6g") if flow else None,
        "side": row.get("side"),
        "rotation": " ".join(turns) or None,
        "|multiplier|": number(row["multiplier_modulus"], ".4g" if flow else ".4f"),
        "eigenvalue": _eigenvalue(row) if flow else None,
        f"exponent per {model.clock.unit}": with_interval(row, _NUMBERS[:3], ".3g") if open_set else None,
        "cells": str(row["n_cells"]),
        "share": with_interval(row, FRACTION, ".4f") if "fraction" in row else None,
        "mirror": _known(row["mirror_partner"]) if "mirror_partner" in row else None,
        "letter": letter(row["attractor_id"]),
        "id by": plain(row["match_basis"]) if n_points > 1 and "match_basis" in row else None,
    }
    last = {"decided": ", ".join(decided), "shown by": _shown_by(row, model)}
    place = _place(row, model)
    columns = state_columns(place, [*words, *last])
    return {**words, **{columns[name]: text for name, text in place.items()}, **last}


def _place(row: Row, model: Model) -> Words:
    """Return the section point and, where it moves, the range of a set in each state, if the states are few."""
    most = 2  # states of a model whose places are printed; the CSV table has those of all models
    words = {}
    for x, scale in zip(model.state_names, model.scales, strict=True) if len(model.states) <= most else ():
        point, low, high = (in_scale(row[f"{part}_{x}"], scale) for part in ("section", "min", "max"))
        words[x] = point if low == high else f"{point} ({low} to {high})"
    return words


def _kind(row: Row) -> str:
    """Name the kind of a set, a torus with its dimension."""
    return f"{row['dimension']}-torus" if row["kind"] == "torus" else plain(row["kind"])


_SHOWN_BY = {
    "none": "-",
    "eigenvalues": "eigenvalues",
    "multipliers": "multipliers",
    "approach": "both sides come nearer",
    "volume": "volume preserved",
    "one_side": "one side comes nearer, the other leaves",
    "step_limit": "no orbit found: Newton's method met the step limit; raise max_steps_per_period",
    "no_return": "no orbit found: Newton's method lost the return; move the section, or raise section.longest",
    "no_convergence": "no orbit found: Newton's method did not converge; integrate longer, or with a smaller atol",
}


def _shown_by(row: Row, model: Model) -> str:
    low = number(row["lifetime_low"], ".0f")
    if row["evidence"] == "stayed":
        return f"{row['n_sampled']} stayed, lifetime above {low} {_confidence(row)}"
    if row["evidence"] == "left":
        high = number(row["lifetime_high"], ".0f")
        return f"{row['n_left']} of {row['n_sampled']} left, lifetime {low} to {high}"
    words = _SHOWN_BY[row["evidence"]]
    return f"{words}, or set rodas5p" if row["evidence"] == "step_limit" and model.method != "rodas5p" else words


def _confidence(row: Row) -> str:
    return f"({100.0 * row['lifetime_confidence']:g} %)"


def _eigenvalue(row: Row) -> str:
    if not np.isfinite(row["eigenvalue_real"]):
        return "-"
    imaginary = f" \u00b1 {row['eigenvalue_imag']:.4g}i" if row["eigenvalue_imag"] else ""
    return f"{row['eigenvalue_real']:.4g}{imaginary}"


def _id_summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> Words:
    first = rows[0]
    seconds = [r["period_s"] for r in rows if np.isfinite(r["period_s"])]
    span = f"{min(seconds):.4g} to {max(seconds):.4g}" if seconds else "-"
    return {
        "id": str(first["attractor_id"]),
        "kind": distinct(_kind(r) for r in rows),
        "stability": distinct(plain(r["stability"]) for r in rows),
        "periods": distinct(r["orbit_period"] for r in rows if r["orbit_period"]) or "-",
        "seconds": span if "eigenvalue_real" in first else None,
        "side": distinct(r["side"] for r in rows) if "side" in first else None,
        **ranges(ds, rows, dims),
        "cells": str(sum(r["n_cells"] for r in rows)),
        "letter": letter(first["attractor_id"]),
        "id rests on": _evidence([r["match_basis"] for r in rows]) if "match_basis" in first else None,
        "max share": largest_share(ds, rows, dims) if "fraction" in first else None,
        "mirror": _known(*(r["mirror_partner"] for r in rows)) if "mirror_partner" in first else None,
    }


def _known(*ids: int) -> str:
    return distinct(i for i in ids if i >= 0) or "-"


def _evidence(bases: Sequence[str]) -> str:
    """Summarise by what evidence an attractor got its id: followed branches, period doublings, or distance alone."""
    evidence = [basis for basis in bases if basis != "first_appearance"]
    told = [name for name in ("branch", "doubling") if name in evidence]
    n = evidence.count("distance")
    if n and not told:
        return "distance alone"
    return ", ".join(told + ([f"distance at {n} of {len(evidence)}"] if n else [])) or "-"
