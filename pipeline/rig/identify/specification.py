"""Parse and validate the TOML specification of an identification."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from magpend_core.defaults import RTOL
from magpend_core.models import model_names
from magpend_core.models.model import Model, Parameters
from magpend_core.models.parameters import (
    FRACTION,
    NON_NEGATIVE,
    POSITIVE,
    ParameterError,
    near_names,
    unknown_name_problem,
)
from magpend_core.models.presets import is_file
from pipeline.specification.files import IDENTIFICATION, read_toml
from pipeline.specification.models import add_model
from pipeline.specification.problems import SpecError, checked, table_at, unknown_choice, unknown_key
from pipeline.specification.section import SectionTable
from pipeline.specification.tables import Table

# ---- measured orbits -------------------------------------------------------------------------------

Quantity = Literal["amplitude", "frequency", "mean", "harmonics"]

Pair = Annotated[tuple[float, float], Field(strict=False)]


class BifurcationTable(Table):
    """Table ``[[orbits.bifurcations]]``: bifurcation that was measured, with its 95 % interval."""

    kind: Literal["fold", "doubling", "torus", "hopf"] = Field(description="Kind of the bifurcation.")
    interval: Pair = Field(description="95 % interval of the parameter, [low, high].")
    period: int = Field(1, ge=1, description="Period of its orbit [drive periods or returns]; no matter for hopf.")
    name: str = Field("", description="Name; by default kind and place in the list.")


class OrbitsTable(Table):
    """Table ``[[orbits]]``: measured orbits along a parameter, and measured bifurcations."""

    file: str = Field(
        "", description="Table of orbits (CSV) or specification with [measured.branch], relative to this file."
    )
    parameter: str = Field("", description="Parameter of the bifurcations; by default that of the file.")
    state: str = Field("", description="State of a CSV file's amplitudes; by default the model's first.")
    section: SectionTable | None = Field(
        None, description="Poincare section of a model without a drive; by default that of the file."
    )
    period: int = Field(1, ge=1, description="Period of the orbits [drive periods or returns].")
    frequency_hz: float | None = Field(None, gt=0, description="Drive frequency [Hz], unless it is the parameter.")
    range: Pair | None = Field(
        None, description="Interval of the parameter in which branches are computed; by default half as wide again."
    )
    parameters: dict[str, float] = Field(
        default_factory=dict, description="Values of parameters in these measurements alone."
    )
    quantities: Annotated[tuple[Quantity, ...], Field(strict=False, min_length=1)] = Field(
        ("amplitude", "frequency"), description="Quantities that are fitted; a drive determines the frequency."
    )
    model_error: dict[Quantity, Annotated[float, Field(ge=0)]] = Field(
        default_factory=dict,
        description="Standard deviation that the model is allowed, relative to the measured value; it is added to "
        "that of the measurement.",
    )
    parameter_sd: float = Field(
        0.0,
        ge=0,
        description="Standard deviation of the parameter's measured values. Above 0 the nearest orbit of the branch is "
        "compared, which is also there beside a fold.",
    )
    hold_out: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        (), description="Names of orbits and bifurcations that are judged but not fitted."
    )
    bifurcations: Annotated[tuple[BifurcationTable, ...], Field(strict=False)] = Field(
        (), description="Measured bifurcations."
    )


# ---- parameters ------------------------------------------------------------------------------------


class Prior(Table):
    """Prior of a parameter from an independent measurement: mean and standard deviation."""

    mean: float
    sd: Annotated[float, Field(gt=0)]


class Identified(Table):
    """Table ``[identify.NAME]``: first guess, bounds and prior of a parameter to be identified."""

    start: float | None = Field(None, description="First guess; by default the preset's value")
    bounds: Pair | None = Field(None, description="[low, high]; by default those of the model")
    prior: Prior | None = Field(
        None, description="An independent measurement, { mean = ..., sd = ... }: a weight, a length"
    )


@dataclass(frozen=True)
class Unknown:
    """Parameter to be identified, with first guess, bounds and prior filled in."""

    name: str
    # in the parameter's unit
    start: float
    lower: float
    upper: float
    prior: Prior | None


_TIE = re.compile(r"\s*(?:([+-]?\s*[0-9.]+(?:[eE][+-]?[0-9]+)?)\s*\*\s*|(-)\s*)?([A-Za-z_]\w*)\s*")


class ParameterTables:
    """Fixed values, unknowns and ties (parameters proportional to others) of a specification, checked together."""

    def __init__(self, data: Mapping[str, Any], model: Model, preset: str | Path | None, problems: list[str]) -> None:
        self._model, self._problems = model, problems
        identified = table_at(data, "identify", problems)
        tied = table_at(data, "tied", problems)
        self.fixed = dict(table_at(data, "parameters", problems))
        self.values = self._values(preset)
        if not identified:
            problems.append("identify: missing; add a table [identify.NAME] for each parameter to identify.")
        self.unknowns = tuple(
            one for name, table in identified.items() if (one := self._unknown(name, table)) is not None
        )
        self.tied = self._ties(tied, identified)
        for name in self.fixed:
            if name in identified or name in tied:
                where = "identify" if name in identified else "tied"
                problems.append(f"parameters.{name}: is also in {where}; keep one of the two.")
        if self.values is not None and not problems:
            self._check_together()

    def _values(self, preset: str | Path | None) -> Parameters | None:
        try:
            self._model.load(preset)
        except ParameterError as error:
            self._problems += [f"preset: {p}" for p in error.problems]
            return None
        try:
            return self._model.load(preset, **self.fixed)
        except ParameterError as error:
            self._problems += [f"parameters: {p}" for p in error.problems]
            return None

    def _unknown(self, name: str, table: Any) -> Unknown | None:
        if name not in self._model.parameter_names:
            self._problems.append(f"identify.{name}: {unknown_name_problem(name, self._model.parameter_names)}")
            return None
        one = checked(Identified, table, f"identify.{name}", self._problems)
        if one is None or (self.values is None and one.start is None):
            return None
        start = one.start if one.start is not None else self.values[name]  # type: ignore[index]
        wrong = self._model.parameter(name).problem(start)
        if wrong is not None:
            self._problems.append(f"identify.{name}.start: {wrong}")
            return None
        low, high = one.bounds or self._bounds(name, start)
        for bound in one.bounds or ():
            wrong = self._model.parameter(name).problem(bound)
            # an open bound of the model may be named as the end of a range
            if wrong is not None and bound not in (0.0, 1.0):
                self._problems.append(f"identify.{name}.bounds: {wrong}")
        if not low < high:
            self._problems.append(f"identify.{name}.bounds = [{low:g}, {high:g}]: must rise.")
        elif not low <= start <= high:
            self._problems.append(
                f"identify.{name}.bounds = [{low:g}, {high:g}]: exclude the start {start:g}; widen them, or "
                f"give another start."
            )
        least, most = self._bounds(name, start)
        return Unknown(name, start, max(low, least), min(high, most), one.prior)

    def _bounds(self, name: str, start: float) -> tuple[float, float]:
        """Return the model's bounds on a parameter, just inside where the bound is not an allowed value."""
        least = 1e-9  # smallest value of a positive parameter, relative to its start
        margin = 1e-6  # distance that a fraction keeps from 0 and 1
        return {
            POSITIVE: (least * start, math.inf),
            NON_NEGATIVE: (0.0, math.inf),
            FRACTION: (margin, 1.0 - margin),
        }.get(self._model.parameter(name).bound, (-math.inf, math.inf))

    def _ties(self, table: Mapping[str, Any], identified: Mapping[str, Any]) -> dict[str, tuple[float, str]]:
        found = {}
        for name, text in table.items():
            one = self._tie(name, text, table, identified)
            if one is not None:
                found[name] = one
        return found

    def _tie(
        self, name: str, text: Any, table: Mapping[str, Any], identified: Mapping[str, Any]
    ) -> tuple[float, str] | None:
        known, path = self._model.parameter_names, f"tied.{name}"
        match = _TIE.fullmatch(text) if isinstance(text, str) else None
        factor, other = math.nan, ""
        if match is not None:
            number, minus, other = match.groups()
            factor = -1.0 if minus else _number(number)
        if name not in known:
            problem = unknown_name_problem(name, known)
        elif not math.isfinite(factor):
            problem = 'must be a name, or a number times one, such as "NAME" or "-1.0*NAME".'
        elif name in identified:
            problem = "is also in identify; keep one of the two."
        elif other == name:
            problem = "is tied to itself; name the identified parameter that it follows."
        elif other not in known:
            problem = unknown_name_problem(other, known)
        elif other in table:
            problem = f"follows {other}, which is tied itself; tie both to one identified parameter."
        elif other not in identified:
            problem = f"follows {other}, which is not identified; give its value under [parameters]."
        else:
            return factor, other
        self._problems.append(f"{path} = {text!r}: {problem}")
        return None

    def _check_together(self) -> None:
        assert self.values is not None
        starts = {u.name: u.start for u in self.unknowns}
        tied = {name: factor * starts[other] for name, (factor, other) in self.tied.items()}
        try:
            Parameters(self._model, {**self.values.as_dict(), **starts, **tied})
        except ParameterError as error:
            self._problems += [f"identify: at the start, {p}" for p in error.problems]


