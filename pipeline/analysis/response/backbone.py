"""Define the analysis ``backbone`` of a run: phase resonance and nonlinear normal modes, with their table."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.equilibria import find_equilibria
from magpend_core.models.model import Model, Parameters
from magpend_core.models.parameters import ParameterError
from magpend_core.models.sectioned import of_flow
from magpend_core.orbits import scaled_distance, wrap_angles
from magpend_core.pointwise import rates
from pipeline.analysis.branches.analysis import fixed_of, listed
from pipeline.analysis.branches.curves import lies_on
from pipeline.analysis.branches.declaration import BranchOptions
from pipeline.analysis.branches.intervals import interval_of, swept_axis
from pipeline.analysis.branches.lockstep import run_alone, run_together
from pipeline.analysis.branches.problems import FREQUENCY, Family
from pipeline.analysis.response.analysis import channel_coordinates, channel_rows, measured_along
from pipeline.analysis.response.declaration import BackboneOptions
from pipeline.analysis.response.resonance import (
    ENDS,
    Curve,
    ModeProblem,
    ResonanceProblem,
    mode_family,
    mode_start,
    normal_mode,
    phase_resonance,
)
from pipeline.layout.conventions import code_flags
from pipeline.layout.own_words import place_in_words
from pipeline.layout.vocabulary import model_attribute, parameter_name, parameters_of, section_attributes
from pipeline.products.product import Table
from pipeline.products.reporting import track
from pipeline.results.run import OpenRun
from pipeline.results.tabular import Row, Words, aligned, counted, plain, words_of
from pipeline.results.tolerances import SAME_EQUILIBRIUM
from pipeline.specification.problems import SpecError, unknown_name

KINDS = ("phase_resonance", "normal_mode")

NAME = parameter_name(FREQUENCY)


INSTANTS = np.linspace(0.0, 1.0, 16, endpoint=False)
"""Shares of a period at which the drive is looked at."""

Array = np.ndarray


def settle_backbone(run: OpenRun, options: BackboneOptions) -> BackboneOptions:
    """Fill in channel, interval and force from the run; raise SpecError if there is nothing to follow."""
    base = _at_ends(run, parameters_of(run.cube()))
    model = of_flow(base).model
    channels = _channels(model)
    channel = options.channel or channels[0]
    if channel not in channels:
        raise SpecError(unknown_name("channel", channel, channels))
    if unknown := [name for name in options.undamped if name not in model.parameter_names]:
        raise SpecError(unknown_name("parameter", unknown[0], model.parameter_names))
    found: dict[str, Any] = {"channel": channel}
    if model.clock.has_drive:
        ends: BranchOptions = run.branch_options(FREQUENCY)
        bounds = ((ends.low, options.low), (ends.high, options.high))
        found["low"], found["high"] = interval_of(run, FREQUENCY, *(a if b is None else b for a, b in bounds))
    elif (options.low or 0.0) >= (options.high or np.inf):
        raise SpecError(f"--from {options.low:g}: must be less than --to {options.high:g}.")
    driven = _is_driven(base, found.get("high", np.inf))
    if driven:
        found |= _settled_force(base, options, found["high"])
    if options.undamped or not driven:
        _undamped(run, options.model_copy(update=found))
    return options.model_copy(update=found)


def _channels(model: Model) -> list[str]:
    return [*model.state_names, *(quantity.name for quantity in model.quantities)]


def _at_ends(run: OpenRun, base: Parameters) -> Parameters:
    """Return the run's parameters, each swept one at the largest of its values."""
    axes = {name: swept_axis(run, name) for name in base.names}
    return base.replace(**{name: float(axis.max()) for name, axis in axes.items() if axis is not None})


def _swing(base: Parameters, frequency_hz: float) -> Array:
    """Return the changes of the rates with time alone, at a few states over a period."""
    generator, scales = np.random.default_rng(0), np.asarray(base.model.system.scales)
    states = np.repeat(generator.uniform(-1.0, 1.0, (3, 1, len(scales))) * scales, len(INSTANTS), axis=1)
    found = rates(np.tile(INSTANTS / frequency_hz, (3, 1)), states, base, frequency_hz)
    swing = found - found[:, :1]
    return np.where(np.abs(swing) > 1e-12 * np.abs(found).max(), swing, 0.0)


