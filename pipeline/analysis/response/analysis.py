"""Turn branches of periodic orbits into a response; integrate on where a stable orbit ends; tabulate both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Model, Parameters, Quantity, State
from magpend_core.models.sectioned import of_flow
from magpend_core.precision import limits_at
from magpend_core.sections import run_branches
from magpend_core.status import Status
from pipeline.analysis.branches.analysis import cut_of, fixed_of, isolas_of, listed
from pipeline.analysis.branches.completeness import searched_lines
from pipeline.analysis.branches.intervals import interval_along
from pipeline.analysis.branches.kinds import LABELS
from pipeline.analysis.response.declaration import ResponseOptions
from pipeline.analysis.response.orbits import Orbit, lags_of, measures_of
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import FREQUENCY_DIM, axis_name, parameter_name, parameters_of
from pipeline.products.product import Table
from pipeline.results.run import OpenRun
from pipeline.results.tabular import Row, Words, aligned, words_of
from pipeline.results.tolerances import CELL_CLOSURE, PORTRAIT_RTOL

PATIENCE, LONGEST = 20_000, 64
"""Drive periods or returns after which a trajectory is given up, and the longest period at which it may close."""

LANDINGS = {
    "closed": "",
    "at_rest": "rest",
    "not_closed": f"no orbit within {PATIENCE} periods",
    "diverged": "beyond all bounds",
    "no_return": "no return to the section",
    "failed": "the integration failed",
}
"""Values of `jump_landing`, what became of the trajectory beyond a stable orbit's end, with the words for the table."""

_LANDED = {
    Status.PERIODIC: "closed",
    Status.BOUNDED: "not_closed",
    Status.DIVERGED: "diverged",
    Status.NO_RETURN: "no_return",
}
MEASURES = ("amplitude", "mean", "rms", "error", "dominant_order", "harmonic_amplitude", "phase")
"""Names of the measures along a branch."""

_LEFT_OUT = ("section", "multiplier", "eigenvalue", "residual", "bifurcation_section", "bifurcation_multiplier")

Variable = tuple[Any, ...]


def response(run: OpenRun, options: ResponseOptions) -> xr.Dataset:
    """Measure all orbits on the branches of a run.

    Returns
    -------
    Dataset
        The branches, and over (branch, point, channel): ``amplitude`` (half of peak to peak), ``mean``, ``rms`` with
        their largest ``error``, and ``dominant_order``; over (..., harmonic) also ``harmonic_amplitude`` and ``phase``
        [rad], the lag behind the drive. The same at the located points, under names that begin with
        ``bifurcation_``. Over ``jump`` the ends of stable orbits, see `_jumps`.
    """
    located = run.derive("branches", parameter=options.parameter)
    base = parameters_of(run.cube())
    places = [(i, j) for i in range(located.sizes["branch"]) for j in range(int(located["n_points"][i]))]
    run.echo(f"response: {len(places)} orbits")
    flow = of_flow(base).model
    orbits = {place: orbit_at(located, base, *place) for place in places}
    sizes = {d: located.sizes[d] for d in ("branch", "point")}
    variables: dict[str, Any] = measured_along(orbits, sizes, flow, options.harmonics)
    events = [orbit_at_bifurcation(located, base, k) for k in range(located.sizes["bifurcation"])]
    there = measured(events, flow, options.harmonics)
    variables |= {f"bifurcation_{name}": (("bifurcation", *dims), *rest) for name, (dims, *rest) in there.items()}
    low, high = interval_along(run, options.parameter)
    step = 1e-3 * (high - low)  # beyond the end of a stable orbit, where a trajectory is integrated
    variables |= _jumps(located, base, events, step)
    kept = located.drop_vars([name for name in map(str, located.variables) if name.startswith((*_LEFT_OUT, "state"))])
    kept = kept.rename({name: _own_name(name) for name in base.names if name in kept and name in variables})
    return kept.assign(variables).assign_coords(channel_coordinates(flow, options.harmonics))


def _own_name(parameter: str) -> str:
    """Return the name of a variable or column for a parameter whose own name is that of a measure."""
    return f"parameter_{parameter}" if parameter in MEASURES else parameter


