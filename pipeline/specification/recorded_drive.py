"""Define the table ``[drive]`` (recorded drive) of a specification, and check it against the other tables."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from pipeline.specification.drive_files import DUTY, EDGES, TORQUE, RecordedDrive, parse_drive, read_drive
from pipeline.specification.problems import SpecError
from pipeline.specification.tables import FREQUENCY, Table

if TYPE_CHECKING:
    from magpend_core.models.model import Model


class DriveTable(Table):
    """The table ``[drive]``: a recording in place of the model's own drive."""

    file: str = Field(min_length=1, description="Drive file (CSV), relative to the specification.")
    section_hz: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="Sections per second of a torque; by default sections lie at its rising edges."
    )
    sha256: str | None = Field(default=None, description="Digest of the file; filled in when the file is read.")
    text: str | None = Field(default=None, description="The file's text; filled in when the file is read.")


def with_drive(data: Mapping[str, Any], folder: str | Path, problems: list[str]) -> Mapping[str, Any]:
    """Read the drive file that a specification names and add its text and sha256 to ``[drive]``, unless they are
    there.
    """
    table = data.get("drive")
    if not isinstance(table, dict) or not isinstance(table.get("file"), str) or "text" in table:
        return data
    try:
        text, digest = read_drive(Path(folder) / table["file"])
    except SpecError as error:
        problems += [f"drive.file = {table['file']!r}: {p}" for p in error.problems]
        return data
    return {**data, "drive": {"sha256": digest, **table, "text": text}}


def is_whole(table: Any) -> bool:
    """Return whether the recording in a ``[drive]`` table has the sha256 stored with it, or there is no such table."""
    if not isinstance(table, Mapping):
        return True
    return hashlib.sha256(str(table.get("text", "")).encode()).hexdigest() == table.get("sha256")


def recorded(table: DriveTable | None, problems: list[str]) -> RecordedDrive | None:
    """Parse the recording in a ``[drive]`` table; return None if there is no table or if it has problems."""
    if table is None or table.text is None:  # an unreadable file is reported already
        return None
    if hashlib.sha256(table.text.encode()).hexdigest() != table.sha256:
        problems.append(
            f"drive.sha256 = {table.sha256!r}: is not the digest of {table.file}; drop the key, or "
            "restore the file with this digest."
        )
        return None
    try:
        return parse_drive(table.text, Path(table.file).name, table.sha256, table.section_hz)
    except SpecError as error:
        problems += error.problems
        return None


def model_problems(drive: RecordedDrive, model: Model) -> list[str]:
    """Return the reasons why a model cannot be driven by a recording; empty if it can."""
    from magpend_core.engine.placeholders import no_forcing

    if model.system.forcing is no_forcing:
        return [f"drive: {model.name} has no drive that a recording could replace; drop the drive."]
    if drive.kind == EDGES and DUTY not in model.parameter_names:
        return [
            f"drive: measured edges need a model with a parameter {DUTY}, and {model.name} has none; give "
            "its drive as a torque (columns time_s,drive)."
        ]
    return []


def run_problems(
    drive: RecordedDrive | None, model: Model, data: Mapping[str, Any], integration: Any, starts: Any
) -> list[str]:
    """Return the problems of a specification with a recorded drive.

    Parameters
    ----------
    drive
        The recording; None if there is none, and then no problems.
    model
        Model that is integrated.
    data
        Tables of the specification; kind, axes, parameters and products are checked.
    integration, starts
        Valid tables of the specification, or None.
    """
    if drive is None:
        return []
    problems = model_problems(drive, model)
    if data.get("kind") == "continuation":
        problems.append(
            "drive: a continuation starts each value from the last state of the one before, and a recording "
            'cannot start again there; set kind = "sweep", or drop [drive].'
        )
    for table in ("axes", "parameters.overrides", "parameters"):
        problems += _replaced_problems(drive, table, data)
    if not drive.n_periods:
        problems.append(f"drive: {drive.file} has no rising edge after its start, so no section; set drive.section_hz.")
    elif integration is not None and integration.n_transient + integration.n_keep > drive.n_periods:
        problems.append(
            f"integration: n_transient = {integration.n_transient} and n_keep = {integration.n_keep} are "
            f"{integration.n_transient + integration.n_keep} drive periods, and {drive.file} has "
            f"{drive.n_periods}; lower them, or record longer."
        )
    if integration is not None and integration.stop_when_closed:
        problems.append(
            "integration.stop_when_closed: under a recorded drive only n_transient and n_keep set the "
            "length; drop the key."
        )
    if getattr(starts, "refine", None) is not None:
        problems.append(
            "initial_conditions.refine: cells are inferred from closed orbits, and the jitter of a "
            "recording keeps orbits from closing; drop the key, or [drive]."
        )
    problems += _idle_problems(drive, model, data.get("axes", {}))
    return problems + _product_problems(drive, data.get("products", {}))


def _idle_problems(drive: RecordedDrive, model: Model, axes: Any) -> list[str]:
    """Return problems of axes that sweep parameters of the model's own drive while a recorded torque replaces it."""
    if drive.kind != TORQUE or not isinstance(axes, Mapping) or not set(axes) - {FREQUENCY, DUTY}:
        return []
    from magpend_core.engine.driven import drive_parameters

    idle = drive_parameters(model.system, model.load().pack())
    return [
        f"axes.{name}: changes only the model's own drive, which the torque of {drive.file} "
        "replaces; drop the axis, or give the drive as edges."
        for name in axes
        if name in idle and name != DUTY
    ]


def _replaced_problems(drive: RecordedDrive, table: str, data: Mapping[str, Any]) -> list[str]:
    """Return a problem for each drive frequency or duty cycle that is given although the recording determines it."""
    found: Any = data
    for key in table.split("."):
        found = found.get(key, {}) if isinstance(found, Mapping) else {}
    names = (DUTY,) if table.endswith("overrides") else (FREQUENCY,) if table == "parameters" else (FREQUENCY, DUTY)
    return [
        f"{table}.{name}: the recorded drive {drive.file} has its own; drop the key, or [drive]."
        for name in names
        if isinstance(found, Mapping) and name in found
    ]


def _product_problems(drive: RecordedDrive, products: Any) -> list[str]:
    names = products if isinstance(products, Mapping) else {}
    problems = []
    if "lyapunov" in names:
        problems.append(
            "products.lyapunov: exponents are averages over many periods, and a recording "
            "ends; drop the product, or [drive]."
        )
    if "extremes" in names and drive.kind == TORQUE:
        problems.append(
            "products.extremes: extremes are taken over drive periods, and the intervals of a torque are not "
            "periods; drop the product, or give the drive as edges (columns rising_s,falling_s)."
        )
    return problems