def _number(text: str | None) -> float:
    try:
        return 1.0 if text is None else float(text.replace(" ", ""))
    except ValueError:
        return math.nan


# ---- the whole specification -----------------------------------------------------------------------


def setting_problems(model: Model, values: Mapping[str, float], where: str) -> list[str]:
    """Return problems with values set for one recording: unknown parameters, values out of bounds."""
    found = []
    for name, value in values.items():
        if name not in model.parameter_names:
            hint = near_names(name, model.parameter_names, "parameters")
            found.append(f"{where}.{name}: is not a parameter of {model.name}; {hint}")
            continue
        problem = model.parameter(name).problem(value)
        if problem:
            found.append(f"{where}.{problem}")
    return found


class SensorsTable(Table):
    """Table ``[sensors]``: channels whose zero offset is unknown."""

    zero: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        (), description="Channels whose zero is unknown: one offset per recording"
    )
    drift: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        (), description="Channels of zero whose zero also moves at a constant unknown rate: one per recording"
    )


class RecordingTable(Table):
    """Table ``[[recordings]]``: file, mapping, kind of the drive, time window and held-out pieces."""

    file: str = Field(description="Recording, relative to the specification")
    mapping: str = Field(description="Mapping file of the recording, relative to the specification")
    drive: Literal["none", "recorded", "edges", "known"] = Field(
        "none",
        description="`none`: the drive was off; `recorded`: the torque was measured; `edges`: the times of "
        "switching were measured, the model gives shape and amplitude; `known`: it was not measured, its frequency is "
        "known, the model gives shape and amplitude",
    )
    frequency_hz: Annotated[float, Field(gt=0)] | None = Field(
        None, description="Frequency of the drive in this recording [Hz], for `known`"
    )
    phase: Annotated[float, Field(ge=0, lt=1)] | None = Field(
        None, description="Phase of a `known` drive at the recording's time 0 [drive periods]; by default fitted"
    )
    parameters: dict[str, float] = Field(
        default_factory=dict,
        description="Values of parameters in this recording alone, such as a drive's amplitude of 0",
    )
    piece_s: Annotated[float, Field(gt=0)] | None = Field(
        None, description="Cut pieces into equal stretches of about this length [s], each with a free start"
    )
    window_s: Pair | None = Field(None, description="Start and end of the part that is used [s since the first sample]")
    hold_out: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False)] = Field(
        (), description="Indices of pieces (with `piece_s`, of stretches) that are judged but not fitted"
    )