def _is_driven(base: Parameters, frequency_hz: float) -> bool:
    """Return whether the rates change with time at these parameters."""
    return base.model.clock.has_drive and bool(_swing(base, frequency_hz).any())


def _settled_force(base: Parameters, options: BackboneOptions, frequency_hz: float) -> dict[str, Any]:
    """Return the parameter that scales the drive, and its bounds."""
    scaling = [name for name in base.names if _scales_drive(base, name, frequency_hz)]
    force = options.drive or (scaling[0] if len(scaling) == 1 else "")
    if not force:
        several = f"{', '.join(scaling)} all scale" if scaling else "no parameter scales"
        raise SpecError(f"{several} the drive; name its amplitude with --drive, one of {', '.join(base.names)}.")
    if force not in base.names:
        raise SpecError(unknown_name("parameter", force, base.names))
    ends = sorted((0.01 * base[force], 2.0 * base[force]))
    low = ends[0] if options.drive_low is None else options.drive_low
    high = ends[1] if options.drive_high is None else options.drive_high
    if not low < high:
        raise SpecError(f"--drive-from {low:g} of {force}: must be less than --drive-to {high:g}.")
    for value in (low, high):
        base.replace(**{force: value})
    return {"drive": force, "drive_low": low, "drive_high": high}


def _scales_drive(base: Parameters, name: str, frequency_hz: float) -> bool:
    """Return whether half of a parameter's value halves the change of the rates with time."""
    try:
        half = base.replace(**{name: 0.5 * base[name]})
    except ParameterError:
        return False
    whole = _swing(base, frequency_hz)
    return bool(np.abs(_swing(half, frequency_hz) - 0.5 * whole).max() <= 1e-9 * np.abs(whole).max())


def _undamped(run: OpenRun, options: BackboneOptions) -> Parameters:
    """Return the parameters of normal modes; raise SpecError if some are not told, or the drive is on."""
    base = of_flow(parameters_of(run.cube())).replace(**options.undamped)
    swept = [n for n in base.names if n not in options.undamped and swept_axis(run, n) is not None]
    if swept:
        raise SpecError(f"the run sweeps {swept[0]}; give its value for normal modes, such as --undamped {swept[0]}=0.")
    if _is_driven(base, _interval(options)[1]):
        raise SpecError("normal modes need a system without drive; switch it off, such as by --undamped F=0.")
    return base


def _interval(options: BackboneOptions) -> tuple[float, float]:
    return options.low or 0.0, options.high or np.inf


def backbone(run: OpenRun, options: BackboneOptions) -> xr.Dataset:
    """Follow phase resonance from the quadratures of a run's response, and normal modes from its equilibria.

    Returns
    -------
    Dataset
        Over (curve, point), NaN beyond a curve's points: ``parameter`` (the frequency [Hz]), ``force`` (NaN for a
        normal mode), ``section`` (state), the multipliers that decide the stability, ``n_unstable``, and ``residual``,
        the scaled gap between the ends of the orbit. Over (..., channel) the measures of the analysis ``response``.
        Over ``curve``: ``kind``, ``n_points``, ``first_end``, ``last_end``, ``linear_frequency`` (of a normal mode).
        The attribute ``left_out`` has a line for each start that was not followed.
    """
    curves: list[Curve] = []
    left_out: list[str] = []
    if options.drive:
        _follow_resonance(run, options, curves, left_out)
    if options.undamped or not options.drive:
        _follow_modes(run, options, curves, left_out)
    return _dataset(run, options, curves, left_out)


