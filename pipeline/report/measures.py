"""Measure quantities in the results of a study, as estimates with 95 % intervals.

A measure is a function of results and options that returns an `Estimate`. No measure depends on a model:
classes of motion are the labels of the run's own classifier; axes and quantities are given by name. All
intervals are 95 % intervals. Those of fractions are Clopper and Pearson's. The interval of a place on an axis
reaches between the neighbouring values of the axis. Any analysis can be named, so a claim on a basin fraction, an
exponent, a dimension or the place of a bifurcation needs no measure of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.layout.vocabulary import parameter_name, split_dims
from pipeline.products.plugins import added
from pipeline.products.registry import ANALYSES
from pipeline.report.estimates import Estimate, Measure, Options, Results, absent
from pipeline.results.intervals import binomial_interval
from pipeline.results.selection import place
from pipeline.results.sides import classify
from pipeline.runs.derive import shown_table
from pipeline.specification.problems import SpecError, unknown_name

if TYPE_CHECKING:
    import xarray as xr


Row = Mapping[str, Any]

NORMAL = 1.959963984540054
"""Standard errors on either side of a 95 % interval of a normal distribution."""

_CLOSE = 1e-9
"""Largest relative difference of two numbers that count as equal in ``where``."""


def analysed(results: Results, name: str, options: Options) -> xr.Dataset:
    """Return the result of the analysis that the options of a measure name."""
    analysis = str(options["analysis"])
    if analysis not in ANALYSES:
        raise SpecError(unknown_name("analysis", analysis, ANALYSES))
    return results.run(name).derive(analysis, **options.get("with", {}))


def rows_of(results: Results, name: str, options: Options) -> list[Row]:
    """Return the rows of an analysis' table that match ``where``."""
    ds = analysed(results, name, options)
    rows = list(shown_table(str(options["analysis"]), ds).rows)
    where = options.get("where", {})
    if rows and (unknown := [key for key in where if key not in rows[0]]):
        raise SpecError(unknown_name(f"column of {options['analysis']}", unknown[0], rows[0]))
    return [row for row in rows if all(_same(row[key], wanted) for key, wanted in where.items())]


def _same(value: Any, wanted: Any) -> bool:
    if isinstance(wanted, str) or isinstance(value, str):
        return str(value) == str(wanted)
    return math.isclose(float(value), float(wanted), rel_tol=_CLOSE, abs_tol=_CLOSE)


