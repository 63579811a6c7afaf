"""Test a finished identification on a table of measured orbits that was held back."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.rig.identify.directory import read_info, read_result
from pipeline.rig.identify.measured_orbits import judge_orbits, measured_table
from pipeline.rig.identify.orbit_reports import orbits_result
from pipeline.rig.identify.orbit_tables import OrbitsTable
from pipeline.rig.identify.specification import IdentificationSpec, parse_identification
from pipeline.specification.files import read_toml
from pipeline.specification.problems import SpecError


def is_table(path: str | Path) -> bool:
    """Return whether a file is a table of measured orbits rather than a recording."""
    path = Path(path)
    if path.suffix.lower() == ".toml":
        return True
    if path.suffix.lower() != ".csv":
        return False
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            return "amplitude" in next(csv.reader(file), [])
    except (OSError, UnicodeDecodeError, csv.Error):
        return False


def check_orbits(directory: str | Path, table: str | Path) -> dict[str, Any]:
    """Compare the orbits of a measured table with the branches of an identified model.

    Parameters
    ----------
    directory
        Directory of a finished identification.
    table
        CSV table of orbits, or a specification with ``[measured.branch]``; see `read_branch`. Section, drive frequency
        and state are those of the identification's first table ``[[orbits]]``, unless the file has its own.

    Returns
    -------
    dict
        ``orbits``, ``rms`` and ``parameter`` as in ``result.json``; ``file`` and ``directory``.

    Raises
    ------
    SpecError
        If the table cannot be read, or no section is known for a model without a drive.
    RefusedError
        If the identification is not finished.
    """
    info, result = read_info(directory), read_result(directory)
    spec, own = _stored(info.identity["spec"], result), _table(info.identity["spec"], Path(table))
    measured = measured_table(spec, own, str(table))
    found = orbits_result([judge_orbits(measured, result["values"])])[0]
    return {"directory": str(directory), "file": Path(table).name, **found}


def _stored(spec: dict[str, Any], result: dict[str, Any]) -> IdentificationSpec:
    """Return a specification with the identified model and no orbits; its file paths are relative to the working
    directory.
    """
    first = next(iter(spec["identify"]))
    tables = {
        "kind": "identification",
        "model": result["model"],
        "identify": {first: {"start": result["values"][first]}},
        "orbits": [{}],
    }
    return replace(parse_identification(tables, Path()), orbits=())


def _table(spec: dict[str, Any], path: Path) -> OrbitsTable:
    if not path.is_file():
        raise SpecError(f"{path}: no such file.")
    first = spec["orbits"][0]["data"] if spec["orbits"] else {}
    crossing = first.get("section")
    has_own = path.suffix.lower() == ".toml" and "section" in read_toml(path)
    table = {
        "file": str(path),
        "state": "" if path.suffix.lower() == ".toml" else first.get("state", ""),
        "section": crossing if crossing and not has_own else None,
        "frequency_hz": first.get("frequency_hz") if crossing is None else None,
        # only errors are wanted here, so that no scatter is needed
        "model_error": {"amplitude": 1.0, "frequency": 1.0},
    }
    return OrbitsTable.model_validate(table)
