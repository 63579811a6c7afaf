"""Run a specification once for each draw of a posterior, and collect statistics of the results."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.attractors.matching import match_across
from pipeline.layout.identity import canonical, digest_of
from pipeline.layout.vocabulary import model_of, parameter_name
from pipeline.layout.writing import write_atomically
from pipeline.products.product import Table
from pipeline.products.reporting import silent
from pipeline.results.draws import LEVELS
from pipeline.results.ragged import dense
from pipeline.results.tabular import FEW_POINTS, points_of, words_of
from pipeline.rig.identify.directory import read_result
from pipeline.rig.identify.posterior import kept_draws
from pipeline.runs.derive import AnalysedRun
from pipeline.runs.run import run
from pipeline.specification.files import find_spec, read_toml
from pipeline.specification.models import is_model_file
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.errors import RefusedError
from pipeline.store.files import local_path

Echo = Callable[[str], None]

STUDY, BEST = "posterior.json", "best"
"""Name of the file that describes the runs, and of the folder of the run at the best estimates."""


def run_posterior(
    spec: str | Path,
    identification: str | Path,
    n: int,
    out: str | Path | None = None,
    *,
    smoke: bool = False,
    workers: int | None = None,
    echo: Echo = print,
) -> Path:
    """Run a specification at the best estimates of an identification and at each draw of its posterior; return the
    folder.

    The folder, by default ``runs/<name>-posterior``, has an ordinary run directory for each draw, ``draw-0000`` and so
    on, and one at the best estimates, ``best``. A stopped command continues.

    Raise `SpecError` if the model is not the identified one, or the specification sweeps an identified parameter, and
    `RefusedError` if the folder holds the runs of another specification or posterior.
    """
    path, result = find_spec(spec), read_result(identification)
    parsed = Spec.read(path, smoke=smoke)
    names = [name for name in result["names"] if name in result["values"]] + list(result["tied"])
    _refuse_other_model(parsed.model.reference, result, list(parsed.axes), names)
    drawn = kept_draws(identification, n)
    tables = read_toml(path)
    if isinstance(tables.get("model"), str) and is_model_file(tables["model"]):
        tables["model"] = str((path.parent / tables["model"]).resolve())
    values = drawn["value"].sel(parameter=names).values
    folder = local_path(out) if out is not None else parsed.directory.with_name(f"{parsed.directory.name}-posterior")
    _establish(folder, tables, values, names, smoke)
    places = [BEST, *(f"draw-{k:04d}" for k in range(n))]
    sets = [np.array([result["values"][name] for name in names]), *values]
    for k, (place, own) in enumerate(zip(places, sets, strict=True)):
        echo(f"run {k + 1} of {len(places)}: {place}")
        changed = {name: float(v) for name, v in zip(names, own, strict=True)}
        given = tables.get("parameters", {})
        overrides = {**given.get("overrides", {}), **changed}
        whole = {**tables, "parameters": {**given, "overrides": overrides}}
        run(whole, folder / place, workers=workers, smoke=smoke, echo=silent)
    return folder


def run_and_spread(spec: str, identification: Path, n: int, out: str | None = None, **options: Any) -> list[str]:
    """Run a specification for draws of a posterior, and return lines on the spread of its results."""
    folder = run_posterior(spec, identification, n, out, **options)
    spread_there = f"magpend identify spread {folder} --branches"
    return [*spread(folder, echo=options["echo"]).lines, f"runs: {folder}; their bifurcations: {spread_there}"]


def _refuse_other_model(reference: Any, result: Mapping[str, Any], axes: list[str], names: list[str]) -> None:
    problems = []
    if canonical(reference) != canonical(result["model"]):
        problems.append("model: is not the one that was identified; give a specification of it.")
    problems += [
        f"axes.{name}: is an identified parameter, which the draws set; remove the axis."
        for name in axes
        if name in names
    ]
    if problems:
        raise SpecError(problems)


def _establish(folder: Path, tables: Mapping[str, Any], values: np.ndarray, names: list[str], smoke: bool) -> None:
    content = {"specification": digest_of(dict(tables)), "draws": values.tolist(), "names": names, "smoke": smoke}
    path = folder / STUDY
    if path.is_file():
        known = json.loads(path.read_text("utf-8"))
        different = [key for key in content if known.get(key) != content[key]]
        if different:
            raise RefusedError(
                f"{folder}: holds the runs of another posterior or specification (different: {', '.join(different)}); "
                "give another --out."
            )
        return
    if folder.is_dir() and any(folder.iterdir()):
        raise RefusedError(f"{folder}: is not empty and has no {STUDY}; give another --out.")
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, canonical(content))


# ---- distributions -----------------------------------------------------------------------------


def spread(folder: str | Path, *, branches: bool = False, attractors: bool = False, echo: Echo = print) -> Table:
    """Return median and 95 % interval of cell fractions and bifurcation values over the runs of `run_posterior`.

    The table has a row for each status and orbit period with the ``fraction`` of cells, and, with `branches`, for each
    bifurcation of the best run with its ``value``; with `attractors`, also those of `attractor_rows`. ``n_draws`` is
    the number of draws that have it.
    """
    folder = local_path(folder)
    if not (folder / STUDY).is_file():
        raise RefusedError(f"{folder}: has no {STUDY}; make the runs by magpend run SPEC --posterior DIR.")
    n = len(json.loads((folder / STUDY).read_text("utf-8"))["draws"])
    runs = [AnalysedRun.of(folder / place) for place in (BEST, *(f"draw-{k:04d}" for k in range(n)))]
    rows = _fraction_rows([_fractions(one) for one in runs])
    shown = list(rows)
    if attractors:
        sets = []
        for k, one in enumerate(runs):
            echo(f"attractors {k + 1} of {len(runs)}")
            sets.append(one.derive("attractors"))
        found_rows, printed = _attractor_rows(sets)
        rows, shown = rows + found_rows, shown + printed
    if branches:
        found = []
        for k, one in enumerate(runs):
            echo(f"branches {k + 1} of {len(runs)}")
            found.append(_bifurcations(one))
        bifurcations = _bifurcation_rows(found)
        rows, shown = rows + bifurcations, shown + bifurcations
    return Table(rows, [_line(row) for row in shown])


def _fractions(one: AnalysedRun) -> dict[str, float]:
    cube = one.cube()
    words = words_of(cube["status"])
    status, period = cube["status"].values.ravel(), cube["orbit_period"].values.ravel()
    names = [
        f"{words[s]} {p}" if p > 0 and words[s] == "periodic" else words[s] for s, p in zip(status, period, strict=True)
    ]
    return {name: count / len(names) for name, count in Counter(names).items()}


def _fraction_rows(found: list[dict[str, float]]) -> list[dict[str, Any]]:
    names = sorted({name for one in found for name in one})
    rows = []
    for name in names:
        values = np.array([one.get(name, 0.0) for one in found[1:]])
        rows.append(_row("fraction", name, found[0].get(name, 0.0), values, int(np.count_nonzero(values))))
    return rows


def _bifurcations(one: AnalysedRun) -> list[tuple[str, float]]:
    """Return a name (kind and period) and the parameter value of each bifurcation on a run's branches."""
    branches = one.derive("branches")
    if "kind" not in branches:
        return []
    words, periods = words_of(branches["kind"]), branches["orbit_period"].values[branches["of_branch"].values]
    kinds = [words[int(k)] for k in branches["kind"].values]
    return [(f"{kind} {p}", float(v)) for kind, p, v in zip(kinds, periods, branches["value"].values, strict=True)]


