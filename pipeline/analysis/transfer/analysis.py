"""Analyse the transfer operator of a run's section map: slow sets, committors, passage times and rates of escape.

Rows are sets (dim ``set``, see `pipeline.results.ragged`); the boxes of a set are its samples (dim ``sample``). Steps
are drive periods or returns. `pipeline.analysis.transfer.declaration.TRANSFER_COLUMNS` lists the variables.

Intervals are percentiles of resamples: of whole cells if there are enough, else of stretches of cells. Sets and cores
stay those of all cells. ``_coarse`` is the number on boxes of twice the width: its distance from the number itself
shows the error of the grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from scipy.sparse import csr_array

from pipeline.analysis.noise.exits import PointCells, cells_at_points, coordinates_of, inputs_at, point_dims
from pipeline.analysis.transfer import ulam
from pipeline.analysis.transfer.declaration import TRANSFER_COLUMNS, TransferOptions
from pipeline.analysis.transfer.ulam import Chain, Grid
from pipeline.layout.columns import on_points
from pipeline.layout.vocabulary import letter, model_of
from pipeline.products.column import POINTS
from pipeline.products.product import Table
from pipeline.results.intervals import lifetime_interval
from pipeline.results.ragged import N_POINTS, ROW_SIZE, rows_at
from pipeline.results.run import OpenRun
from pipeline.results.selection import listed
from pipeline.results.tabular import Row, Words, aligned, number, points_of, with_interval
from pipeline.specification.problems import unknown_name

MOST_SETS = 16
"""Most sets of a parameter point: closed sets with the largest shares."""

MODES = 8
"""Slow eigenvalues that are kept."""


def needs_pairs(run: OpenRun, options: TransferOptions) -> None:
    """Raise ValueError unless the run is a sweep with pairs of sections, and the options name its states."""
    names = run.model.state_names
    for name in (*listed(options.states), *options.low, *options.high):
        if name not in names:
            raise ValueError(unknown_name("state", name, names))
    if run.spec.continuation is not None:
        raise ValueError("transfer needs a sweep: in a continuation, sections belong to moving parameters.")
    if not _has_starts(run) and run.spec.integration.n_keep < 2:
        raise ValueError("n_keep = 1 leaves no pair of sections; keep 2 or more, or take n_transient = 0.")
    for name in options.low.keys() & options.high.keys():
        if options.low[name] >= options.high[name]:
            raise ValueError(f"low and high of {name}: {options.low[name]:g} is not below {options.high[name]:g}.")


def _has_starts(run: OpenRun) -> bool:
    """Return whether initial states lie one step before the first stored section."""
    return run.spec.integration.n_transient == 0 and run.spec.motion.system.section is None


@dataclass(frozen=True)
class Pairs:
    """Successive sections at one parameter point."""

    before: np.ndarray  # (pair, state)
    after: np.ndarray  # (pair, state); NaN if the cell diverged
    unit: np.ndarray  # (pair,): number of the resampled unit


def pairs_of(run: OpenRun, cells: PointCells, columns: Sequence[int]) -> Pairs:
    """Return the pairs of successive sections of the cells of a parameter point, of some states.

    A cell that diverged has no sections, and counts only if it did so in its first step.
    """
    units = 50  # least number of resampled units; fewer cells are cut into stretches
    section = cells.section
    if _has_starts(run):
        section = np.concatenate([inputs_at(run, cells).initial_states[:, None], section], axis=1)
    before, after = section[:, :-1], section[:, 1:]
    n_cells, n = before.shape[:2]
    parts = max(1, -(-units // n_cells))
    unit = np.arange(n_cells)[:, None] * parts + np.arange(n) * parts // n
    known = np.isfinite(before).all(axis=2)
    known &= np.isfinite(after).all(axis=2) | (cells.n_periods == 1)[:, None]
    return Pairs(before[known][:, columns], after[known][:, columns], unit[known])


def grid_of(pairs: Pairs, names: Sequence[str], angles: Sequence[bool], options: TransferOptions) -> Grid:
    """Return even boxes over the range of all states, or over that of the options."""
    each = 25  # mean number of pairs in a box of the default grid
    both = np.concatenate([pairs.before, pairs.after])
    low, high = (np.array([f(both[:, i]) for i in range(len(names))]) for f in (np.nanmin, np.nanmax))
    circle = np.array(angles)
    free = circle & [name not in options.low and name not in options.high for name in names]
    margin = 1e-9 * np.maximum(high - low, 1e-9)
    low, high = np.where(free, -np.pi, low - margin), np.where(free, np.pi, high + margin)
    for k, name in enumerate(names):
        low[k], high[k] = options.low.get(name, low[k]), options.high.get(name, high[k])
    bins = options.bins or max(2, int((len(pairs.before) / each) ** (1.0 / len(names))))
    return Grid(low, high, np.full(len(names), bins), circle)


@dataclass(frozen=True)
class Sets:
    """Slow sets of a chain."""

    of_box: np.ndarray  # (box,): number of the set of each box, -1 none
    cores: list[np.ndarray]  # positions of boxes
    density: np.ndarray  # (box,): stationary measure
    n_closed: int
    values: np.ndarray  # (mode,): slow eigenvalues
    others: np.ndarray  # positions of boxes in further closed sets


def sets_of_chain(chain: Chain, options: TransferOptions) -> Sets:
    """Find the closed sets of a chain, or, if there are not two of them, its almost invariant sets."""
    n, p = len(chain.boxes), chain.p
    last = ulam.lasting(p)
    density, values = np.zeros(n), np.zeros(0, complex)
    if not len(last):
        return Sets(np.full(n, -1), [], density, 0, values, last)
    stays = ulam.conditioned(p[last][:, last])
    classes = sorted(ulam.closed_classes(stays), key=len, reverse=True)
    for own in classes:
        density[last[own]] = ulam.stationary(stays[own][:, own])
    closed = [last[own] for own in classes]
    if len(closed) > 1:
        cores = closed
    else:
        only = classes[0]
        values, vectors = ulam.slow_eigenvalues(stays[only][:, only], min(max(MODES, options.sets), len(only)))
        k = min(options.sets, len(values))
        belongs = ulam.memberships(values[:k], vectors[:, :k]).argmax(axis=1) if k > 1 else np.zeros(len(only), int)
        parts = [closed[0][belongs == j] for j in range(k)]
        cores = [_core(part, density, options.core) for part in parts if density[part].sum() > 0.0]
    reached = ulam.committors(p, cores)
    by_share = np.argsort(-reached.mean(axis=0), kind="stable")
    others = np.concatenate([last[:0], *(cores[k] for k in by_share[MOST_SETS:])])
    order = sorted(by_share[:MOST_SETS].tolist(), key=lambda k: float(chain.boxes[cores[k]].mean()))
    reached = reached[:, order]
    of_box = np.where(reached.max(axis=1) > 0.0, reached.argmax(axis=1), -1)
    n_closed = sum(bool(np.allclose(p[own].sum(axis=1), 1.0)) for own in closed)
    return Sets(of_box, [cores[k] for k in order], density, n_closed, values, others)


def _core(part: np.ndarray, density: np.ndarray, share: float) -> np.ndarray:
    """Return the boxes of highest density that hold a share of the measure of a set."""
    order = part[np.argsort(-density[part], kind="stable")]
    held = np.cumsum(density[order])
    return np.sort(order[: int(np.searchsorted(held, share * held[-1] * (1.0 - 1e-12))) + 1])


def numbers_of(p: Any, sets: Sets) -> dict[str, np.ndarray]:
    """Return committors, kept measure, rate of escape and mean passage times of the sets of a chain."""
    n = len(sets.cores)
    kept, escape_rate = np.full((2, n), np.nan)
    passage = np.full((n, MOST_SETS), np.nan)
    for k, core in enumerate(sets.cores):
        own = np.flatnonzero(sets.of_box == k)
        if len(own):  # not always on a coarser grid
            inner = p[own][:, own]
            rate = ulam.leading_eigenvalue(inner)
            escape_rate[k] = max(-np.log(rate), 0.0) if rate > 0.0 else np.inf
            kept[k] = _mean(inner.sum(axis=1), sets.density[own])
        steps = ulam.passage_times(p, core) if len(core) else np.full(len(sets.density), np.nan)
        for j, other in enumerate(sets.cores):
            if j != k:
                passage[j, k] = _mean(steps[other], sets.density[other])
    committor = ulam.committors(p, [*sets.cores, sets.others])[:, :n]
    return {"kept": kept, "escape_rate": escape_rate, "passage": passage, "committor": committor}


def _mean(values: np.ndarray, weight: np.ndarray) -> float:
    return float(weight @ values) / float(weight.sum()) if weight.sum() > 0.0 else np.nan


def coarsened(chain: Chain, grid: Grid, sets: Sets) -> dict[str, np.ndarray]:
    """Return the numbers on boxes of twice the width; each is in the set and the core that have most of its pairs."""
    halved = tuple((grid.places_of(chain.boxes) // 2).T)
    boxes, to = np.unique(np.ravel_multi_index(halved, tuple(-(-grid.bins // 2))), return_inverse=True)
    n, entries = len(boxes), chain.counts.tocoo()
    counts = csr_array((entries.data, (to[entries.row], to[entries.col])), shape=(n, n))
    counts.sum_duplicates()
    weight = np.asarray(chain.counts.sum(axis=1)) + chain.out

    def most(label: np.ndarray) -> np.ndarray:
        weights = np.zeros((n, int(label.max(initial=-1)) + 2))
        np.add.at(weights, (to, label + 1), weight)
        return np.asarray(weights.argmax(axis=1) - 1)

    in_core = np.full(len(chain.boxes), -1)
    for k, core in enumerate([*sets.cores, sets.others]):
        in_core[core] = k
    core_of, density = most(in_core), np.bincount(to, sets.density, n)
    *cores, others = (np.flatnonzero(core_of == k) for k in range(len(sets.cores) + 1))
    merged = replace(sets, of_box=most(sets.of_box), cores=cores, density=density, others=others)
    found = numbers_of(Chain(boxes, counts, np.bincount(to, chain.out, n), chain.unknown).p, merged)
    # one step on the fine boxes, later ones on the coarse: the boxes themselves are compared at one place
    reached = chain.p @ found["committor"][to]
    for k, core in enumerate(sets.cores):
        reached[core] = np.arange(len(sets.cores)) == k
    return found | {"committor": reached}


def intervals_of(
    boxes: tuple[np.ndarray, np.ndarray], unit: np.ndarray, chain: Chain, sets: Sets, options: TransferOptions
) -> dict[str, np.ndarray]:
    """Return the ends of the intervals of rates, passage times and committors, from resampled units."""
    rng, n_units = np.random.default_rng(options.seed), int(unit.max()) + 1
    there = np.unique(unit)
    drawn: dict[str, list[np.ndarray]] = {name: [] for name in _WITH_ENDS}
    for _ in range(options.resamples):
        weights = np.bincount(rng.choice(there, len(there)), minlength=n_units)[unit].astype(np.float64)
        found = numbers_of(ulam.chain_of(*boxes, weights).p, sets)
        for name, rows in drawn.items():
            rows.append(found[name])
    tail = 50.0 * (1.0 - options.confidence)
    ends: dict[str, np.ndarray] = {}
    for name, rows in drawn.items():
        both = np.percentile(np.stack(rows), [tail, 100.0 - tail], axis=0, method="nearest")
        ends |= {f"{name}_low": both[0], f"{name}_high": both[1]}
    for k in range(len(sets.cores)):
        own = sets.cores[k] if sets.n_closed > 1 else np.flatnonzero(sets.of_box == k)
        stayed, left = float(chain.counts[own][:, own].sum()), float((chain.counts.sum(axis=1) + chain.out)[own].sum())
        if stayed and left - stayed < 0.5:  # never left: the bound of a lifetime without an event
            ends["escape_rate_high"][k] = 1.0 / lifetime_interval(0, stayed, options.confidence)[0]
    return ends


def transfer(run: OpenRun, options: TransferOptions) -> xr.Dataset:
    """Estimate the transfer operator at each parameter point, see the module's schema."""
    cube, model = run.cube(), model_of(run.cube())
    names = listed(options.states) or list(model.state_names)
    columns = [model.state_names.index(name) for name in names]
    angles = [model.is_angle[i] for i in columns]
    parts = [_point(pairs_of(run, cells, columns), names, angles, options) for cells in cells_at_points(cube)]
    return _dataset(cube, names, parts, options)