def channel_coordinates(model: Model, n_harmonics: int) -> dict[str, Any]:
    """Return the coordinates of measures: a model's states and quantities with their units, and the harmonics."""
    both: list[State | Quantity] = [*model.states, *model.quantities]
    return {
        "channel": ("channel", [v.name for v in both]),
        "unit": ("channel", [v.unit for v in both]),
        "harmonic": np.arange(1, n_harmonics + 1),
    }


def measured(orbits: Sequence[Orbit], model: Model, n_harmonics: int) -> dict[str, Variable]:
    """Return the measures of orbits of a model as variables, without the dims of the orbits."""
    found = measures_of(orbits, n_harmonics)
    n = len(model.states) + len(model.quantities)  # also if there is no orbit
    columns = {
        "amplitude": found.amplitude,
        "mean": found.mean,
        "rms": found.rms,
        "error": found.error,
        "dominant_order": found.dominant,
    }
    both, harmonics = ("channel", "harmonic"), found.harmonics.reshape(-1, n, n_harmonics)
    return {
        **{name: (("channel",), values.reshape(-1, n)) for name, values in columns.items()},
        "harmonic_amplitude": (both, np.abs(harmonics)),
        "phase": (both, lags_of(orbits, harmonics)),
    }


def measured_along(
    orbits: Mapping[tuple[int, int], Orbit], sizes: Mapping[str, int], model: Model, n_harmonics: int
) -> dict[str, Variable]:
    """Return the measures of orbits at places along two dims as variables; NaN where there is no orbit."""
    rows = tuple(np.array([*orbits], int).reshape(-1, 2).T)
    variables: dict[str, Variable] = {}
    for name, (dims, found) in measured([*orbits.values()], model, n_harmonics).items():
        whole = np.full((*sizes.values(), *found.shape[1:]), np.nan)
        whole[rows] = found
        variables[name] = ((*sizes, *dims), whole)
    return variables


def orbit_at(located: xr.Dataset, base: Parameters, branch: int, point: int) -> Orbit:
    """Return the orbit at a point of a branch, from branches with plain names and the parameters of their run."""
    state = located["section"].values[branch, point, 0]
    value, seconds = (float(located[name].values[branch, point]) for name in ("parameter", "period_s"))
    return _orbit(located, base, branch, value, state, seconds)


def orbit_at_bifurcation(located: xr.Dataset, base: Parameters, k: int) -> Orbit:
    """Return the orbit at a located bifurcation."""
    state = located["bifurcation_section"].values[k, 0]
    value, seconds = (float(located[name].values[k]) for name in ("value", "bifurcation_period_s"))
    return _orbit(located, base, int(located["of_branch"].values[k]), value, state, seconds)


def _orbit(
    located: xr.Dataset, base: Parameters, branch: int, value: float, state: np.ndarray, seconds: float
) -> Orbit:
    given = {**fixed_of(located, branch), str(located.attrs["parameter"]): value}
    own = {name: number for name, number in given.items() if axis_name(name) != FREQUENCY_DIM}
    period = int(located["orbit_period"].values[branch])
    return Orbit(base.replace(**own), state, seconds, period)


