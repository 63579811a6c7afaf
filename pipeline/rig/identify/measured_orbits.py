"""Read measured orbits and bifurcations for a fit, find their first computed counterparts, and judge a model on
them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from magpend_core.crossing import Crossing
from magpend_core.models.model import Model, Parameters
from magpend_core.models.parameters import ParameterError
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.branches.carrying import ORBIT, PARAMETER, Along, Array, Datum, OrbitData, Solution, settled
from pipeline.analysis.branches.kinds import DOUBLING, FOLD, HOPF, KINDS, TORUS
from pipeline.layout.vocabulary import FREQUENCY_DIM, axes_of, axis_name
from pipeline.layout.writing import json_value
from pipeline.results.tabular import words_of
from pipeline.rig.identify.specification import OrbitsTable, setting_problems
from pipeline.rig.measured.branch import STABILITIES, branch_table, compare, nearest_orbit, read_branch
from pipeline.rig.measured.branch_computed import amplitudes, branches_along
from pipeline.specification.files import read_toml
from pipeline.specification.problems import SpecError, problems_of
from pipeline.specification.section import SectionTable

if TYPE_CHECKING:
    from pipeline.rig.identify.specification import IdentificationSpec


MEDIAN = math.sqrt(math.pi / 2.0)
"""Standard error of the median of Gaussian values in units of that of their mean."""

_KINDS = {"fold": FOLD, "doubling": DOUBLING, "torus": TORUS, "hopf": HOPF}


@dataclass(frozen=True)
class MeasuredTable:
    """Measured orbits and bifurcations of one table ``[[orbits]]``, read and checked."""

    along: Along  # model, parameter and interval
    state: str  # measured state; empty if there are bifurcations alone
    fitted: tuple[Datum, ...]
    held_out: tuple[Datum, ...]
    measured: xr.Dataset | None  # orbits as of `read_branch`; None if there are bifurcations alone
    settings: Mapping[str, float]  # values of parameters in these measurements alone

    @property
    def data(self) -> tuple[Datum, ...]:
        """All measured orbits and bifurcations: first those that are fitted, then those held out."""
        return (*self.fitted, *self.held_out)

    def branches(self, values: Mapping[str, float]) -> tuple[xr.Dataset, Array]:
        """Compute the model's branches along the measured parameter, and the amplitudes of their orbits."""
        parameters = _parameters(self.along.model, {**values, **self.settings})
        state = self.state or self.along.model.section_states[0]
        column = self.along.model.state_names.index(state)
        at, sizes = np.array([self.along.low, self.along.high]), np.zeros(2)
        if self.measured is not None:
            at, sizes = self.measured["value"].values, self.measured["amplitude"].values
        # from the measured amplitude a trajectory may settle on a large orbit, from rest on a small one
        starts = np.zeros((2 * len(at), len(self.along.model.states)))
        starts[::2, column] = sizes
        found = branches_along(self.along, parameters, np.repeat(at, 2).tolist(), starts)
        return found, amplitudes(found, parameters, state)

    def as_dict(self) -> dict[str, Any]:
        """Return the measured orbits and settings as plain data, to be stored and compared."""
        crossing = self.along.model.crossing
        return {
            "section": None if crossing is None else vars(crossing),
            "parameter": self.along.parameter,
            "interval": [self.along.low, self.along.high],
            "frequency_hz": self.along.frequency_hz if math.isfinite(self.along.frequency_hz) else None,
            "state": self.state,
            "parameters": dict(self.settings),
            "fitted": [_plain(d) for d in self.fitted],
            "held_out": [_plain(d) for d in self.held_out],
        }


def _plain(datum: Datum) -> dict[str, Any]:
    return {**vars(datum), "measured": datum.measured.tolist(), "sd": datum.sd.tolist()}