def _point(pairs: Pairs, names: Sequence[str], angles: Sequence[bool], options: TransferOptions) -> dict[str, Any]:
    """Return all variables of one parameter point."""
    if not len(pairs.before):
        nothing = Sets(np.zeros(0, int), [], np.zeros(0), 0, np.zeros(0, complex), np.zeros(0, int))
        empty = Chain(np.zeros(0, int), csr_array((0, 0)), np.zeros(0), 0.0)
        unsized = np.full(len(names), np.nan)
        return _variables(empty, nothing, {}, np.zeros((0, len(names))), 0) | {"width": unsized}
    grid = grid_of(pairs, names, angles, options)
    boxes = grid.box_of(pairs.before), grid.box_of(pairs.after)
    chain = ulam.chain_of(*boxes)
    sets = sets_of_chain(chain, options)
    found = numbers_of(chain.p, sets) | intervals_of(boxes, pairs.unit, chain, sets, options)
    coarse = coarsened(chain, grid, sets)
    found |= {f"{name}_coarse": coarse[name] for name in _WITH_ENDS}
    n_pairs = int((boxes[0] != ulam.OUTSIDE).sum())
    variables = _variables(chain, sets, found, grid.centres_of(chain.boxes), n_pairs)
    return variables | {"width": (grid.high - grid.low) / grid.bins}