class FitTable(Table):
    """Table ``[fit]``: channels, loss, weights and numerical method of the fit."""

    channels: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        (),
        description="States that are compared; by default those that all recordings measure, without "
        "rates of measured angles",
    )
    loss: Literal["linear", "soft_l1", "huber", "cauchy"] = Field(
        "linear", description="Loss of residuals in units of their scale; `linear` is least squares"
    )
    continuity: Literal["free"] | Annotated[float, Field(gt=0, strict=False)] = Field(
        "free",
        description="For stretches cut by `piece_s`: `free` starts, or the weight of the gap between the end "
        "of one and the start of the next, in units of the noise",
    )
    noise: dict[str, Annotated[float, Field(gt=0)]] = Field(
        default_factory=dict,
        description="Standard deviation that channels are weighted with; by default estimated, one value for "
        "all channels of a unit",
    )
    decimate: Annotated[int, Field(ge=1)] = Field(1, description="Step between the samples that are used")
    rtol: Annotated[float, Field(gt=0, le=1e-3)] = Field(RTOL, description="Tolerance of the integration")
    slopes: Literal["differences", "variational"] = Field(
        "differences",
        description="Sensitivities: differences between lanes, or variational equations (more exact, slower)",
    )


class SearchTable(Table):
    """Table ``[search]``: first guesses of the global search, and whether to compute profile likelihoods."""

    n_starts: Annotated[int, Field(ge=1, le=10_000)] = Field(
        8, description="Number of first guesses that are refined; the first is the specification's"
    )
    seed: Annotated[int, Field(ge=0)] = Field(1, description="Seed of the guesses")
    spread: Annotated[float, Field(ge=0, lt=1)] = Field(
        0.3, description="Largest distance of guesses from the specification's start, relative to it"
    )
    method: Literal["sobol", "cma"] = Field(
        "sobol", description="`sobol`: the best of many points; `cma`: CMA-ES over short stretches"
    )
    n_samples: Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        256, description="Number of points from which the best `n_starts` are chosen"
    )
    profiles: bool = Field(True, description="Whether to compute profile likelihoods")


