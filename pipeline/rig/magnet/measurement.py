"""Read a measurement of the torque between magnets: a TOML header and a CSV table of readings.

The header is a TOML file; ``workflows/magnet/discs.toml`` is an example, docs/magnet.md lists its keys. All
problems with the header and the table are reported at once.
"""

from __future__ import annotations

import csv
import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, create_model, model_validator

from magpend_core.models import load_model
from magpend_core.models.model import Parameters
from magpend_core.models.parameters import ParameterError
from magpend_core.models.pendulum import magnet_torque as laws
from magpend_core.models.presets import find_preset
from pipeline.rig.recordings import units
from pipeline.specification.files import find_file, read_toml, shipped_files
from pipeline.specification.problems import SpecError, unknown_choice, validated
from pipeline.specification.tables import Table

SAME_ANGLE = 1e-6
"""Locked angles that differ by less belong to one curve [rad]."""

ANGLE_UNITS = {"deg": math.pi / 180.0, "rad": 1.0}
TORQUE_UNITS = {"N m": 1.0, "mN m": 1e-3, "N": 1.0}


class AngleColumn(Table):
    """Column of the CSV table that contains angles: its name, unit and allowed range."""

    column: str = Field(description="Its name in the table's first row.")
    unit: Literal["deg", "rad"] = Field(description="Unit in the file.")
    range: Annotated[tuple[float, float], Field(strict=False)] | None = Field(
        None, description="Least and largest angle that the rig allows, in the unit; by default half a turn."
    )

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest allowed angle, in the column's unit."""
        half = math.pi / ANGLE_UNITS[self.unit]
        return self.range or (-half, half)


class TorqueColumn(Table):
    """Column of the CSV table that contains torque or force readings: its name, unit, lever arm and sign."""

    column: str = Field(description="Its name in the table's first row.")
    unit: Literal["N m", "mN m", "N"] = Field(description="Unit in the file; N: a force at the end of arm_m.")
    arm_m: Annotated[float, Field(gt=0)] | None = Field(None, description="Lever of a force in N [m].")
    sign: Literal[1, -1] = Field(1, description="-1 where a positive reading turns the pendulum back.")

    @model_validator(mode="after")
    def _lever(self) -> TorqueColumn:
        if (self.unit == "N") != (self.arm_m is not None):
            raise ValueError('arm_m goes with unit = "N" and with it alone: a force needs its lever.')
        return self

    @property
    def scale(self) -> float:
        """Factor from the column's unit to N m, with sign and lever arm."""
        return self.sign * TORQUE_UNITS[self.unit] * (self.arm_m or 1.0)


class SideColumn(Table):
    """Column of the measurement's CSV table that gives the side of the fixed magnet on which the pendulum was."""

    column: str = Field(description="Its name in the table's first row.")
    right: str = Field("right", description="Entry for the right side, where torques are positive.")
    left: str = Field("left", description="Entry for the left side.")


class Tie(Table):
    """Tie that holds the pendulum's upper link; its weight adds a torque to the readings."""

    mass_kg: float = Field(ge=0, description="Mass that hangs on the link [kg].")
    lever_m: float = Field(ge=0, description="Distance from the upper joint along the link to the mass [m].")


class Correction(Table):
    """Header table ``[correction]``: torques in the readings that the magnets do not cause, to be subtracted."""

    weights: bool = Field(description="Whether the readings include the torque of the links' weights.")
    tie: Tie | None = Field(None, description="Weight of the tie, if the readings include it.")
    without: str | None = Field(
        None, description="Column of readings without the magnets, subtracted instead of other corrections."
    )

    @model_validator(mode="after")
    def _once(self) -> Correction:
        if self.without is not None and (self.weights or self.tie is not None):
            raise ValueError("readings without the magnets have the weights already; set weights = false and drop tie.")
        return self