def measured_table(spec: IdentificationSpec, table: OrbitsTable, where: str) -> MeasuredTable:
    """Read and check one table ``[[orbits]]``; raise `SpecError` with all problems at once."""
    problems: list[str] = []
    measured = _read(spec, table, where)
    parameter = axis_name(table.parameter or ("" if measured is None else measured.attrs["parameter"]))
    model = _model(spec, table, where)
    problems += _parameter_problems(spec, table, model, parameter, where)
    data = [*_orbits(table, measured, model, where, problems), *_bifurcations(table, where, problems)]
    names = [d.name for d in data]
    problems += [
        f"{where}.hold_out: {name!r} is no orbit or bifurcation of it; there are {', '.join(names)}."
        for name in table.hold_out
        if name not in names
    ]
    if not data:
        problems.append(f"{where}: has neither a file of orbits nor bifurcations; add one of them.")
    if problems:
        raise SpecError(problems)
    low, high = table.range or _range(data)
    frequency = model.clock.hertz or table.frequency_hz or math.nan
    return MeasuredTable(
        Along(model, parameter, low, high, frequency, 2 * max([1, *(d.period for d in data)])),
        "" if measured is None else str(measured.attrs["state"]),
        tuple(d for d in data if d.name not in table.hold_out),
        tuple(d for d in data if d.name in table.hold_out),
        measured,
        dict(table.parameters),
    )


def stored_table(data: Mapping[str, Any], model: Model, measured: xr.Dataset | None) -> MeasuredTable:
    """Restore a `MeasuredTable` from the plain data of its `as_dict`, the model, and its measured orbits."""
    section = data["section"]
    whole = model if section is None else sectioned(model, Crossing(**section))
    fitted, held_out = (tuple(_datum(d) for d in data[key]) for key in ("fitted", "held_out"))
    frequency = math.nan if data["frequency_hz"] is None else float(data["frequency_hz"])
    low, high = data["interval"]
    longest = 2 * max([1, *(d.period for d in (*fitted, *held_out))])
    along = Along(whole, data["parameter"], low, high, frequency, longest)
    return MeasuredTable(along, data["state"], fitted, held_out, measured, data["parameters"])


def _datum(data: Mapping[str, Any]) -> Datum:
    arrays = {key: np.array(data[key]) for key in ("measured", "sd")}
    return Datum(**{**data, **arrays, "quantities": tuple(data["quantities"])})


def read_orbits(spec: IdentificationSpec) -> list[MeasuredTable]:
    """Read all tables ``[[orbits]]`` of a specification; raise `SpecError` with all problems at once."""
    found, problems = [], []
    for i, table in enumerate(spec.orbits):
        try:
            found.append(measured_table(spec, table, f"orbits[{i}]"))
        except SpecError as error:
            problems += error.problems
    if problems:
        raise SpecError(problems)
    return found


def _read(spec: IdentificationSpec, table: OrbitsTable, where: str) -> xr.Dataset | None:
    if not table.file:
        return None
    try:
        return read_branch(spec.path(table.file), spec.model, table.state)
    except SpecError as error:
        raise SpecError([f"{where}: {p}" for p in error.problems]) from None
    except OSError as error:
        raise SpecError(f"{where}.file = {table.file!r}: cannot be read ({error}).") from None


def _model(spec: IdentificationSpec, table: OrbitsTable, where: str) -> Model:
    """Return the fitted model. A model without a drive gets the Poincare section that the table or its file gives."""
    model, section = spec.model, table.section
    if model.clock.has_drive:
        if section is not None:
            raise SpecError(f"{where}.section: {model.name} has a drive; its sections are once per drive period.")
        return model
    if section is None and table.file.endswith(".toml"):
        section = _section_of(spec, table)
    if section is None:
        raise SpecError(
            f"{where}.section: missing; {model.name} has no drive: give section = {{ of = ..., value = ... }}."
        )
    try:
        return sectioned(model, section.crossing)
    except ParameterError as error:
        raise SpecError([f"{where}.{problem}" for problem in error.problems]) from None


def _section_of(spec: IdentificationSpec, table: OrbitsTable) -> SectionTable | None:
    from pydantic import ValidationError

    own = read_toml(spec.path(table.file)).get("section")
    if own is None:
        return None
    try:
        return SectionTable.model_validate(own)
    except ValidationError as error:
        raise SpecError([f"{table.file}: {p}" for p in problems_of(error, SectionTable, "section")]) from None