@dataclass(frozen=True)
class IdentificationSpec:
    """Validated specification of an identification."""

    title: str
    model: Model
    preset: str | None  # preset as given; by default the model's first
    parameters: dict[str, float]  # fixed values by name, which replace the preset's
    values: Parameters  # values of the preset with `parameters` applied
    unknowns: tuple[Unknown, ...]
    # by parameter, the factor and the name of the identified parameter that it follows
    tied: dict[str, tuple[float, str]]
    sensors: SensorsTable
    recordings: tuple[RecordingTable, ...]
    orbits: tuple[OrbitsTable, ...]
    fit: FitTable
    search: SearchTable
    folder: Path  # folder that paths of files are relative to

    @property
    def preset_found(self) -> str | Path | None:
        """Name of the preset, or path of its file, as `Model.preset` expects it."""
        return _found(self.preset, self.folder)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the identified parameters."""
        return tuple(u.name for u in self.unknowns)

    def path(self, name: str) -> Path:
        """Return the path of a file named in the specification, relative to the specification's folder."""
        return self.folder / name

    def as_dict(self) -> dict[str, Any]:
        """Return the specification as plain data with all defaults but without the title. Equal data mean equal
        identifications.
        """
        return {
            "kind": IDENTIFICATION,
            "model": self.model.reference,
            "values": self.values.as_dict(),
            "identify": {
                u.name: {
                    "start": u.start,
                    "bounds": [_plain(u.lower), _plain(u.upper)],
                    **({"prior": u.prior.model_dump()} if u.prior else {}),
                }
                for u in self.unknowns
            },
            "tied": {name: [factor, other] for name, (factor, other) in self.tied.items()},
            "sensors": self.sensors.model_dump(mode="json", exclude=set() if self.sensors.drift else {"drift"}),
            "recordings": [r.model_dump(mode="json", exclude_none=True) for r in self.recordings],
            "orbits": [t.model_dump(mode="json", exclude_none=True) for t in self.orbits],
            "fit": self.fit.model_dump(mode="json"),
            "search": self.search.model_dump(mode="json"),
        }


def _plain(bound: float) -> float | str:
    return bound if math.isfinite(bound) else str(bound)


_KEYS = (
    "kind", "title", "model", "preset", "parameters", "identify", "tied", "sensors", "recordings", "orbits", "fit",
    "search",
)  # fmt: skip


def load_identification(path: str | Path) -> IdentificationSpec:
    """Read and validate the TOML file of an identification; raise `SpecError` with all problems at once."""
    path = Path(path)
    return parse_identification(read_toml(path), path.parent)


def parse_identification(data: Mapping[str, Any], folder: Path) -> IdentificationSpec:
    """Validate an identification's tables, with paths relative to `folder`; raise `SpecError` with all problems."""
    kind = data.get("kind")
    if kind in ("sweep", "continuation"):
        raise SpecError(f'kind = "{kind}": is a run, not an identification; use magpend run.')
    problems = [unknown_key(key, key, _KEYS) for key in data if key not in _KEYS]
    if kind != IDENTIFICATION:
        missing = f'kind: missing; add kind = "{IDENTIFICATION}".'
        problems.append(missing if kind is None else unknown_choice("kind", kind, [IDENTIFICATION]))
    title, preset = (_text(data, key, problems) for key in ("title", "preset"))
    model = _model(data, folder, problems)
    sensors = _table(data, "sensors", SensorsTable, problems)
    fit = _table(data, "fit", FitTable, problems)
    search = _table(data, "search", SearchTable, problems)
    recordings = _recordings(data, folder, problems)
    orbits = _orbits(data, folder, problems)
    if model is None:
        raise SpecError(problems)
    problems += _channel_problems(model, sensors, fit)
    for i, table in enumerate(recordings):
        problems += setting_problems(model, table.parameters, f"recordings[{i}].parameters")
    own = ParameterTables(data, model, _found(preset, folder), problems)
    if problems:
        raise SpecError(problems)
    assert own.values is not None
    return IdentificationSpec(
        title or "",
        model,
        preset,
        own.fixed,
        own.values,
        own.unknowns,
        own.tied,
        sensors,
        recordings,
        orbits,
        fit,
        search,
        folder,
    )