def tabulated(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return a number in the table of an analysis.

    Options: ``analysis`` and ``with``, its options; ``where``, the values of columns that choose rows;
    ``column``; ``rank`` among several rows, 1 for the largest number (by default there must be one row);
    ``plus``, a constant to add. The interval is taken from the table: from the columns ``low`` and ``high`` of
    a fraction, from ``COLUMN_stderr`` (times 1.96), or from the column that ``error`` names, a bound of the
    error. Without any of these it has no width.
    """
    name = str(options["column"])
    rows = rows_of(results, of[0], options)
    if rows and name not in rows[0]:
        raise SpecError(unknown_name(f"column of {options['analysis']}", name, rows[0]))
    rows = [row for row in rows if math.isfinite(float(row[name]))]
    rank = options.get("rank")
    if not rows or (rank or 1) > len(rows):
        return absent(f"the table of {options['analysis']} has {len(rows)} such rows with a number")
    if rank is None and len(rows) > 1:
        return absent(f"the table of {options['analysis']} has {len(rows)} such rows; give rank, or more of where")
    row = sorted(rows, key=lambda row: -float(row[name]))[(rank or 1) - 1]
    value = float(row[name])
    low, high = _interval_of(row, name, value, options.get("error"))
    plus = float(options.get("plus", 0.0))
    cells = row.get("n_cells")
    n = int(cells) if cells is not None else None
    return Estimate(value + plus, low + plus, high + plus, _about(row, options), n=n)


def _interval_of(row: Row, name: str, value: float, error: str | None) -> tuple[float, float]:
    if error is not None:
        half = float(row[error])
    elif name == "fraction":
        return float(row["low"]), float(row["high"])
    else:
        half = NORMAL * float(row.get(f"{name}_stderr", 0.0))
    return value - half, value + half


def _about(row: Row, options: Options) -> str:
    chosen = ", ".join(f"{key} {value}" for key, value in options.get("where", {}).items())
    kind = str(row.get("nature") or row.get("kind") or row.get("type") or "").replace("_", " ")
    cells = f"{row['n_cells']} cells" if "n_cells" in row else ""
    words = ", ".join(part for part in (chosen, kind, cells) if part)
    return f"analyse {options['analysis']}: {options['column']}" + (f" ({words})" if words else "")


def counted_rows(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the number of rows in the table of an analysis, such as the number of attractors.

    Options: ``analysis`` and ``with``, its options; ``where``, the values of columns that choose rows. The
    interval has no width.
    """
    n = len(rows_of(results, of[0], options))
    return Estimate(n, n, n, _about({}, {**options, "column": "rows"}))


def derived_number(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return a number that an analysis finds once per parameter point, such as the basin entropy.

    Options: ``analysis`` and ``with``, its options; ``variable`` of its result; ``at``, values of swept
    parameters. The interval is the one that the analysis gives: ``VARIABLE_low`` and ``VARIABLE_high``, or
    1.96 times ``VARIABLE_stderr``. Without either it has no width.
    """
    ds, name = analysed(results, of[0], options), str(options["variable"])
    if name not in ds:
        raise SpecError(unknown_name(f"variable of {options['analysis']}", name, map(str, ds.data_vars)))
    try:
        one = ds.sel({key: value for key, value in options.get("at", {}).items()}, method="nearest", tolerance=1e-9)
    except KeyError:
        return absent(f"the run has no values {options['at']}")
    found = one[name].squeeze()
    if found.ndim:
        raise SpecError(f"{name}: has a value for each {' and '.join(map(str, found.dims))}; choose one by at.")
    value = float(found)
    if not math.isfinite(value):
        return absent(f"{options['analysis']} could not compute {name}")
    low, high = (float(one[f"{name}{end}"]) if f"{name}{end}" in one else math.nan for end in ("_low", "_high"))
    if not (math.isfinite(low) and math.isfinite(high)):
        half = NORMAL * float(one[f"{name}_stderr"]) if f"{name}_stderr" in one else 0.0
        low, high = value - half, value + half
    return Estimate(value, low, high, f"analyse {options['analysis']}: {name}")


def ratio_of_intervals(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the ratio of the distances between three successive bifurcations, (v2 - v1)/(v3 - v2).

    For three period doublings of a cascade it approximates Feigenbaum's constant 4.669. Options: ``type``,
    ``low``, ``high``, ``max_period``, as in `located_bifurcation`; exactly three bifurcations must lie there.
    The interval follows from the brackets of the three.
    """
    from pipeline.analysis.branches.analysis import table_of
    from pipeline.layout.vocabulary import parameter_name

    given = {name: options[name] for name in ("low", "high", "max_period")}
    found = results.run(of[0]).derive("branches", **given, generations=int(options.get("generations", 1)))
    rows = [row for row in table_of(found) if row["type"] == options["type"]]
    if len(rows) != 3:
        return absent(f"{len(rows)} such bifurcations were found, and three are needed")
    name = parameter_name(str(found.attrs["parameter"]))
    first, second, third = (float(row[name]) for row in rows)
    brackets = [float(row["bracket"]) for row in rows]
    value = (second - first) / (third - second)
    above, below = brackets[0] + brackets[1], brackets[1] + brackets[2]
    half = abs(value) * (above / abs(second - first) + below / abs(third - second))
    text = f"located at {first:.7g}, {second:.7g} and {third:.7g}"
    return Estimate(value, value - half, value + half, text)


def _cells(results: Results, name: str) -> tuple[xr.Dataset, str]:
    """Return the cells of a run that sweeps one axis, with the dims (axis, cell), and the name of the axis."""
    cube = results.run(name).cube()
    axes, starts = split_dims(cube["status"])
    wide = [d for d in axes if cube.sizes[d] > 1] or list(axes[:1])
    if len(wide) != 1:
        raise SpecError(f"{name}: is measured along one axis, and the run has {', '.join(axes) or 'none'}.")
    keep = ["orbit_period", "status", *(n for n in ("lyapunov", "lyapunov_flag") if n in cube)]
    found = cube[keep]
    words = classify(cube)
    if words is not None:
        found = found.assign(motion=words)
    found = found.load()
    rest = [d for d in (*axes, *starts) if d != wide[0]]
    return found.stack(cell=rest).sortby(wide[0]).transpose(wide[0], "cell", ...), wide[0]


def _within(ds: xr.Dataset, axis: str, options: Options) -> xr.Dataset:
    values = ds[axis].values
    if "at" in options:
        at = _index(ds, axis, float(options["at"]))
        return ds.isel({axis: [] if at is None else [at]})
    slack = 1e-9 * max(float(np.abs(values).max()), 1.0)
    low, high = float(options.get("low", -math.inf)), float(options.get("high", math.inf))
    return ds.isel({axis: (values >= low - slack) & (values <= high + slack)})


def _index(ds: xr.Dataset, axis: str, value: float) -> int | None:
    try:
        return place(ds[axis], value)
    except ValueError:
        return None


def _step(values: np.ndarray) -> float | None:
    return float(np.diff(values).max()) if values.size > 1 else None


def _matches(ds: xr.Dataset, options: Options) -> np.ndarray:
    """Return which cells have the wanted orbit period and class of motion; period 0 means orbits that do not close."""
    wanted = options.get("period")
    periods = ds["orbit_period"].values
    found = np.ones(periods.shape, bool)
    if wanted is not None:
        found &= np.isin(periods, np.atleast_1d(wanted))
    if "motion" in options:
        if "motion" not in ds:
            raise SpecError(f"motion = {options['motion']!r}: the model of this run has no labels for motions.")
        words = str(ds["motion"].attrs["flag_meanings"]).split()
        if options["motion"] not in words:
            raise SpecError(f"motion = {options['motion']!r}: must be one of {', '.join(words)}.")
        found &= ds["motion"].values == words.index(options["motion"])
    return found


def _share(count: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    low, high = binomial_interval(count, n, confidence=confidence, method="clopper-pearson")
    return float(low), float(high)


def least_share(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the smallest fraction, over the axis values, of cells that have a given orbit period or class of motion.

    Options: ``at``, or ``low`` and ``high``; ``period``, ``motion``. The interval is Clopper and Pearson's.
    Its level is corrected for the number of axis values (Bonferroni), since the least of many fractions is
    taken.
    """
    ds, axis = _cells(results, of[0])
    here = _within(ds, axis, options)
    n_values, n = here.sizes[axis], here.sizes["cell"]
    step = None if "at" in options else _step(ds[axis].values)
    if n_values == 0:
        return absent(f"the axis has no value {_asked(options)}", _step(ds[axis].values))
    counts = _matches(here, options).sum(1)
    k = int(counts.argmin())
    low, high = _share(int(counts[k]), n, 1 - 0.05 / n_values)
    where = f"{axis} {here[axis].values[k]:g}" + (f", the least of {n_values} values" if n_values > 1 else "")
    return Estimate(counts[k] / n, low, high, f"{counts[k]} of {n} cells at {where}", step, n)


def largest_share(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the largest fraction, over the axis values, of cells that have a given orbit period or class of motion.

    Options and interval: see `least_share`.
    """
    ds, axis = _cells(results, of[0])
    here = _within(ds, axis, options)
    n_values, n = here.sizes[axis], here.sizes["cell"]
    if n_values == 0:
        return absent(f"the axis has no value {_asked(options)}", _step(ds[axis].values))
    counts = _matches(here, options).sum(1)
    k = int(counts.argmax())
    low, high = _share(int(counts[k]), n, 1 - 0.05 / n_values)
    text = f"{counts[k]} of {n} cells at {axis} {here[axis].values[k]:g}, the largest of {n_values} values"
    return Estimate(counts[k] / n, low, high, text, _step(ds[axis].values), n)


def last_value_with(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the largest axis value at which any cell has a given orbit period or class of motion.

    Options: ``low`` and ``high``; ``period``, ``motion``. The interval reaches to the next value of the axis, at
    which no cell has it. More starts can only raise the value: a rare motion may have been missed beyond it.
    """
    ds, axis = _cells(results, of[0])
    here = _within(ds, axis, options)
    values, n = here[axis].values, here.sizes["cell"]
    step = _step(ds[axis].values)
    found = np.flatnonzero(_matches(here, options).any(1))
    if not found.size:
        return absent(f"none of {n} cells has it {_asked(options)}", step)
    last = int(found[-1])
    if last == values.size - 1:
        return absent(f"cells have it up to the last value, {values[last]:g}", step)
    low, high = float(values[last]), float(values[last + 1])
    text = f"some of {n} cells up to {low:g}, none from {high:g}"
    return Estimate(0.5 * (low + high), low, high, text, step, n)


def _asked(options: Options) -> str:
    if "at" in options:
        return f"{options['at']:g}"
    return f"between {options.get('low', -math.inf):g} and {options.get('high', math.inf):g}"


def window(results: Results, of: Sequence[str], options: Options) -> tuple[Estimate, int, int, xr.Dataset, str]:
    """Measure the interval about a value in which every cell has a given orbit period; return its cells, too."""
    ds, axis = _cells(results, of[0])
    here = _within(ds, axis, {k: v for k, v in options.items() if k in ("low", "high")})
    values, n = here[axis].values, here.sizes["cell"]
    step, wanted = _step(values), float(options["contains"])
    at = _index(here, axis, wanted) if values.size > 2 else None
    if at is None:
        return absent(f"the axis has no value {wanted:g} with others about it", step), 0, 0, here, axis
    whole = np.asarray(_matches(here, options).all(1))
    first = last = at
    if not whole[at]:
        text = f"not all of {n} cells have it at {values[at]:g}"
        return Estimate(0.0, 0.0, 0.0, text, step, n), 0, 0, here, axis
    while first > 0 and whole[first - 1]:
        first -= 1
    while last < values.size - 1 and whole[last + 1]:
        last += 1
    inner = float(values[last] - values[first])
    outer = float(values[min(last + 1, values.size - 1)] - values[max(first - 1, 0)])
    open_end = first == 0 or last == values.size - 1
    text = f"all of {n} cells from {values[first]:g} to {values[last]:g}"
    high = math.inf if open_end else outer
    text += "; it reaches an end of the axis" if open_end else ""
    middle = inner if open_end else 0.5 * (inner + outer)
    return Estimate(middle, inner, high, text, step, n), first, last, here, axis


def window_width(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the width of the interval about an axis value in which every cell has a given orbit period.

    Options: ``contains``, ``period`` (and ``motion``), ``low`` and ``high``. Each end lies between
    neighbouring values of the axis, which gives the interval of the estimate.
    """
    return window(results, of, options)[0]


def beside_window(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the fraction of cells just outside a periodic window that have one of the orbit periods in ``other``.

    Options: those of `window_width`; ``other``, the periods that count; ``within``, the largest distance from
    the window's ends.
    """
    found, first, last, here, axis = window(results, of, options)
    if found.missing or found.value == 0.0:
        return absent(found.missing or found.text, found.step)
    values, within = here[axis].values, float(options["within"]) * (1 + 1e-9)
    near = (values < values[first]) & (values >= values[first] - within)
    near |= (values > values[last]) & (values <= values[last] + within)
    cells = _matches(here.isel({axis: near}), {"period": options["other"]})
    if not cells.size:
        return absent(f"no value of the axis lies within {within:g} of its ends", found.step)
    low, high = _share(int(cells.sum()), cells.size)
    text = f"{cells.sum()} of {cells.size} cells within {options['within']:g} of its ends"
    return Estimate(float(cells.mean()), low, high, text, found.step, cells.size)


def change_of_period(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the axis value at which the orbit period of most cells changes.

    Options: ``below`` and ``above``, the periods on the two sides; ``low`` and ``high``. The interval reaches
    from the last value with the period ``below`` to the next with the period ``above``. Between them, near a
    bifurcation, most cells may have neither, since motions close slowly. If there are several changes, the
    interval spans them all.
    """
    ds, axis = _cells(results, of[0])
    here = _within(ds, axis, options)
    values, n = here[axis].values, here.sizes["cell"]
    step = _step(ds[axis].values)
    if values.size < 2:
        return absent(f"the axis has fewer than two values {_asked(options)}", step)
    below, above = (2 * _matches(here, {"period": options[side]}).sum(1) > n for side in ("below", "above"))
    decided = np.flatnonzero(below | above)
    places = [(i, k) for i, k in pairwise(decided) if below[i] and above[k]]
    if not places:
        change = f"from {options['below']} to {options['above']}"
        return absent(f"most of {n} cells nowhere change {change} {_asked(options)}", step)
    low, high = float(values[places[0][0]]), float(values[places[-1][1]])
    text = f"period {options['below']} of most of {n} cells up to {low:g}, {options['above']} from {high:g}"
    text += f"; {len(places)} such places" if len(places) > 1 else ""
    return Estimate(0.5 * (low + high), low, high, text, step, n)


def located_bifurcation(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the parameter value at which bifurcations of a given type occur. They are located by continuation of the
    orbits on which the run's cells end.

    Options: ``type``, as `magpend analyse branches` names it; ``low`` and ``high``; ``max_period``, the
    longest period of continued orbits; ``generations`` of branches that spring from bifurcations, by default 1.
    The interval spans all bifurcations found. Each is located exactly, independent of the step of the run's axis.
    """
    from pipeline.analysis.branches.analysis import table_of

    given = {name: options[name] for name in ("low", "high", "max_period")}
    found = results.run(of[0]).derive("branches", **given, generations=int(options.get("generations", 1)))
    rows = [row for row in table_of(found) if row["type"] == options["type"]]
    if not rows:
        return absent(f"no {options['type'].replace('_', ' ')} was found {_asked(options)}")
    name = parameter_name(str(found.attrs["parameter"]))
    low = min(row[name] - row["bracket"] for row in rows)
    high = max(row[name] + row["bracket"] for row in rows)
    text = ", ".join(f"{row.get('side', '')} {row[name]:.7g}".strip() for row in rows)
    return Estimate(0.5 * (low + high), low, high, f"located: {text}")


def rarest_motion(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the smallest fraction of cells among the given classes of motion. They coexist if it exceeds 0.

    Options: ``at``, ``motions``, ``period``.
    """
    shares = [
        least_share(results, of, {**{k: options[k] for k in ("at", "period") if k in options}, "motion": word})
        for word in options["motions"]
    ]
    if any(share.missing for share in shares):
        return shares[0]
    rarest = min(shares, key=lambda share: share.value)
    words = "; ".join(f"{w}: {s.text.partition(' at ')[0]}" for w, s in zip(options["motions"], shares, strict=True))
    return Estimate(rarest.value, rarest.low, rarest.high, words, rarest.step, rarest.n)


def largest_exponent(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the largest Lyapunov exponent [1/s] at one axis value, averaged over cells on no periodic orbit.

    Options: ``at``. The interval is that of the mean over cells (Student's t). The cells are on one set, so
    their exponents differ only because of finite time.
    """
    ds, axis = _cells(results, of[0])
    if "lyapunov" not in ds:
        raise SpecError(f"{of[0]}: has no exponents; add [products] lyapunov = {{}} to its specification.")
    here = _within(ds, axis, options)
    if not here.sizes[axis]:
        return absent(f"the axis has no value {_asked(options)}", _step(ds[axis].values))
    values = here["lyapunov"].isel(exponent=0).values[0]
    chosen = values[(here["orbit_period"].values[0] == 0) & np.isfinite(values)]
    if chosen.size < 3:
        return absent(f"{chosen.size} cells are not closed at {_asked(options)}")
    from scipy.stats import t

    half = float(t.ppf(0.975, chosen.size - 1) * chosen.std(ddof=1) / math.sqrt(chosen.size))
    mean = float(chosen.mean())
    return Estimate(mean, mean - half, mean + half, f"{chosen.size} cells that are not closed", n=chosen.size)


def agreement(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the fraction of common axis values at which two runs have the same most frequent orbit period.

    Options: ``low``, ``high``. Periods above 16 count as one outcome, and so do cells that are not closed.
    """
    outcomes = []
    for name in of[:2]:
        ds, axis = _cells(results, name)
        here = _within(ds, axis, options)
        periods = here["orbit_period"].values
        most = [int(np.bincount(np.clip(row, 0, 17)).argmax()) for row in periods]
        outcomes.append({round(float(x), 9): p for x, p in zip(here[axis].values, most, strict=True)})
        step = _step(ds[axis].values)
    common = sorted(set(outcomes[0]) & set(outcomes[1]))
    if len(common) < 2:
        return absent(f"the runs have {len(common)} values in common there", step)
    same = sum(outcomes[0][x] == outcomes[1][x] for x in common)
    low, high = _share(same, len(common))
    return Estimate(same / len(common), low, high, f"{same} of {len(common)} values", step, len(common))


def share_above(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the fraction of a drive period in which a model quantity is positive; the model's states are all 0.

    Options: ``quantity``, ``frequency_hz``. The time of the sign change is found by bisection. The quantity
    must be positive at the start and change sign once.
    """
    from magpend_core import evaluate

    parameters, f = results.run(of[0]).parameters, float(options["frequency_hz"])
    rest = np.zeros(len(parameters.model.states))

    def values(share: np.ndarray) -> np.ndarray:
        states = np.broadcast_to(rest, (share.size, rest.size))
        return np.asarray(evaluate([options["quantity"]], share / f, states, parameters, f)[:, 0])

    edge = 1e-9
    grid = np.concatenate([[edge], np.arange(1, 2048) / 2048, [1 - edge]])
    signs = values(grid) > 0.0
    changes = np.flatnonzero(signs[1:] != signs[:-1])
    if not signs[0] or changes.size != 1:
        text = "is not positive from the beginning of the period on" if not signs[0] else "changes sign more than once"
        return Estimate(0.0, 0.0, 0.0, f"{options['quantity']} {text}")
    low, high = grid[changes[0]], grid[changes[0] + 1]
    while high - low > 1e-12:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if values(np.array([middle]))[0] > 0 else (low, middle)
    text = f"positive from the beginning of the period to {low:.8f} of it, found by bisection"
    return Estimate(low, low, high, text)


MEASURES: dict[str, Measure] = {
    "least_share": least_share,
    "largest_share": largest_share,
    "last_value_with": last_value_with,
    "window_width": window_width,
    "beside_window": beside_window,
    "change_of_period": change_of_period,
    "located_bifurcation": located_bifurcation,
    "rarest_motion": rarest_motion,
    "largest_exponent": largest_exponent,
    "agreement": agreement,
    "tabulated": tabulated,
    "counted_rows": counted_rows,
    "derived_number": derived_number,
    "ratio_of_intervals": ratio_of_intervals,
    "share_above": share_above,
    **added("measures"),
}
"""Measures by the names that studies use."""