def _parameter_problems(
    spec: IdentificationSpec, table: OrbitsTable, model: Model, parameter: str, where: str
) -> list[str]:
    problems = setting_problems(spec.model, table.parameters, f"{where}.parameters")
    is_frequency = parameter == FREQUENCY_DIM
    if not parameter:
        problems.append(f"{where}.parameter: missing; name the parameter along which was measured.")
    elif parameter not in axes_of(model):
        problems.append(f"{where}.parameter = {parameter!r}: is not a parameter of {model.name}.")
    if parameter in (*spec.names, *spec.tied):
        problems.append(
            f"{where}: the orbits were measured along {parameter}, which is identified; fix it or drop the table."
        )
    if model.clock.has_drive and not is_frequency and table.frequency_hz is None:
        problems.append(f"{where}.frequency_hz: missing; the orbits were measured along {parameter} at one frequency.")
    if table.range is not None and not table.range[0] < table.range[1]:
        problems.append(f"{where}.range = {list(table.range)}: must rise.")
    return problems


def _orbits(
    table: OrbitsTable, measured: xr.Dataset | None, model: Model, where: str, problems: list[str]
) -> list[Datum]:
    """Return the measured orbits as `Datum` objects; add missing quantities and standard deviations to `problems`."""
    found: list[Datum] = []
    if measured is None:
        return found
    wanted = [q for q in table.quantities if q != "frequency" or not model.clock.has_drive]
    for k in range(measured.sizes["orbit"]):
        one = measured.isel(orbit=k)
        name = str(one["name"].item())
        columns = [c for q in wanted for c in _measured_quantity(one, q, table.model_error.get(q, 0.0))]
        if table.parameter_sd:
            columns.append((PARAMETER, float(one["value"]), table.parameter_sd))
        known = [(n, v, sd) for n, v, sd in columns if math.isfinite(v)]
        problems += [
            f"{where}: {name!r} has no scatter of its {n}; give {n}_sd in the file, or model_error = {{ {n} = ... }}."
            for n, _, sd in known
            if not sd > 0.0
        ]
        if not any(n != PARAMETER for n, _, _ in known):
            problems.append(f"{where}: {name!r} has none of the quantities {', '.join(wanted)}.")
            continue
        names, values, sds = zip(*known, strict=True)
        found.append(
            Datum(
                name,
                ORBIT,
                float(one["value"]),
                table.period,
                int(one["stability"]),
                names,
                np.array(values),
                np.array(sds),
            )
        )
    return found


def _measured_quantity(one: xr.Dataset, quantity: str, allowed: float) -> list[tuple[str, float, float]]:
    if quantity == "harmonics":
        if "harmonic" not in one:
            return []
        values = one["harmonic"].values
        # the scatter of the amplitude is that of its largest harmonic
        sd = _error(float(one["amplitude_sd"]), int(one["n_cycles"]))
        return [(f"harmonic_{k + 1}", float(v), math.hypot(sd, allowed * v)) for k, v in enumerate(values)]
    value = float(one[quantity])
    sd = _error(float(one[f"{quantity}_sd"]), int(one["n_cycles"]))
    return [(quantity, value, math.hypot(sd, allowed * value))]


def _error(scatter: float, n_cycles: int) -> float:
    """Return the standard error of a median over cycles from their scatter; the scatter itself for one cycle."""
    if not math.isfinite(scatter):
        return 0.0
    return scatter * MEDIAN / math.sqrt(n_cycles) if n_cycles > 1 else scatter


def _bifurcations(table: OrbitsTable, where: str, problems: list[str]) -> list[Datum]:
    n_sd = 3.919928  # width of a 95 % interval of a Gaussian, in standard deviations
    found = []
    for i, one in enumerate(table.bifurcations):
        low, high = one.interval
        if not low < high:
            problems.append(f"{where}.bifurcations[{i}].interval = {[low, high]}: must rise.")
            continue
        kind, middle = _KINDS[one.kind], 0.5 * (low + high)
        period = 0 if one.kind == "hopf" else one.period
        sd = np.array([(high - low) / n_sd])
        name = one.name or f"{one.kind} {i + 1}"
        found.append(Datum(name, kind, middle, period, 0, (PARAMETER,), np.array([middle]), sd))
    return found


