"""Parse and validate the TOML specification of an identification."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from magpend_core.defaults import RTOL
from magpend_core.models import model_names
from magpend_core.models.model import Model, Parameters
from magpend_core.models.parameters import near_names
from magpend_core.models.presets import is_file
from pipeline.rig.identify.orbit_tables import OrbitsTable
from pipeline.rig.identify.settings import setting_problems
from pipeline.rig.identify.unknowns import Pair, ParameterTables, Unknown
from pipeline.specification.files import IDENTIFICATION, read_toml
from pipeline.specification.models import add_model
from pipeline.specification.problems import SpecError, checked, table_at, unknown_choice, unknown_key
from pipeline.specification.tables import Table


class SensorsTable(Table):
    """Table ``[sensors]``: channels whose zero offset is unknown."""

    zero: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        (), description="Channels whose zero is unknown: one offset per recording"
    )


class RecordingTable(Table):
    """Table ``[[recordings]]``: file of a recording, mapping file of its channels, kind of its drive, time window and
    held-out pieces.
    """

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
    """Validated specification of an identification.

    Attributes
    ----------
    title : str
        Title of the identification.
    model : Model
        Model that is fitted.
    preset : str, optional
        Preset as given; by default the model's first.
    parameters : dict
        Fixed values by name, which replace the preset's.
    values : Parameters
        Values of the preset with `parameters` applied.
    unknowns : tuple of Unknown
        Identified parameters.
    tied : dict
        By parameter, the factor and the name of the identified parameter that it follows.
    sensors, recordings, orbits, fit, search
        Tables of the specification.
    folder : Path
        Folder that paths of files are relative to.
    """

    title: str
    model: Model
    preset: str | None
    parameters: dict[str, float]
    values: Parameters
    unknowns: tuple[Unknown, ...]
    tied: dict[str, tuple[float, str]]
    sensors: SensorsTable
    recordings: tuple[RecordingTable, ...]
    orbits: tuple[OrbitsTable, ...]
    fit: FitTable
    search: SearchTable
    folder: Path

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
            "sensors": self.sensors.model_dump(mode="json"),
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
    """Read and validate the TOML file that specifies an identification.

    Raises
    ------
    SpecError
        With all problems at once; also if the file cannot be read or is not TOML.
    """
    path = Path(path)
    return parse_identification(read_toml(path), path.parent)


def parse_identification(data: Mapping[str, Any], folder: Path) -> IdentificationSpec:
    """Validate the TOML tables of an identification; file paths in them are relative to `folder`.

    Raises
    ------
    SpecError
        With all problems at once.
    """
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
    if fit is not None and sensors is not None and fit.channels:
        problems += [
            f"sensors.zero: {name!r} is not among fit.channels; add it there, or drop it here."
            for name in sensors.zero
            if name in known and name not in fit.channels
        ]
    return problems