def _bifurcation_rows(found: list[list[tuple[str, float]]]) -> list[dict[str, Any]]:
    """Pair each bifurcation of the best run with the nearest of its kind in each draw; return rows of a table."""
    matched: list[list[float]] = [[] for _ in found[0]]
    for own in found[1:]:
        left = list(own)
        pairs = sorted(
            (abs(value - other[1]), i, other)
            for i, (name, value) in enumerate(found[0])
            for other in own
            if other[0] == name
        )
        done: set[int] = set()
        for _, i, other in pairs:
            if i not in done and other in left:
                done.add(i)
                left.remove(other)
                matched[i].append(other[1])
    return [
        _row("value", name, value, np.array(values), len(values))
        for (name, value), values in zip(found[0], matched, strict=True)
    ]


def _row(what: str, name: str, best: float, values: np.ndarray, n: int) -> dict[str, Any]:
    low, middle, high = np.quantile(values, LEVELS) if len(values) else (np.nan,) * 3
    return {"what": what, "name": name, "best": best, "median": middle, "low": low, "high": high, "n_draws": n}


def _line(row: Mapping[str, Any]) -> str:
    name = str(row["name"]).replace("_", " ")
    return (
        f"{row['what']} {name}: {row['best']:.6g}   95 %: {row['low']:.6g} to {row['high']:.6g} "
        f"({row['n_draws']} draws have it)"
    )