_COLUMNS: dict[str, Any] = {
    laws.ANGLE: (AngleColumn, Field(description="Angle over which torques are read.")),
    laws.LOCKED: (AngleColumn, Field(description="Angle that is locked.")),
    "torque": (TorqueColumn, Field(description="Readings.")),
    "side": (SideColumn, Field(description="Side of the fixed magnet.")),
}
Columns: Any = create_model("Columns", __base__=Table, **_COLUMNS)


class Header(Table):
    """TOML header of a measurement: the table's file and columns, known parameters, corrections."""

    title: str = Field(description="Title of the measurement, one line.")
    synthetic: bool = Field(False, description="Whether the readings were computed; all results state this.")
    file: str = Field(description="Table, CSV with names in its first row, relative to the header.")
    delimiter: Literal[",", ";", "\t"] = Field(",", description="Separator of the table's fields.")
    decimal: Literal[".", ","] = Field(".", description="Decimal sign of the table.")
    model: str = Field(laws.MODEL, description="Model whose torque is fitted.")
    preset: str | None = Field(None, description="Preset, or a preset's file, with the parameters that are not fitted.")
    columns: Columns = Field(description="Columns of the table.")
    parameters: dict[str, float] = Field({}, description="Known parameters of the rig; they replace the preset's.")
    provenance: dict[str, str] = Field({}, description="Origin of each value in [parameters].")
    correction: Correction = Field(description="Torques in the readings besides the magnets' torque.")
    hold: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        (), description="Parameters that the joint fit does not change."
    )
    synthesis: dict[str, Any] = Field({}, description="Notes on how synthetic readings were made.")

    @model_validator(mode="after")
    def _signs(self) -> Header:
        if self.delimiter == self.decimal:
            raise ValueError('delimiter and decimal are both ","; say which of them is something else.')
        return self


@dataclass(frozen=True, eq=False)
class Curve:
    """Torque curve: the readings at one locked angle, on one side of the fixed magnet."""

    side: int  # index in `laws.SIDES`
    locked: float
    rows: np.ndarray  # indices of its readings in the measurement

    def __str__(self) -> str:
        return f"{laws.LOCKED} = {math.degrees(self.locked):.4g} deg, {laws.SIDES[self.side]}"


@dataclass(frozen=True, eq=False)
class Measurement:
    """Measurement of the magnets' torque: readings in SI units, before and after subtracting all other torques."""

    header: Header
    path: Path
    digest: str  # sha256 of the table
    parameters: Parameters  # parameters of the model that are known before the fit
    # angles [rad], one per reading
    angle: np.ndarray
    locked: np.ndarray
    side: np.ndarray  # indices in `laws.SIDES`
    reading: np.ndarray  # uncorrected torque [N m]
    torque: np.ndarray  # of the magnets alone [N m]
    warnings: tuple[str, ...] = ()  # names of columns that were taken though they are not the header's

    @cached_property
    def curves(self) -> tuple[Curve, ...]:
        """Torque curves of the measurement, sorted by side (right first) and rising locked angle."""
        return curves_of(self.locked, self.side)

    @property
    def label(self) -> str:
        """Title of the measurement, beginning with "SYNTHETIC" if the readings were computed."""
        return ("SYNTHETIC: " if self.header.synthetic else "") + self.header.title


def curves_of(locked: np.ndarray, side: np.ndarray) -> tuple[Curve, ...]:
    """Group readings into torque curves: one for each side and locked angle."""
    found = []
    for code in range(len(laws.SIDES)):
        rows = np.flatnonzero(side == code)
        rows = rows[np.argsort(locked[rows], kind="stable")]
        breaks = np.flatnonzero(np.diff(locked[rows]) > SAME_ANGLE) + 1
        found += [Curve(code, float(np.median(locked[r])), np.sort(r)) for r in np.split(rows, breaks) if len(r)]
    return tuple(found)


def find_measurement(name: str | Path) -> Path:
    """Return the path of a measurement's header, given as a path or as the name of a measurement in the package."""
    return find_file("measurement", name, {path.stem: path for path in shipped_files("magnet/*.toml")})