def _follow_resonance(run: OpenRun, options: BackboneOptions, curves: list[Curve], left_out: list[str]) -> None:
    """Append curves of phase resonance, each once, from the points at which the run's response passes quadrature."""
    starts = list(_quadratures(run, options))
    run.echo(f"backbone: {counted(len(starts), 'point')} of phase resonance on the response")
    if not starts:
        left_out.append(f"phase resonance: {options.channel} is on no branch of period 1 in quadrature")
    for problem, guess in track(starts, "following phase resonance"):
        own = [c for c in curves if c.problem.base == problem.base and c.kind == "phase_resonance"]
        found = run_alone(phase_resonance(problem, guess))
        if found is None:
            frequency, force = problem.family.values(guess)
            where = f"{place_in_words(NAME, run.spec.rate, frequency)}, {options.drive} = {force:g}"
            left_out.append(f"phase resonance at {where}: Newton's method found no orbit within the bounds")
            continue
        nearest = min(found.points, key=lambda p: float(np.linalg.norm(p.u - guess)))
        if not any(lies_on(c.points, c.problem.family, nearest) for c in own):
            curves.append(found)


def _quadratures(run: OpenRun, options: BackboneOptions) -> Iterator[tuple[ResonanceProblem, Array]]:
    """Yield the equations and a guess for each step of a branch on which the cosine of the lag changes its sign."""
    located, response = (run.derive(name, parameter=NAME) for name in ("branches", "response"))
    base = parameters_of(run.cube())
    system, force = base.model.system, options.drive
    assert options.drive_low is not None
    assert options.drive_high is not None
    bounds = (_interval(options), (options.drive_low, options.drive_high))
    scales = (bounds[0][1] - bounds[0][0], bounds[1][1] - bounds[1][0])
    channel = response["channel"].values.tolist().index(options.channel)
    for i in np.flatnonzero(located["orbit_period"].values == 1):
        lag = response["phase"].values[i, : int(located["n_points"][i]), channel, 0]
        near = np.abs(np.angle(np.exp(1j * np.diff(lag)))) < 0.5 * np.pi
        own = base.replace(**{n: v for n, v in fixed_of(located, int(i)).items() if n in base.names})
        family = Family(system, 1, np.nan, own.pack(), (FREQUENCY, force), scales)
        problem = ResonanceProblem(family, own.replace(**{force: options.drive_high}), channel, bounds)
        cosine = np.cos(lag)
        for j in np.flatnonzero(near & (cosine[:-1] * cosine[1:] < 0.0)):
            share = cosine[j] / (cosine[j] - cosine[j + 1])
            first, second = located["section"].values[i, j : j + 2, 0]
            state = first + share * wrap_angles(second - first, system)
            frequency = located["parameter"].values[i, j : j + 2] @ [1.0 - share, share]
            yield problem, family.unknowns(state, [frequency, own[force]])


def _follow_modes(run: OpenRun, options: BackboneOptions, curves: list[Curve], left_out: list[str]) -> None:
    """Append the normal modes of all equilibria that are found."""
    # real part of an eigenvalue, as a share of its modulus, below which a linear mode counts as undamped
    imaginary = 1e-7
    wide = 10.0  # factor from the frequencies of the linear modes of a flow to the default bounds
    base = _undamped(run, options)
    model, starts, word = base.model, [], run.spec.rate
    channel = _channels(model).index(options.channel)
    for state, values, vectors in _equilibria(run, base):
        where = ", ".join(f"{name} {x:.4g}" for name, x in zip(model.state_names, state, strict=True))
        undamped = (values.imag > 0.0) & (np.abs(values.real) <= imaginary * np.abs(values))
        low, high = _interval(options)
        if not model.clock.has_drive and undamped.any():
            lines = values.imag[undamped] / (2.0 * np.pi)
            low, high = options.low or lines.min() / wide, options.high or lines.max() * wide
        for k in np.flatnonzero(values.imag > 0.0)[np.argsort(values.imag[values.imag > 0.0])]:
            hertz = float(values[k].imag / (2.0 * np.pi))
            line = f"normal mode of {place_in_words(NAME, word, hertz)} at {where}"
            if not undamped[k]:
                left_out.append(f"{line}: grows or decays at the rate {values[k].real:.3g} 1/s; see --undamped")
            elif not low <= hertz <= high:
                interval = place_in_words(NAME, word, low, high, between=" to ")
                left_out.append(f"{line}: outside of {interval}; widen it with --from and --to")
            else:
                scaled = state / np.asarray(model.system.scales)
                bounds = ((low, high), (0.0, options.reach))
                problem = ModeProblem(mode_family(base, hertz), base, scaled, bounds)
                starts.append((line, problem, mode_start(base, vectors[:, k], channel)))
    run.echo(f"backbone: {counted(len(starts), 'linear mode')}")
    found = run_together([normal_mode(problem, way) for _, problem, way in starts], "following normal modes")
    for (line, _, _), curve in zip(starts, found, strict=True):
        if curve is None:
            left_out.append(f"{line}: the orbits do not close; see --undamped")
        else:
            curves.append(curve)