def _text(data: Mapping[str, Any], key: str, problems: list[str]) -> str | None:
    value = data.get(key)
    if value is not None and not isinstance(value, str):
        problems.append(f"{key} = {value!r}: must be a text in quotes.")
        return None
    return value


def _found(preset: str | None, folder: Path) -> str | Path | None:
    return folder / preset if preset is not None and is_file(preset) else preset


def _model(data: Mapping[str, Any], folder: Path, problems: list[str]) -> Model | None:
    if "model" not in data:
        problems.append(f"model: missing; add the name of one ({', '.join(model_names())}), or its text.")
        return None
    return add_model(data["model"], folder, problems)


def _table(data: Mapping[str, Any], key: str, model: type[Table], problems: list[str]) -> Any:
    return checked(model, table_at(data, key, problems), key, problems)


def _recordings(data: Mapping[str, Any], folder: Path, problems: list[str]) -> tuple[RecordingTable, ...]:
    tables = data.get("recordings", [] if data.get("orbits") else None)
    if not isinstance(tables, list) or (not tables and not data.get("orbits")):
        problems.append(
            "recordings: missing; add a table [[recordings]] with file and mapping for each, or [[orbits]] with "
            "measured orbits."
        )
        return ()
    found = []
    for i, table in enumerate(tables):
        one = checked(RecordingTable, table, f"recordings[{i}]", problems)
        if one is None:
            continue
        found.append(one)
        problems += [
            f"recordings[{i}].{key} = {name!r}: no such file ({folder / name}); paths count from the "
            "specification's folder."
            for key, name in (("file", one.file), ("mapping", one.mapping))
            if not (folder / name).is_file()
        ]
        if one.window_s is not None and not one.window_s[0] < one.window_s[1]:
            problems.append(
                f"recordings[{i}].window_s = {list(one.window_s)}: is empty; give [start, end] with the "
                "start below the end [s]."
            )
        problems += _known_drive_problems(one, f"recordings[{i}]")
        if len(set(one.hold_out)) < len(one.hold_out):
            problems.append(f"recordings[{i}].hold_out: names a piece twice; name each once.")
    return tuple(found)


def _known_drive_problems(table: RecordingTable, where: str) -> list[str]:
    if table.drive == "known":
        missing = f'{where}.frequency_hz: missing; drive = "known" asks for the frequency of the drive [Hz], above 0.'
        return [missing] if table.frequency_hz is None else []
    return [
        f'{where}.{key} = {value:g}: belongs to drive = "known" alone, and here drive = "{table.drive}"; change one '
        "of the two."
        for key, value in (("frequency_hz", table.frequency_hz), ("phase", table.phase))
        if value is not None
    ]


def _orbits(data: Mapping[str, Any], folder: Path, problems: list[str]) -> tuple[OrbitsTable, ...]:
    tables = data.get("orbits", [])
    if not isinstance(tables, list):
        problems.append("orbits: must be a list of tables; write [[orbits]].")
        return ()
    found = [checked(OrbitsTable, table, f"orbits[{i}]", problems) for i, table in enumerate(tables)]
    problems += [
        f"orbits[{i}].file = {one.file!r}: no such file ({folder / one.file}); paths count from the specification's "
        "folder."
        for i, one in enumerate(found)
        if one is not None and one.file and not (folder / one.file).is_file()
    ]
    return tuple(one for one in found if one is not None)


def _channel_problems(model: Model, sensors: SensorsTable | None, fit: FitTable | None) -> list[str]:
    """Return problems with channels that are not states of the model."""
    named = {
        "sensors.zero": sensors.zero if sensors is not None else (),
        "sensors.drift": sensors.drift if sensors is not None else (),
        "fit.channels": fit.channels if fit is not None else (),
        "fit.noise": tuple(fit.noise) if fit is not None else (),
    }
    known = model.state_names
    problems = [
        f"{key}: {name!r} is not a state of {model.name}; {near_names(name, known, 'states')}"
        for key, names in named.items()
        for name in names
        if name not in known
    ]
    problems += [
        f"sensors.drift: {name!r} is not among sensors.zero; its zero at time 0 is unknown as well: add it there."
        for name in (sensors.drift if sensors is not None else ())
        if name in known and name not in (sensors.zero if sensors is not None else ())
    ]
    if fit is not None and sensors is not None and fit.channels:
        problems += [
            f"sensors.zero: {name!r} is not among fit.channels; add it there, or drop it here."
            for name in sensors.zero
            if name in known and name not in fit.channels
        ]
    return problems