def _jumps(located: xr.Dataset, base: Parameters, events: Sequence[Orbit], step: float) -> dict[str, Variable]:
    """Integrate trajectories from where stable orbits end, with the parameter a step beyond, until they close.

    Returns, over ``jump``: ``jump_bifurcation`` (index of the end), ``jump_rises`` (whether the parameter rises),
    ``jump_beyond`` (its value where the trajectory is integrated), ``jump_landing`` (a code of `LANDINGS`),
    ``jump_period`` and ``jump_amplitude`` (channel) of the orbit on which it lands; NaN if it does not close.
    """
    ends = [(k, way) for k in range(len(events)) if events[k].period for way in _ways(located, k)]
    name = str(located.attrs["parameter"])
    beyond = [float(located["value"].values[k]) + way * step for k, way in ends]
    starts = [
        _orbit(located, base, int(located["of_branch"].values[k]), value, events[k].state, events[k].seconds)
        for (k, _), value in zip(ends, beyond, strict=True)
    ]
    hertz = [base.model.clock.hertz or orbit.frequency_hz for orbit in starts]
    landed = _landed(starts, beyond if name == FREQUENCY_DIM else hertz)
    closed = [orbit for _, orbit in landed if orbit is not None]
    measured = iter(measures_of(closed, 1).amplitude)
    nothing = np.full(len(of_flow(base).model.states) + len(of_flow(base).model.quantities), np.nan)
    amplitude = np.array([nothing if orbit is None else next(measured) for _, orbit in landed])
    words = [word for word, _ in landed]
    if base.model.crossing is not None:  # a flow that spirals to rest crosses the section for ever
        words = ["at_rest" if a.max() < CELL_CLOSURE else word for a, word in zip(amplitude, words, strict=True)]
    codes = np.array([[*LANDINGS].index(word) for word in words], np.int8)
    periods = [0 if orbit is None else orbit.period for _, orbit in landed]
    return {
        "jump_bifurcation": ("jump", np.array([k for k, _ in ends], np.int32)),
        "jump_rises": ("jump", np.array([way > 0 for _, way in ends], np.int8)),
        "jump_beyond": ("jump", np.array(beyond, float)),
        "jump_period": ("jump", np.array(periods, np.int32)),
        "jump_landing": ("jump", codes, code_flags([*LANDINGS])),
        "jump_amplitude": (("jump", "channel"), amplitude.reshape(-1, len(nothing))),
    }


def _ways(located: xr.Dataset, k: int) -> list[int]:
    """Return the directions of the parameter in which a stable orbit ends at a bifurcation without one to go on to."""
    kind, criticality = (words_of(located[n])[int(located[n].values[k])] for n in ("kind", "criticality"))
    before, after = (int(located[f"n_unstable_{side}"].values[k]) == 0 for side in ("before", "after"))
    rises = 1 if located["rises_before"].values[k] else -1
    if kind == "fold":
        return [rises] if before or after else []
    if criticality != "subcritical" or before == after:
        return []
    return [rises if before else -rises]


def _landed(starts: Sequence[Orbit], frequency_hz: Sequence[float]) -> list[tuple[str, Orbit | None]]:
    """Integrate trajectories until they close. Return one of `LANDINGS` for each, and the orbit if it closed."""
    if not starts:
        return []
    model = starts[0].parameters.model
    found = run_branches(
        np.array([orbit.parameters.pack() for orbit in starts])[:, None],
        np.array(frequency_hz)[:, None],
        np.array([orbit.state for orbit in starts]),
        n_transient=PATIENCE,
        n_keep=LONGEST,
        **limits_at(PORTRAIT_RTOL),
        stop_when_closed=True,
        closure_tolerance=CELL_CLOSURE,
        max_orbit_period=LONGEST,
        system=model.system,
    )
    landed: list[tuple[str, Orbit | None]] = []
    for i, orbit in enumerate(starts):
        word = _LANDED.get(Status(found.status[i, 0]), "failed")
        period = int(found.orbit_period[i, 0])
        if word != "closed":
            landed.append((word, None))
            continue
        times = found.return_time
        seconds = period / frequency_hz[i] if times is None else float(times[i, 0, -period:].sum())
        landed.append((word, Orbit(orbit.parameters, found.section[i, 0, -1], seconds, period)))
    return landed


def response_table(ds: xr.Dataset) -> Table:
    """Return the table of a response.

    Rows are those of the branches' points and channels: value of the parameter, fixed parameters (with the prefix
    ``parameter_`` if they are called like a measure), branch, period, whether the branch is an isola, whether the orbit
    is stable, ``amplitude`` (half of peak to peak), ``mean``, ``rms``, ``error``, ``dominant_order``, and
    ``harmonic_1``, ``phase_1`` [rad], ... The text shows the largest amplitude of each branch, and for each jump the
    amplitudes before and after it, of the first channel.
    """
    rows = _rows(ds)
    if not rows:
        return Table(rows, ["no orbit to measure"], "no branch: no closed orbit to begin with")
    name, first = parameter_name(str(ds.attrs["parameter"])), str(ds["channel"].values[0])
    lines = [f"amplitude of {first}{_unit(ds)} along {name}, the largest of each branch"]
    detached = dict.fromkeys(isolas_of(ds), "isola") | dict.fromkeys(cut_of(ds), "detached within the interval")
    lines += ["", *aligned([_peak(ds, name, i, detached) for i in range(ds.sizes["branch"])], "")]
    values = ds["value"].values[ds["jump_bifurcation"].values]
    jumps = [_jump(ds, name, int(k)) for k in np.argsort(values, kind="stable")]
    none = "no jump: no stable orbit ends at a fold or a subcritical bifurcation"
    lines += ["", "jumps", *aligned(jumps, "  ")] if jumps else ["", none]
    lines += [*searched_lines(ds), *listed(ds, "left_out")]
    return Table(rows, lines)