def _equilibria(run: OpenRun, base: Parameters) -> Iterator[tuple[Array, Array, Array]]:
    """Yield equilibria, each once, with the eigenvalues and eigenvectors of their Jacobian."""
    most = 256  # cells whose last section is a guess of an equilibrium
    system = base.model.system
    seen = run.cube()["section"].isel(period_index=-1)
    sections = seen.transpose(..., "state").values.reshape(-1, system.n_states)
    sections = sections[np.isfinite(sections).all(axis=1)]
    chosen = np.unique(np.linspace(0, len(sections) - 1, min(most, len(sections))).astype(int))
    guesses = np.concatenate([np.zeros((1, system.n_states)), sections[chosen]])
    found = find_equilibria(system, guesses, base.pack())
    kept: list[Array] = []
    for row in np.flatnonzero(found.converged):
        state = wrap_angles(found.states[row], system)
        if not any(scaled_distance(state, other, system) <= SAME_EQUILIBRIUM for other in kept):
            kept.append(state)
            yield state, *np.linalg.eig(found.jacobians[row])


def _dataset(run: OpenRun, options: BackboneOptions, curves: list[Curve], left_out: list[str]) -> xr.Dataset:
    n_harmonics = 5  # that are measured
    model = of_flow(parameters_of(run.cube())).model
    n, m = max((len(c.points) for c in curves), default=0), len(model.states)
    shape = (len(curves), n)
    frequency, force, residual = np.full((3, *shape), np.nan)
    section, unstable = np.full((*shape, m), np.nan), np.full(shape, -1, np.int8)
    multiplier = np.full((*shape, m), complex(np.nan, np.nan))
    places = [(i, j) for i, curve in enumerate(curves) for j in range(len(curve.points))]
    for i, j in places:
        curve = curves[i]
        point = curve.points[j]
        (frequency[i, j], *forces), own = curve.problem.family.values(point.u), curve.multipliers(point)
        force[i, j] = forces[0] if forces else np.nan
        section[i, j] = curve.problem.family.state(point.u)
        residual[i, j], unstable[i, j] = curve.gap(point), curve.n_unstable(point)
        multiplier[i, j, : len(own)] = own
    orbits = {(i, j): curves[i].problem.orbit(curves[i].points[j].u) for i, j in places}
    variables: dict[str, Any] = measured_along(orbits, {"curve": len(curves), "point": n}, model, n_harmonics)
    over = ("curve", "point")
    linear = [c.problem.linear_hz if isinstance(c.problem, ModeProblem) else np.nan for c in curves]
    first, last = ([ENDS.index(c.ends[k]) for c in curves] for k in (0, 1))
    variables |= {
        "parameter": (over, frequency),
        "force": (over, force),
        "section": ((*over, "state"), section),
        "residual": (over, residual),
        "n_unstable": (over, unstable),
        "multiplier_real": ((*over, "multiplier"), multiplier.real),
        "multiplier_imag": ((*over, "multiplier"), multiplier.imag),
        "kind": ("curve", np.array([KINDS.index(c.kind) for c in curves], np.int8), code_flags(KINDS)),
        "n_points": ("curve", np.array([len(c.points) for c in curves], np.int32)),
        "first_end": ("curve", np.array(first, np.int8), code_flags(ENDS)),
        "last_end": ("curve", np.array(last, np.int8), code_flags(ENDS)),
        "linear_frequency": ("curve", np.array(linear, float)),
    }
    cut = (f"curve {i}: {why}" for i, curve in enumerate(curves) for why in _cut_off(curve, run.spec.rate))
    coords = {**channel_coordinates(model, n_harmonics), "state": list(model.state_names)}
    attrs = {"model": model_attribute(run.model), **section_attributes(run.model.crossing), "parameter": FREQUENCY}
    attrs |= {"parameter_units": "Hz", "of_channel": options.channel, "force": options.drive}
    return xr.Dataset(variables, coords, {**attrs, "left_out": "\n".join([*left_out, *cut])})