_WITH_ENDS = ("escape_rate", "passage", "committor")
"""Numbers that have an interval, and a value on coarser boxes."""

_RATES, _PASSAGES, _COMMITTORS = ([f"{name}{end}" for end in ("", "_low", "_high", "_coarse")] for name in _WITH_ENDS)
_REALS = (*_RATES, "kept")


def _variables(
    chain: Chain, sets: Sets, found: Mapping[str, np.ndarray], centres: np.ndarray, n_pairs: int
) -> dict[str, Any]:
    n = len(sets.cores)
    order = [np.flatnonzero(sets.of_box == k) for k in range(n)]
    boxes = np.concatenate([np.zeros(0, int), *order])
    is_core = np.zeros(len(chain.boxes), np.int8)
    is_core[np.concatenate([np.zeros(0, int), *sets.cores])] = 1
    values = np.full(MODES, complex(np.nan, np.nan))
    values[: len(sets.values[:MODES])] = sets.values[:MODES]
    measures = np.array([sets.density[own].sum() for own in order])
    of_box = np.concatenate([[0.0], measures])[sets.of_box + 1]
    density = np.divide(sets.density, of_box, out=np.zeros_like(sets.density), where=of_box > 0.0)
    reached = {name: found.get(name, np.zeros((len(chain.boxes), n))) for name in _COMMITTORS}
    return {
        "n_pairs": n_pairs,
        "n_boxes": len(chain.boxes),
        "outside": float(chain.out.sum()) / max(n_pairs, 1),
        "unknown": chain.unknown,
        "n_closed": sets.n_closed,
        "eigenvalue": values.real,
        "eigenvalue_imaginary": values.imag,
        ROW_SIZE: n,
        "is_closed": np.array([sets.n_closed > 1] * n, np.int8),
        "measure": np.full(n, np.nan) if sets.n_closed > 1 else measures / max(measures.sum(), 1e-300),
        "share": reached["committor"].mean(axis=0) if n else np.zeros(0),
        **{name: found.get(name, np.zeros(0)) for name in _REALS},
        **{name: found.get(name, np.zeros((0, MOST_SETS))) for name in _PASSAGES},
        N_POINTS: np.array([len(part) for part in order], np.int64),
        "place": centres[boxes],
        "density": density[boxes],
        **{name: one[boxes, sets.of_box[boxes]] if n else np.zeros(0) for name, one in reached.items()},
        "is_core": is_core[boxes],
    }