def _rows(ds: xr.Dataset) -> list[Row]:
    name = _own_name(parameter_name(str(ds.attrs["parameter"])))
    values, unstable, isolas = ds["parameter"].values, ds["n_unstable"].values, isolas_of(ds)
    heads: dict[tuple[int, int], Row] = {}
    for i in range(ds.sizes["branch"]):
        fixed = {_own_name(key): value for key, value in fixed_of(ds, i).items()}
        about = {**fixed, "branch": i, "period": int(ds["orbit_period"][i]), "isola": i in isolas}
        for j in range(int(ds["n_points"][i])):
            heads[i, j] = {name: float(values[i, j]), **about, "stable": bool(unstable[i, j] == 0)}
    return channel_rows(ds, heads, ("amplitude", "mean", "rms", "error", "dominant_order"))


def channel_rows(ds: xr.Dataset, heads: Mapping[tuple[int, int], Row], names: Sequence[str]) -> list[Row]:
    """Return a row for each channel of each orbit: the columns of the orbit, its measures, and its harmonics."""
    measures = {key: ds[key].values for key in names}
    sizes, phases = ds["harmonic_amplitude"].values, ds["phase"].values
    rows = []
    for at, head in heads.items():
        for c, channel in enumerate(ds["channel"].values):
            row: Row = {**head, "channel": str(channel), **{key: float(v[(*at, c)]) for key, v in measures.items()}}
            for k, order in enumerate(ds["harmonic"].values):
                row |= {f"harmonic_{order}": float(sizes[(*at, c, k)]), f"phase_{order}": float(phases[(*at, c, k)])}
            rows.append(row)
    return rows


def _unit(ds: xr.Dataset) -> str:
    unit = str(ds["unit"].values[0])
    return "" if unit in ("", "1") else f" [{unit}]"


def _peak(ds: xr.Dataset, name: str, branch: int, detached: Mapping[int, str]) -> Words:
    n = int(ds["n_points"][branch])
    amplitude = ds["amplitude"].values[branch, :n, 0]
    at = int(np.nanargmax(amplitude))
    x, stable = ds["parameter"].values[branch, :n], ds["n_unstable"].values[branch, :n] == 0
    return {
        "branch": str(branch),
        **{key: f"{value:g}" for key, value in fixed_of(ds, branch).items()},
        "period": str(int(ds["orbit_period"][branch]) or "equilibrium"),
        name: f"{x.min():.6g} to {x.max():.6g}",
        "largest": f"{amplitude[at]:.6g}",
        "at": f"{x[at]:.6g}",
        "stable": f"{stable.mean():.0%}",
        "curve": detached.get(branch),
    }


def _jump(ds: xr.Dataset, name: str, k: int) -> Words:
    one = ds.isel(jump=k)
    event = int(one["jump_bifurcation"])
    branch = int(ds["of_branch"][event])
    word = words_of(ds["jump_landing"])[int(one["jump_landing"])]
    lands = f"{float(one['jump_amplitude'][0]):.6g} (period {int(one['jump_period'])})"
    return {
        **{key: f"{value:g}" for key, value in fixed_of(ds, branch).items()},
        name: f"{float(ds['value'][event]):.7g}",
        "label": LABELS[words_of(ds["kind"])[int(ds["kind"][event])]],
        "as it": "rises" if bool(one["jump_rises"]) else "falls",
        "from": f"{float(ds['bifurcation_amplitude'][event, 0]):.6g} (period {int(ds['orbit_period'][branch])})",
        "to": LANDINGS[word] or lands,
    }