def _range(data: Sequence[Datum]) -> tuple[float, float]:
    margin = 0.5  # part of the measured interval of the parameter by which branches are computed beyond it
    values = [d.value for d in data]
    low, high = min(values), max(values)
    room = margin * (high - low) or 0.2 * abs(high) or 1.0
    least = 0.5 * low if low > 0.0 else -math.inf
    return max(low - room, least), high + room


def _parameters(model: Model, values: Mapping[str, float]) -> Parameters:
    base = model.load()
    return base.replace(**{name: value for name, value in values.items() if name in model.parameter_names})


# ---- first orbits ------------------------------------------------------------------------------


def first_orbits(tables: Sequence[MeasuredTable], values: Mapping[str, float]) -> tuple[OrbitData, ...]:
    """Find the computed orbit or bifurcation for each fitted measurement, at the first guess of the parameters.

    Raise `SpecError` with the names of all that have none.
    """
    found, problems = [], []
    for i, table in enumerate(tables):
        if not table.fitted:
            continue
        branches, computed = table.branches(values)
        rows = []
        for datum in table.fitted:
            is_orbit = datum.kind == ORBIT
            own = _first_orbit(table, datum, branches, computed) if is_orbit else _first_point(datum, branches)
            if own is None:
                problems.append(_nowhere(f"orbits[{i}]", datum, table))
            else:
                rows.append(own)
        if len(rows) == len(table.fitted):
            packed = _parameters(table.along.model, {**values, **table.settings}).pack()
            known = Solution(packed, np.array(rows), np.zeros((len(rows), len(rows[0]))))
            guess = OrbitData(table.along, table.state, table.fitted, known, table.settings)
            exact = settled(guess)
            if exact is None:
                problems.append(f"orbits[{i}]: the first orbits could not be computed; give starts that are nearer.")
            else:
                found.append(exact)
    if problems:
        raise SpecError(problems)
    return tuple(found)


def _nowhere(where: str, datum: Datum, table: MeasuredTable) -> str:
    along = table.along
    if datum.kind == ORBIT:
        kind = f"{STABILITIES[datum.stability]} orbit" if datum.stability else "orbit"
        what = f"no {kind} of period {datum.period} at {along.parameter} = {datum.value:g}"
    else:
        what = f"no {datum.kind.replace('_', ' ')} between {along.parameter} = {along.low:g} and {along.high:g}"
    return (
        f"{where}: {datum.name!r}: at the start of the fit the model has {what}; give starts that are nearer, a wider "
        "range, or hold it out."
    )


def _first_orbit(table: MeasuredTable, datum: Datum, branches: xr.Dataset, computed: Array) -> Array | None:
    """Return section point and parameter value of the computed orbit whose amplitude is nearest to a measured one."""
    assert table.measured is not None
    amplitude = float(table.measured["amplitude"].values[list(table.measured["name"].values).index(datum.name)])
    place = nearest_orbit(branches, computed, datum.value, datum.stability, amplitude, datum.period)
    if place is None:
        return None
    i, j, share = place
    a, b = branches["section"].values[i, j : j + 2, 0]
    return np.append(a + share * (b - a), datum.value)


def _first_point(datum: Datum, branches: xr.Dataset) -> Array | None:
    """Return section point and parameter of the computed bifurcation of a measured one's kind that is nearest."""
    words = words_of(branches["kind"]) if "kind" in branches else KINDS
    periods = branches["orbit_period"].values[branches["of_branch"].values]
    fits = [
        e
        for e, (kind, period) in enumerate(zip(branches["kind"].values, periods, strict=True))
        if words[int(kind)] == datum.kind and int(period) == datum.period
    ]
    if not fits:
        return None
    values = branches["value"].values
    best = min(fits, key=lambda e: abs(float(values[e]) - datum.value))
    return np.append(branches["bifurcation_section"].values[best, 0], values[best])


# ---- judging -----------------------------------------------------------------------------------