def _dataset(
    cube: xr.Dataset, names: Sequence[str], parts: Sequence[dict[str, Any]], options: TransferOptions
) -> xr.Dataset:
    model, dims = model_of(cube), point_dims(cube)
    shape = tuple(cube.sizes[d] for d in dims)
    of_points = {column.name for column in TRANSFER_COLUMNS if column.dims.startswith(POINTS)}
    values: dict[str, np.ndarray] = {}
    for name in parts[0]:
        rows = [np.asarray(part[name]) for part in parts]
        values[name] = np.stack(rows).reshape((*shape, *rows[0].shape)) if name in of_points else np.concatenate(rows)
    axis = {"axis": list(names), "unit": ("axis", [model.state(name).unit for name in names])}
    kept = ("model", "parameters", "noise", "title", "source")
    about = {name: cube.attrs[name] for name in kept if name in cube.attrs}
    about |= {"confidence": options.confidence, "core": options.core}
    return xr.Dataset(on_points(TRANSFER_COLUMNS, values, dims), {**coordinates_of(cube, dims), **axis}, about)


def transfer_table(ds: xr.Dataset) -> Table:
    """Return a row for each set of each parameter point: measure, share, escape, and passages to other sets."""
    dims = [str(d) for d in ds[ROW_SIZE].dims]
    rows, lines = [], []
    for (at, where), places in zip(points_of(ds, dims), rows_at(ds).values(), strict=True):
        here = list(_rows(ds, places, where))
        rows += here
        head = ", ".join(f"{d} {v:g}" for d, v in where.items())
        lines.append(f"{head}{': ' if head else ''}{_summary(ds.isel(at), len(here))}")
        lines += aligned([_words(row) for row in here])
    return Table(rows, lines)