# ---- attractors ------------------------------------------------------------------------------------

Rows = list[dict[str, Any]]


def _attractor_rows(runs: Sequence[xr.Dataset]) -> tuple[Rows, Rows]:
    """Return rows on the attractors of all runs, the best run first, and those of them that are printed.

    For each attractor there is the ``share`` of all cells, and at each parameter point the share of its cells and the
    mean of the section points in each state, over the draws that have it there; angles about their circular mean.
    Shares of draws without it are 0. With more than `FEW_POINTS` parameter points only the shares of all cells are
    printed.
    """
    ids = match_across(runs)
    runs = [dense(run, points=True) for run in runs]
    n = 1 + max((int(own.max(initial=-1)) for own in ids), default=-1)
    all_rows: Rows = []
    printed: Rows = []
    dims = [str(d) for d in runs[0]["kind"].dims if d != "attractor"]
    n_points = int(np.prod([runs[0].sizes[d] for d in dims]))
    for number in range(n):
        members = [_member(run, own, number) for run, own in zip(runs, ids, strict=True)]
        shares = np.array([0.0 if one is None else float(one["share"].mean()) for one in members])
        whole = _row("share", _named(number, members), shares[0], shares[1:], int(np.count_nonzero(shares[1:])))
        places = list(_at_points(runs[0], members, number, dims))
        all_rows += [whole, *places]
        printed += [whole, *(places if n_points <= FEW_POINTS else [])]
    return all_rows, printed


def _member(run: xr.Dataset, ids: np.ndarray, number: int) -> xr.Dataset | None:
    """Return the attractor with a common id in one run; None if the run does not have it."""
    rows = np.flatnonzero(ids == number)
    return run.isel(attractor=int(rows[0])) if len(rows) else None


def _named(number: int, members: Sequence[xr.Dataset | None]) -> str:
    """Return the name of an attractor: its id, with kind and period where it was seen first."""
    first = next(one for one in members if one is not None)
    there = int(np.flatnonzero(first["kind"].values.ravel() > 0)[0])
    kind = words_of(first["kind"])[int(first["kind"].values.ravel()[there])].replace("_", " ")
    period = int(first["orbit_period"].values.ravel()[there])
    return f"attractor {number} ({kind}{f', period {period}' if period else ''})"


def _at_points(
    reference: xr.Dataset, members: Sequence[xr.Dataset | None], number: int, dims: Sequence[str]
) -> Iterator[dict[str, Any]]:
    """Yield the rows of an attractor at each parameter point at which a run has it."""
    is_angle = np.asarray(model_of(reference).is_angle, bool)
    for at, values in points_of(reference, dims):
        own = [None if one is None else one.isel(at) for one in members]
        there = [one is not None and float(one["share"]) > 0.0 for one in own]
        if not any(there):
            continue
        place = ", ".join(f"{parameter_name(d)} = {v:g}" for d, v in values.items())
        name = f"attractor {number}" + (f" at {place}" if place else "")
        shares = np.array([0.0 if one is None else float(one["share"]) for one in own])
        yield _row("share", name, shares[0], shares[1:], int(sum(there[1:])))
        means = np.array(
            [
                _mean_section(one, is_angle) if one is not None and t else np.full(len(is_angle), np.nan)
                for one, t in zip(own, there, strict=True)
            ]
        )
        for k, state in enumerate(reference["state"].values):
            column = _about(means[:, k]) if is_angle[k] else means[:, k]
            known = column[1:][np.isfinite(column[1:])]
            yield _row(f"section {state}", name, float(column[0]), known, len(known))


def _mean_section(one: xr.Dataset, is_angle: np.ndarray) -> np.ndarray:
    """Return the mean of an attractor's section points in each state; of angles the circular mean."""
    points = one["attractor_points"].transpose("point", "state").values
    points = points[np.isfinite(points).all(axis=1)]
    turned = np.angle(np.exp(1j * np.where(is_angle, points, 0.0)).mean(axis=0))
    return np.asarray(np.where(is_angle, turned, points.mean(axis=0)))


def _about(angles: np.ndarray) -> np.ndarray:
    """Return angles within half a turn of their circular mean, so that their quantiles have a meaning."""
    known = angles[np.isfinite(angles)]
    centre = np.angle(np.exp(1j * known).mean())
    with np.errstate(invalid="ignore"):
        return np.asarray(centre + np.angle(np.exp(1j * (angles - centre))))