def _cut_off(curve: Curve, word: str) -> Iterator[str]:
    """Yield a text for each end at which a curve was cut off within its bounds."""
    for why, end in zip(curve.ends, (curve.points[0], curve.points[-1]), strict=True):
        at = f"at {place_in_words(NAME, word, curve.problem.family.values(end.u)[0])}"
        if why == "stuck":
            yield f"stuck {at}: Newton's method found no next orbit for the shortest step"
        elif why == "max_points":
            yield f"{len(curve.points)} points {at}, no more are followed; narrow the bounds"


def backbone_table(ds: xr.Dataset) -> Table:
    """Return the table of backbone curves.

    Rows are those of the curves' points and channels: ``curve``, ``kind``, ``frequency_hz``, ``force``, whether the
    orbit is stable, ``largest_multiplier`` (modulus of those that decide it), ``residual``, then the columns of a
    response: ``amplitude``, ``mean``, ``rms``, ``error``, ``harmonic_1``, ``phase_1`` [rad], ... A normal mode is
    stable if no multiplier is outside the unit circle by more than 1e-4. The text shows the range of each curve.
    """
    rows = _rows(ds)
    if not rows:
        why = f"no backbone: {'; '.join(str(ds.attrs['left_out']).splitlines()) or 'no linear mode'}"
        return Table(rows, [why], why)
    channel, force = str(ds.attrs["of_channel"]), str(ds.attrs["force"])
    unit = str(ds["unit"].sel(channel=channel).values)
    head = f"amplitude of {channel}{'' if unit in ('', '1') else f' [{unit}]'} along its backbone curves"
    lines = [head, "", *aligned([_words(ds, i, channel, force) for i in range(ds.sizes["curve"])], "")]
    return Table(rows, [*lines, *listed(ds, "left_out")])


def _rows(ds: xr.Dataset) -> list[Row]:
    name, kinds = parameter_name(str(ds.attrs["parameter"])), words_of(ds["kind"])
    moduli = np.abs(ds["multiplier_real"].values + 1j * ds["multiplier_imag"].values)
    frequency, force, residual, unstable = (ds[key].values for key in ("parameter", "force", "residual", "n_unstable"))
    heads: dict[tuple[int, int], Row] = {}
    for i in range(ds.sizes["curve"]):
        for j in range(int(ds["n_points"][i])):
            row: Row = {"curve": i, "kind": kinds[int(ds["kind"][i])], name: float(frequency[i, j])}
            row |= {"force": float(force[i, j]), "stable": bool(unstable[i, j] == 0), "residual": float(residual[i, j])}
            heads[i, j] = {**row, "largest_multiplier": float(np.nanmax(moduli[i, j], initial=0.0))}
    return channel_rows(ds, heads, ("amplitude", "mean", "rms", "error"))


def _words(ds: xr.Dataset, i: int, channel: str, force: str) -> Words:
    n = int(ds["n_points"][i])
    is_mode = bool(ds["kind"][i])
    ends = [words_of(ds[key])[int(ds[key][i])] for key in ("first_end", "last_end")]
    return {
        "curve": str(i),
        "kind": plain(words_of(ds["kind"])[int(ds["kind"][i])]),
        parameter_name(str(ds.attrs["parameter"])): _range(ds["parameter"].values[i, :n]),
        force or "force": None if not force else "" if is_mode else _range(ds["force"].values[i, :n]),
        "amplitude": _range(ds["amplitude"].sel(channel=channel).values[i, :n]),
        "stable": f"{(ds['n_unstable'].values[i, :n] == 0).mean():.0%}",
        "ends": plain(", ".join(ends)),
    }


def _range(values: Array) -> str:
    return f"{values[0]:.6g} to {values[-1]:.6g}"