def _summary(one: xr.Dataset, n: int) -> str:
    many = 0.01  # share of pairs that end in boxes without a pair, above which the table warns
    pairs, boxes, closed = (int(one[name]) for name in ("n_pairs", "n_boxes", "n_closed"))
    text = f"{pairs} pairs in {boxes} boxes; "
    if not n:
        return f"{text}no set: every path leaves the grid or the sampled boxes"
    text += f"{closed} closed sets" if closed > 1 else f"{n} almost invariant sets"
    if np.isfinite(one["eigenvalue"].values[:2]).all() and closed < 2:
        real, imaginary = (float(one[name].values[1]) for name in ("eigenvalue", "eigenvalue_imaginary"))
        text += f", second eigenvalue {complex(real, imaginary) if imaginary else real:.4g}"
    for name, words in (("outside", "leave the grid"), ("unknown", "end in boxes that no pair leaves")):
        if float(one[name]) > (many if name == "unknown" else 0.0):
            text += f"; {100 * float(one[name]):.2g} % of pairs {words}"
    return text


def _rows(ds: xr.Dataset, here: range, where: Row) -> Iterator[Row]:
    for k, i in enumerate(here):
        row: Row = {**where, "set": letter(k), "boxes": int(ds[N_POINTS][i])}
        row |= {name: float(ds[name][i]) for name in ("measure", "share", *_REALS)}
        for j in range(len(here)):
            if j != k:
                row |= {f"{name}_{letter(j)}": float(ds[name][i, j]) for name in _PASSAGES}
        yield row


def _words(row: Row) -> Words:
    words = {
        "set": str(row["set"]),
        "boxes": str(row["boxes"]),
        "measure": number(row["measure"], ".4g"),
        "share": number(row["share"], ".4g"),
        "escape per step": with_interval(row, _RATES[:3], ".3g"),
        "coarser": number(row["escape_rate_coarse"], ".3g"),
    }
    for name in [name.removeprefix("passage_low_") for name in row if name.startswith("passage_low_")]:
        if np.isfinite(row[f"passage_{name}"]):
            ends = [f"passage{end}_{name}" for end in ("", "_low", "_high")]
            words[f"steps to {name}"] = with_interval(row, ends, ".4g")
            words[f"to {name}, coarser"] = number(row[f"passage_coarse_{name}"], ".4g")
    return words
