"""Draw parameter sets from the posterior of an identification, and compute the 95 % bands of its branches from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models import load_model
from magpend_core.models.model import Model
from pipeline.analysis.branches.bands import bifurcation_data, carried, orbit_data, place_variables, solvable
from pipeline.analysis.branches.carrying import ORBIT, OrbitData, Solution, solve
from pipeline.layout.writing import write_netcdf
from pipeline.plots.figure import save_data, save_figure
from pipeline.products.product import Table
from pipeline.results.draws import LEVELS, interval_of, stretches
from pipeline.rig.identify.directory import POSTERIOR, read_info, read_result, stored_tables
from pipeline.rig.identify.measured_orbits import MeasuredTable
from pipeline.rig.identify.orbit_residuals import quantities_of
from pipeline.rig.identify.statistics import root_of
from pipeline.rig.measured.branch_figure import Bands, plot_branch
from pipeline.runs.stopping import stoppable
from pipeline.specification.problems import SpecError
from pipeline.store.files import FIGURES, local_path
from pipeline.store.local import make_folder, refuse_links, writer_lock

Echo = Callable[[str], None]

GAUSS, MCMC = "gauss", "mcmc"
"""Values of the attribute ``method`` of draws."""


def draw_posterior(directory: str | Path, n: int, seed: int = 1) -> xr.Dataset:
    """Draw parameter sets from the Gaussian that the estimates and their covariance define, truncated to the bounds.

    Return ``value`` over (draw, parameter): all parameters of the model, identified, tied and fixed [SI], with the
    attributes ``identified`` (names), ``digest``, ``seed``, and ``outside``: the share of draws that the bounds
    rejected. The same seed gives the same draws.

    Raise `SpecError` for parameters that are not determined, and if almost all draws lie outside the bounds.
    """
    result = read_result(directory)
    names = _identified(result)
    rows = [result["names"].index(name) for name in names]
    matrix = np.array(result["covariance"]["matrix"], dtype=float)[np.ix_(rows, rows)]
    _refuse_undetermined(names, matrix)
    drawn, outside = _within_bounds(result, names, matrix, n, seed)
    about = {"method": GAUSS, "digest": read_info(directory).digest, "seed": seed, "outside": outside}
    return _all_parameters(result, names, drawn).assign_attrs(about)


@dataclass(frozen=True)
class Sampling:
    """Options of the sampling by an ensemble of walkers."""

    n_walkers: int = 0  # number of walkers; 0 for the larger of 32 and four times the number of unknowns
    most_steps: int = 2000  # number of steps after which the chain ends, converged or not
    spec: str | Path | None = None  # specification of the identification; needed if recordings were fitted


def sample_draws(
    directory: str | Path, n: int, seed: int = 1, sampling: Sampling | None = None, *, echo: Echo = print
) -> xr.Dataset:
    """Draw parameter sets from the chain of an ensemble of walkers in the posterior density (affine-invariant MCMC).

    The directory keeps the chain; a stopped sampling goes on to the same bytes. The `n` draws are taken at random from
    it. Return a dataset as of `draw_posterior`, with convergence figures of each unknown: ``autocorrelation_time``,
    ``n_effective`` and ``split_rhat``; attributes ``converged``, ``not_converged_because``, ``accepted`` and others.

    Raise `SpecError` as `draw_posterior`, if emcee is missing, or if a specification is needed.
    """
    from pipeline.rig.identify.mcmc import figures_of, log_posterior, require_emcee, sample_posterior

    least = 32
    asked = sampling or Sampling()
    require_emcee()
    result = read_result(directory)
    matrix = np.array(result["covariance"]["matrix"], dtype=float)
    _refuse_undetermined(result["names"], matrix)
    density = log_posterior(directory, asked.spec, result)
    n_free = len(result["names"])
    chain = sample_posterior(
        directory,
        density,
        matrix,
        n_walkers=asked.n_walkers or max(least, 4 * n_free),
        most_steps=asked.most_steps,
        seed=seed,
        echo=echo,
    )
    flat = chain.values.reshape(-1, n_free)
    names = _identified(result)
    columns = [result["names"].index(name) for name in names]
    # at random: at even distances the same walkers would return in step with the moves
    chosen = np.random.default_rng(seed).choice(len(flat), n, replace=n > len(flat))
    drawn = flat[chosen][:, columns]
    found = _all_parameters(result, names, drawn).merge(
        figures_of(chain, result["names"]), combine_attrs="no_conflicts"
    )
    return found.assign_attrs(digest=read_info(directory).digest, seed=seed)


def kept_draws(directory: str | Path, n: int, seed: int = 1) -> xr.Dataset:
    """Return draws of the chain that `sample_draws` has stored in the directory, or else draws of the Gaussian.

    Raise `SpecError` if there are fewer draws of the chain than asked for.
    """
    path = local_path(directory) / POSTERIOR
    if path.is_file():
        with xr.open_dataset(path, engine="scipy") as ds:
            kept = ds.load()
        if kept.attrs.get("method") == MCMC and kept.attrs.get("digest") == read_info(directory).digest:
            there = kept.sizes["draw"]
            if n > there:
                raise SpecError(
                    f"-n = {n}: {path} has {there} draws of the chain; make more: magpend identify posterior "
                    f"{directory} --mcmc -n {n}."
                )
            return kept.isel(draw=slice(n))
    return draw_posterior(directory, n, seed)


def _identified(result: Mapping[str, Any]) -> list[str]:
    """Return the names of the identified parameters, without the zero offsets of sensors."""
    return [name for name in result["names"] if name in result["values"]]


def _all_parameters(result: Mapping[str, Any], names: list[str], drawn: np.ndarray) -> xr.Dataset:
    """Return the values of all parameters of the model for draws of the identified ones."""
    model: Model = load_model(result["model"])
    values = np.tile([result["values"][name] for name in model.parameter_names], (len(drawn), 1))
    columns = list(model.parameter_names)
    values[:, [columns.index(name) for name in names]] = drawn
    for name, (factor, other) in result["tied"].items():
        values[:, columns.index(name)] = factor * values[:, columns.index(other)]
    about = {"identified": " ".join(names), "tied": " ".join(result["tied"])}
    return xr.Dataset({"value": (("draw", "parameter"), values)}, {"parameter": columns}, about)


def _refuse_undetermined(names: list[str], matrix: np.ndarray) -> None:
    lost = [name for name, variance in zip(names, np.diag(matrix), strict=True) if not np.isfinite(variance)]
    if lost:
        raise SpecError(
            f"{', '.join(lost)}: the data do not determine it, so it has no posterior; fix it under "
            "[parameters], or give it a prior, and identify again."
        )


def _within_bounds(
    result: Mapping[str, Any], names: list[str], matrix: np.ndarray, n: int, seed: int
) -> tuple[np.ndarray, float]:
    """Draw from the Gaussian until `n` draws lie within the bounds; return them and the fraction that was rejected."""
    least = 0.01  # share of the draws that must lie within the bounds
    estimates = [result["estimates"][name] for name in names]
    mean = np.array([e["value"] for e in estimates])
    low = np.array([-np.inf if e["bounds"][0] is None else e["bounds"][0] for e in estimates])
    high = np.array([np.inf if e["bounds"][1] is None else e["bounds"][1] for e in estimates])
    root = root_of(matrix)
    random, kept, tried = np.random.default_rng(seed), np.zeros((0, len(names))), 0
    while len(kept) < n:
        if tried and len(kept) < least * tried:
            raise SpecError(
                f"only {len(kept)} of {tried} draws lie within the bounds: the estimates' errors are larger than "
                "the bounds allow; widen the bounds, give priors, or identify fewer parameters."
            )
        batch = mean + random.standard_normal((max(4 * n, 1000), len(names))) @ root
        tried += len(batch)
        kept = np.vstack([kept, batch[((batch >= low) & (batch <= high)).all(axis=1)]])
    return kept[:n], 1.0 - len(kept) / tried


def posterior_table(drawn: xr.Dataset) -> Table:
    """Return a table of the identified parameters: mean, standard deviation and 95 % interval over the draws."""
    rows, lines = [], []
    names = str(drawn.attrs["identified"]).split()
    width = max(map(len, names))
    for name in names:
        values = drawn["value"].sel(parameter=name).values
        low, middle, high = np.quantile(values, LEVELS)
        rows.append(
            {"name": name, "mean": values.mean(), "sd": values.std(ddof=1), "median": middle, "low": low, "high": high}
        )
        lines.append(f"{name:{width}} = {middle:.6g}   95 %: {low:.6g} to {high:.6g}")
    if drawn.attrs["method"] == MCMC:
        return Table(_with_figures(rows, drawn), [*lines, *_chain_lines(drawn)])
    outside = 100.0 * float(drawn.attrs["outside"])
    lines.append(f"{drawn.sizes['draw']} draws of a Gaussian; {outside:.2g} % lay outside the bounds and were left out")
    return Table(rows, lines)


CONVERGENCE = ("autocorrelation_time", "n_effective", "split_rhat")
"""Convergence figures of each unknown."""


def _with_figures(rows: list[dict[str, Any]], drawn: xr.Dataset) -> list[dict[str, Any]]:
    return [
        {
            **row,
            **{key: float(drawn[key].sel(unknown=row["name"])) for key in CONVERGENCE},
            "converged": _has_converged(drawn),
        }
        for row in rows
    ]


def _has_converged(drawn: xr.Dataset) -> bool:
    return bool(drawn.attrs["converged"])


def _chain_lines(drawn: xr.Dataset) -> list[str]:
    """Return lines about a chain: its length, its convergence figures, and whether it has converged."""
    about, time = drawn.attrs, drawn["autocorrelation_time"].values
    slowest = str(drawn["unknown"].values[int(np.argmax(time))])
    lines = [
        f"{drawn.sizes['draw']} draws of a chain: {about['n_walkers']} walkers, {about['n_kept']} steps after "
        f"{about['n_discarded']} that were left out, {100.0 * float(about['accepted']):.0f} % of the moves accepted",
        f"autocorrelation time up to {time.max():.3g} steps ({slowest}), at least "
        f"{drawn['n_effective'].values.min():.0f} independent draws, split R-hat up to "
        f"{drawn['split_rhat'].values.max():.3f}",
    ]
    if float(about["lost"]):
        share = 100.0 * float(about["lost"])
        lines.append(f"{share:.2g} % of the proposed parameters have no density: a measured orbit is lost there")
    if not _has_converged(drawn):
        lines.append(f"NOT CONVERGED: {about['not_converged_because']}; give more --steps: the chain goes on")
    return lines


# ---- bands -----------------------------------------------------------------------------------------


def bands(table: MeasuredTable, best: dict[str, float], drawn: xr.Dataset) -> xr.Dataset:
    """Compute amplitudes on the branches and values of the bifurcations for each draw of the posterior.

    Each orbit and each bifurcation is carried from the best parameters to those of a draw by Newton's method, in steps
    where this is necessary; no branch is computed again. Return ``bifurcation_value`` over (draw, bifurcation) with
    ``kind`` and ``best_value``, and ``amplitude`` over (draw, orbit) with ``branch``, ``parameter_value``,
    ``n_unstable`` and ``best_amplitude``; NaN where a draw has none.
    """
    branches, _ = table.branches(best)
    points, states, _ = bifurcation_data(branches)
    orbits, guesses, places = orbit_data(table.along, branches, ("amplitude",))
    data = [*points, *orbits]
    packed = table.along.model.load().replace(**_own(table, best)).pack()
    guess = np.array([*states, *guesses]).reshape(len(data), -1)
    known = Solution(packed, guess, np.zeros_like(guess))
    start, solved = solvable(OrbitData(table.along, table.state, tuple(data), known, table.settings))
    values = _carried(start, drawn)
    n_points = sum(d.kind != ORBIT for d in start.data)
    own = [k - len(points) for k in solved[n_points:]]
    best_values = quantities_of(start, packed[None], solve(start, packed[None]))[0]
    share = np.isfinite(values[:, n_points:]).mean(axis=0)
    return xr.Dataset(
        {
            "bifurcation_value": (("draw", "bifurcation"), values[:, :n_points]),
            "best_value": ("bifurcation", [v[0] for v in best_values[:n_points]]),
            "kind": ("bifurcation", np.array([d.kind for d in start.data[:n_points]], object)),
            "period": ("bifurcation", [d.period for d in start.data[:n_points]]),
            "amplitude": (("draw", "orbit"), values[:, n_points:]),
            "best_amplitude": ("orbit", [v[0] for v in best_values[n_points:]]),
            **place_variables([orbits[k] for k in own], [places[k] for k in own], share),
        },
        attrs={"parameter": table.along.parameter, "state": table.state},
    )


def _own(table: MeasuredTable, values: dict[str, float]) -> dict[str, float]:
    return {name: v for name, v in {**values, **table.settings}.items() if name in table.along.model.parameter_names}


def _carried(table: OrbitData, drawn: xr.Dataset) -> np.ndarray:
    """Return amplitude or bifurcation value by draw and measurement, (draw, datum); NaN where none is found."""
    names = [str(name) for name in drawn["parameter"].values]
    packed = np.array([table.packed(dict(zip(names, row, strict=True))) for row in drawn["value"].values])
    found = [[v[0] for v in row] for own, points in carried(table, packed) for row in quantities_of(table, own, points)]
    return np.array(found).reshape(len(packed), len(table.data))


def bands_table(found: Sequence[xr.Dataset]) -> Table:
    """Return a table of the bifurcations: best value, median and 95 % interval over the draws with this bifurcation."""
    rows, lines = [], []
    for ds in found:
        for b in range(ds.sizes["bifurcation"]):
            values = ds["bifurcation_value"].values[:, b]
            low, middle, high, n = interval_of(values)
            kind, best = str(ds["kind"].values[b]).replace("_", " "), float(ds["best_value"].values[b])
            row = {"kind": kind, "period": int(ds["period"].values[b]), "best": best, "median": middle}
            rows.append({**row, "low": low, "high": high, "n_draws": n})
            lines.append(
                f"{kind} at {ds.attrs['parameter']} = {best:.6g}   95 %: {low:.6g} to {high:.6g} "
                f"({n} of {len(values)} draws have it)"
            )
    return Table(rows, lines)


def tubes(found: xr.Dataset) -> list[dict[str, np.ndarray]]:
    """Return the 95 % amplitude bands, one per branch and stability: parameter values with lower and upper amplitude.

    A band is there where at least half of the draws have the orbit.
    """
    bands_of = []
    for _, _, chosen in stretches(found):
        low, _, high = np.nanquantile(found["amplitude"].values[:, chosen], LEVELS, axis=0)
        bands_of.append({"x": found["parameter_value"].values[chosen], "low": low, "high": high})
    return bands_of


# ---- files -----------------------------------------------------------------------------------------

SHORT = {"period_doubling": "doubling", "neimark_sacker": "torus", "hopf": "Hopf"}
"""Names of bifurcations in figures."""


def write_posterior(
    directory: str | Path,
    n: int,
    seed: int = 1,
    *,
    sampling: Sampling | None = None,
    figures: bool = True,
    echo: Echo = print,
) -> tuple[Table, Table, list[Path]]:
    """Draw the posterior, compute the 95 % bands of branches and bifurcations, and write both to the directory.

    A `sampling` of None gives draws of the Gaussian. Return tables of the parameters and of the bifurcations, and the
    paths of the written files. After Ctrl-C or SIGTERM the chain stays.
    """
    folder = local_path(directory)
    result, found, written = read_result(folder), [], [folder / POSTERIOR]
    with writer_lock(folder), stoppable(folder):
        if sampling is None:
            drawn = draw_posterior(folder, n, seed)
        else:
            drawn = sample_draws(folder, n, seed, sampling, echo=echo)
        write_netcdf(written[0], drawn)
        for i, table in enumerate(stored_tables(folder)):
            one = bands(table, result["values"], drawn)
            found.append(one)
            written.append(folder / f"bands-{i}.nc")
            write_netcdf(written[-1], one.assign(kind=("bifurcation", one["kind"].values.astype(str))))
            if figures and table.measured is not None:
                written += _draw(folder, i, table, result["values"], one)
    return posterior_table(drawn), bands_table(found), written


def _draw(folder: Path, i: int, table: MeasuredTable, values: dict[str, float], found: xr.Dataset) -> list[Path]:
    branches, computed = table.branches(values)
    intervals = []
    for b in range(found.sizes["bifurcation"]):
        known = found["bifurcation_value"].values[:, b]
        known = known[np.isfinite(known)]
        if 2 * len(known) >= found.sizes["draw"]:
            kind = str(found["kind"].values[b])
            low, _, high = np.quantile(known, LEVELS)
            intervals.append((SHORT.get(kind, kind), float(low), float(high)))
    assert table.measured is not None
    figure = plot_branch(table.measured, branches, computed, bands=Bands(tubes(found), intervals))
    refuse_links(folder / FIGURES)
    make_folder(folder / FIGURES)
    path = folder / FIGURES / f"bands-{i}.png"
    return [save_figure(figure, path), save_data(figure, path)]