def read_measurement(path: str | Path) -> Measurement:
    """Read a measurement: its TOML header and its table of readings, corrected and in SI units.

    Raise `SpecError` with all problems at once: unknown or missing keys and columns, fields that are not numbers,
    angles out of range, curves with too few readings, sides with too few curves.
    """
    path = Path(path)
    header = validated(Header, read_toml(path))
    parameters, problems = _known(header, path.parent)
    table, content, more, warnings = _table(path.parent / header.file, header)
    problems += more
    columns = _numbers(header, table, problems) if table else {}
    if columns:
        curves = curves_of(columns[laws.LOCKED], columns["side"])
        problems += _curve_problems(curves)
    if problems or parameters is None:
        raise SpecError(problems)
    angle, locked, reading = columns[laws.ANGLE], columns[laws.LOCKED], columns["torque"]
    torque = reading - _besides(header.correction, parameters, angle, locked, columns)
    digest = hashlib.sha256(content).hexdigest()
    return Measurement(
        header, path, digest, parameters, angle, locked, columns["side"], reading, torque, tuple(warnings)
    )


def _besides(
    correction: Correction, p: Parameters, angle: np.ndarray, locked: np.ndarray, columns: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Return the part of the torque that the magnets do not cause, such as that of the links' weights [N m]."""
    if correction.without is not None:
        return columns["without"]
    found = laws.weight_torque(angle, locked, p) if correction.weights else np.zeros_like(angle)
    if correction.tie is not None:
        found = found - correction.tie.mass_kg * p["g"] * correction.tie.lever_m * np.sin(angle)
    return found


def _known(header: Header, folder: Path) -> tuple[Parameters | None, list[str]]:
    """Return the model parameters that are known before the fit, and the problems with them."""
    problems = [
        f"parameters.{name}: has no provenance; say in [provenance] where the value comes from."
        for name in header.parameters
        if not header.provenance.get(name, "").strip()
    ]
    problems += [unknown_choice("hold", name, laws.FITTED) for name in header.hold if name not in laws.FITTED]
    try:
        model = load_model(header.model)
    except ParameterError as error:
        return None, problems + [f"model: {p}" for p in error.problems]
    lacking = [name for name in laws.FITTED if name not in model.parameter_names]
    if lacking:
        problems.append(f"model = {header.model!r}: has no {', '.join(lacking)}; set {laws.MODEL!r}.")
        return None, problems
    fitted = [name for name in header.parameters if name in laws.FITTED and name not in header.hold]
    problems += [f"parameters.{n}: is fitted; drop it, or name it in hold." for n in fitted]
    try:
        preset = None if header.preset is None else find_preset(header.preset, folder)
        return model.load(preset, **header.parameters), problems
    except ParameterError as error:
        return None, problems + [f"parameters: {p}" for p in error.problems]


# ---- the table -----------------------------------------------------------------------------------


def _table(path: Path, header: Header) -> tuple[dict[str, list[str]], bytes, list[str], list[str]]:
    """Read the CSV table; return its columns as text, the file's bytes, problems and warnings."""
    try:
        content = path.read_bytes()
        lines = [line for line in content.decode("utf-8-sig").splitlines() if line.strip()]
    except OSError as error:
        return {}, b"", [f"file = {header.file!r}: cannot be read ({error.strerror or error})."], []
    except UnicodeDecodeError:
        return {}, b"", [f"file = {header.file!r}: is not text in UTF-8; write the table as CSV."], []
    rows = list(csv.reader((line for line in lines if not line.startswith("#")), delimiter=header.delimiter))
    if len(rows) < 2:
        return ({}, content, [f"file = {header.file!r}: has no readings; names in the first row, then numbers."], [])
    names = [name.strip() for name in rows[0]]
    wanted, warnings = _but_for_units(_wanted(header), names, header)
    problems = [
        f"columns.{key} = {name!r}: {header.file} has no such column; it has: {', '.join(names)}."
        for key, name in wanted.items()
        if name not in names
    ]
    ragged = [i for i, row in enumerate(rows[1:], 1) if len(row) != len(names)]
    if ragged:
        problems.append(f"{header.file}: {_places(ragged)}: not {len(names)} fields as in the first row.")
    if problems:
        return {}, content, problems, []
    columns = {key: [row[names.index(name)].strip() for row in rows[1:]] for key, name in wanted.items()}
    return columns, content, [], warnings


def _wanted(header: Header) -> dict[str, str]:
    found = {name: getattr(header.columns, name).column for name in type(header.columns).model_fields}
    if header.correction.without is not None:
        found["without"] = header.correction.without
    return found


def _but_for_units(wanted: dict[str, str], names: list[str], header: Header) -> tuple[dict[str, str], list[str]]:
    """Accept columns that differ from the header's by a unit in brackets; return their names, and warnings."""
    found, warnings = dict(wanted), []
    for key, name in wanted.items():
        near = units.names_with_unit(name, names)
        if name in names or len(near) != 1 or key == "side":
            continue
        found[key], stated = near[0]
        own = getattr(header.columns, "torque" if key == "without" else key).unit
        path = "correction.without" if key == "without" else f"columns.{key}"
        text = f"{path} = {name!r}: {header.file} has {found[key]!r}; it is taken for the same"
        if not units.same(stated, own):
            text += f", in {own} as the header says"
        warnings.append(f"{text}.")
    return found, warnings


def _numbers(header: Header, table: Mapping[str, list[str]], problems: list[str]) -> dict[str, np.ndarray]:
    """Convert the table's columns to arrays in SI units; if there are problems, add them and return an empty dict."""
    before, found = len(problems), {}
    where = header.file
    for key in (name for name in table if name != "side"):
        found[key] = values = np.array([_number(text, header.decimal) for text in table[key]])
        bad = np.flatnonzero(~np.isfinite(values)) + 1
        if bad.size:
            problems.append(f"{where}: {key}: {_places(bad)}: no finite number; correct it or drop the row.")
    for key in (laws.ANGLE, laws.LOCKED):
        column = getattr(header.columns, key)
        low, high = column.limits
        out = np.flatnonzero((found[key] < low) | (found[key] > high)) + 1
        if out.size:
            problems.append(
                f"{where}: {key}: {_places(out)}: outside of {low:g} to {high:g} {column.unit}; "
                f"check unit and zero, or set columns.{key}.range."
            )
        found[key] = found[key] * ANGLE_UNITS[column.unit]
    for key in {"torque", "without"} & set(found):
        found[key] = found[key] * header.columns.torque.scale
    words = {header.columns.side.right: 0, header.columns.side.left: 1}
    unknown = [i for i, text in enumerate(table["side"], 1) if text not in words]
    if unknown:
        choice = " or ".join(repr(word) for word in words)
        problems.append(f"{where}: side: {_places(unknown)}: must be {choice}; see columns.side.")
    found["side"] = np.array([words.get(text, -1) for text in table["side"]])
    return found if len(problems) == before else {}


def _number(text: str, decimal: str) -> float:
    try:
        return float(text.replace(decimal, "."))
    except ValueError:
        return math.nan


def _places(rows: Any) -> str:
    """Name rows of the table, from 1, in a message: at most three, then the number of further ones."""
    most = 3
    named = ", ".join(str(i) for i in rows[:most])
    more = f" and {len(rows) - most} more" if len(rows) > most else ""
    return f"row{'s' if len(rows) > 1 else ''} {named}{more}"


def _curve_problems(curves: tuple[Curve, ...]) -> list[str]:
    least = 5  # readings of a curve. A bump has three parameters; further readings show how well it fits.
    fewest = 4  # curves of a side; the height over the locked angle has three parameters
    problems = [
        f"curve {curve}: has {len(curve.rows)} readings; at least {least} are needed: add some, or leave the curve out."
        for curve in curves
        if len(curve.rows) < least
    ]
    for code, side in enumerate(laws.SIDES):
        n = sum(curve.side == code for curve in curves)
        if n < fewest:
            problems.append(f"side {side!r}: has {n} curves; the fit over the locked angle needs at least {fewest}.")
    return problems