def judge_orbits(table: MeasuredTable, values: Mapping[str, float]) -> xr.Dataset:
    """Compare the orbits and bifurcations of a measured table with newly computed branches.

    Return a dataset as of `compare`, with ``held_out``, and over ``bifurcation`` the measured and computed values.
    """
    branches, computed = table.branches(values)
    found = xr.Dataset() if table.measured is None else compare(table.measured, branches, computed)
    held = {d.name for d in table.held_out}
    if table.measured is not None:
        found["held_out"] = ("orbit", np.array([str(n) in held for n in found["name"].values], np.int8))
    points = [d for d in table.data if d.kind != ORBIT]
    rows = [_first_point(d, branches) for d in points]
    found = found.assign_coords(bifurcation=[d.name for d in points])
    found["measured_value"] = ("bifurcation", [d.value for d in points])
    found["measured_value_sd"] = ("bifurcation", [float(d.sd[0]) for d in points])
    found["computed_value"] = ("bifurcation", [math.nan if r is None else float(r[-1]) for r in rows])
    found["bifurcation_held_out"] = ("bifurcation", np.array([d.name in held for d in points], np.int8))
    return found


GROUPS = ("fitted", "held_out")


def orbits_result(judged: Sequence[xr.Dataset]) -> list[dict[str, Any]]:
    """Return the judged orbits and bifurcations of each table as plain data: ``parameter``, ``orbits``,
    ``bifurcations``, ``rms``.

    The last one is the root mean square of the relative errors of amplitude and frequency, for fitted and for held-out
    orbits of each stability.
    """
    return [
        {
            "parameter": str(ds.attrs.get("parameter", "")),
            "orbits": _orbit_rows(ds),
            "bifurcations": _bifurcation_rows(ds),
            "rms": _rms(ds),
        }
        for ds in judged
    ]


def _orbit_rows(ds: xr.Dataset) -> list[dict[str, Any]]:
    if "orbit" not in ds.sizes:
        return []
    rows = branch_table(ds).rows
    held = ds["held_out"].values
    return [json_value(row) | {"held_out": bool(h)} for row, h in zip(rows, held, strict=True)]


def _bifurcation_rows(ds: xr.Dataset) -> list[dict[str, Any]]:
    return [
        {
            "name": str(one["bifurcation"].item()),
            "measured": float(one["measured_value"]),
            "measured_sd": float(one["measured_value_sd"]),
            "computed": json_value(float(one["computed_value"])),
            "held_out": bool(one["bifurcation_held_out"]),
        }
        for one in (ds.isel(bifurcation=k) for k in range(ds.sizes["bifurcation"]))
    ]


def _rms(ds: xr.Dataset) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the rms of the relative errors by group, stability and quantity; None if an orbit was not found."""
    found: dict[str, dict[str, dict[str, Any]]] = {group: {} for group in GROUPS}
    if "orbit" not in ds.sizes:
        return found
    words, held = words_of(ds["stability"]), ds["held_out"].values
    for is_held, group in enumerate(GROUPS):
        for code, word in enumerate(words):
            chosen = (held == is_held) & (ds["stability"].values == code)
            if not chosen.any():
                continue
            own = {"amplitude": ds["relative_error"].values[chosen], "frequency": ds["frequency_error"].values[chosen]}
            found[group][word] = {name: json_value(float(np.sqrt(np.mean(e**2)))) for name, e in own.items()}
    return found


def orbit_lines(result: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the comparison of measured and computed orbits in ``result.json`` as printed lines."""
    lines = []
    for table in result:
        for group in GROUPS:
            for word, errors in table["rms"][group].items():
                shown = ", ".join(
                    f"{name} {'lost' if rms is None else format(100.0 * rms, '.2g') + ' %'}"
                    for name, rms in errors.items()
                )
                stability = "" if word == "unknown" else f"{word} "
                lines.append(f"{group.replace('_', ' ')} {stability}orbits: root mean square errors {shown}")
        for one in table["bifurcations"]:
            computed = "none" if one["computed"] is None else f"{one['computed']:.6g}"
            held = ", held out" if one["held_out"] else ""
            lines.append(f"{one['name']}{held}: measured {one['measured']:.6g} ± {one['measured_sd']:.2g}, {computed}")
    return lines
