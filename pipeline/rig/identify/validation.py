"""Test identified models on recordings and measured orbits that were held back, and compare identifications."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from magpend_core.models import load_model
from magpend_core.models.model import Parameters
from pipeline.products.product import Table
from pipeline.rig.identify.build import apply_settings, drive_problems, pieces_of
from pipeline.rig.identify.directory import read_info, read_result
from pipeline.rig.identify.identification import require_starts
from pipeline.rig.identify.judgement import judge
from pipeline.rig.identify.measured_orbits import judge_orbits, measured_table, orbits_result
from pipeline.rig.identify.problem import Free, Problem
from pipeline.rig.identify.specification import IdentificationSpec, OrbitsTable, RecordingTable, parse_identification
from pipeline.rig.recordings import parse_mapping, read_recording, smooth
from pipeline.specification.files import read_toml
from pipeline.specification.problems import SpecError


def check(directory: str | Path, recording: str | Path, *, like: int = 0) -> dict[str, Any]:
    """Test a finished identification on another recording; return the residuals' rms and the correlation by channel.

    The file's pieces stay whole, and each has a free start. Every sample counts. The criterion is least squares,
    whatever the loss of the fit. The mapping, drive and zeros are those of the fitted recording with the index `like`.
    Return ``rms`` [SI] and ``correlation`` by channel, ``pieces`` with the rms of each, ``units`` by channel, ``file``,
    ``sha256`` and ``directory``.

    Raise `SpecError` if the recording cannot be read through the mapping, or its pieces are too short, and
    `NotConvergedError` if the starts could not be fitted.
    """
    info, result = read_info(directory), read_result(directory)
    if not result["recordings"]:
        raise SpecError(f"{recording}: {directory} was fitted to orbits alone; give a table of orbits.")
    tables = info.identity["spec"]["recordings"]
    if not 0 <= like < len(tables):
        raise SpecError(f"like = {like}: there are recordings 0 to {len(tables) - 1}.")
    table = RecordingTable.model_validate(
        {
            "file": str(recording),
            "mapping": "",
            "drive": tables[like]["drive"],
            **{key: tables[like][key] for key in ("parameters", "frequency_hz", "phase") if key in tables[like]},
        }
    )
    if table.drive == "known" and table.phase is None:
        raise SpecError(
            f"like = {like}: the phase of its drive was fitted, and that of {recording} is not known; add {recording} "
            "to [[recordings]] of the specification with some of its pieces in hold_out, and identify again."
        )
    ds = read_recording(recording, parse_mapping(info.mappings[like], f"mapping of recording {like}"))
    model = load_model(result["model"])
    channels = tuple(result["channels"])
    missing = [name for name in channels if name not in ds]
    problems = [f"{recording}: has no channel {name!r}; it must have those that were fitted." for name in missing]
    problems += drive_problems(model, [table], [ds], str(recording))
    if problems:
        raise SpecError(problems)
    pieces = pieces_of(model, channels, (ds, smooth(ds)), table, like)
    pieces = apply_settings(pieces, {like: table.parameters})
    zeros = result["zeros"]
    free = tuple(Free(name, value) for name, value in zeros.items())
    problem = Problem(
        model=model,
        fixed=Parameters(model, result["values"]),
        free=free,
        channels=channels,
        pieces=tuple(pieces),
        noise=np.array([result["noise"][c] for c in channels]),
        rtol=float(info.identity["spec"]["fit"]["rtol"]),
        recorded=table.drive == "recorded",
    )
    judgement, fit = judge(problem, result["values"], zeros, pieces)
    require_starts(fit, f"pieces of {recording}")
    return {
        "directory": str(directory),
        "file": Path(recording).name,
        "sha256": ds.attrs["sha256"],
        "units": {c: model.state(c).unit for c in channels},
        **judgement.as_dict(),
    }


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

    The table is a CSV file of orbits, or a specification with ``[measured.branch]``; see `read_branch`. Section, drive
    frequency and state are those of the identification's first table ``[[orbits]]``, unless the file has its own.
    Return ``orbits``, ``rms`` and ``parameter`` as in ``result.json``; ``file`` and ``directory``.
    """
    info, result = read_info(directory), read_result(directory)
    spec, own = _stored(info.identity["spec"], result), _table(info.identity["spec"], Path(table))
    measured = measured_table(spec, own, str(table))
    found = orbits_result([judge_orbits(measured, result["values"])])[0]
    return {"directory": str(directory), "file": Path(table).name, **found}


def _stored(spec: dict[str, Any], result: dict[str, Any]) -> IdentificationSpec:
    """Return a specification with the identified model and no orbits, with paths from the working directory."""
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


# ---- comparison of identifications -----------------------------------------------------------------


def compare(directories: Sequence[str | Path]) -> Table:
    """Compare finished identifications in a table, sorted by their residuals on held-out pieces, else held-out orbits,
    else by the fit.

    ``fit`` and ``held_out`` are the root mean squares over all channels of fitted and of held-out pieces, each channel
    in units of its noise in the first identification, and ``fit_NAME`` and ``held_out_NAME`` those of each channel
    [SI]. ``orbits_fit`` and ``orbits_held_out`` are the root mean squares of the amplitudes' relative errors of
    measured orbits. Values that do not exist are NaN.

    Raise `SpecError` if recordings, channels or held-out pieces differ, since residuals cannot be compared then.
    """
    found = [(Path(d), read_info(d), read_result(d)) for d in directories]
    _require_alike(found)
    noise = found[0][2]["noise"]
    rows = [_row(directory, result, noise) for directory, _, result in found]
    rows.sort(key=lambda r: next(r[k] for k in _ORDER if not math.isnan(r[k])))
    return Table(rows, _lines(rows, found[0][2]))


def _require_alike(found: Sequence[tuple[Path, Any, Any]]) -> None:
    first, problems = found[0], []
    for directory, info, result in found[1:]:
        for what, a, b in (
            ("recordings", _recordings(first[1]), _recordings(info)),
            ("measured orbits", _orbits(first[2]), _orbits(result)),
            ("channels", first[2]["channels"], result["channels"]),
            ("held-out pieces", _held(first[2]), _held(result)),
        ):
            if a != b:
                problems.append(
                    f"{directory}: has other {what} than {first[0]}; compare identifications of the same "
                    "data, with the same pieces held out."
                )
    if problems:
        raise SpecError(problems)


def _recordings(info: Any) -> list[str]:
    return [r["sha256"] for r in info.identity["spec"]["recordings"]]


def _held(result: Any) -> list[tuple[int, int]]:
    pieces = result["held_out"]["pieces"] if result["held_out"] is not None else []
    return [(p["recording"], p["piece"]) for p in pieces]


_ORDER = ("held_out", "orbits_held_out", "fit", "orbits_fit")


def _orbits(result: Any) -> list[tuple[str, bool]]:
    return [(o["name"], o["held_out"]) for table in result["orbits"] for o in table["orbits"]]


def _orbit_error(result: Any, is_held_out: bool) -> float:
    """Return the rms of the relative amplitude errors; infinite if a measured orbit has no computed counterpart."""
    errors = [
        math.inf if o["relative_error"] is None else o["relative_error"]
        for table in result["orbits"]
        for o in table["orbits"]
        if o["held_out"] == is_held_out
    ]
    return math.sqrt(sum(e**2 for e in errors) / len(errors)) if errors else math.nan


def _row(directory: Path, result: Any, noise: dict[str, float]) -> dict[str, Any]:
    held = result["held_out"]
    row: dict[str, Any] = {
        "directory": str(directory),
        "title": result["title"],
        "unknowns": len(result["names"]),
        "fit": _overall(result["rms"], noise),
        "held_out": _overall(held["rms"], noise) if held is not None else math.nan,
        "orbits_fit": _orbit_error(result, False),
        "orbits_held_out": _orbit_error(result, True),
    }
    for channel in result["channels"]:
        row[f"fit_{channel}"] = result["rms"][channel]
        row[f"held_out_{channel}"] = held["rms"][channel] if held is not None else math.nan
    return row


def _overall(rms: dict[str, float], noise: dict[str, float]) -> float:
    return math.sqrt(sum((rms[c] / noise[c]) ** 2 for c in rms) / len(rms)) if rms else math.nan


def _lines(rows: Sequence[dict[str, Any]], result: Any) -> list[str]:
    lines = []
    for row in rows:
        parts = []
        for what, words in (("held_out", "held out"), ("fit", "fit")):
            values = [(c, row[f"{what}_{c}"]) for c in result["channels"]]
            if not math.isnan(row[what]):
                parts.append(f"{words} " + ", ".join(f"{c} {v:.4g} {result['units'][c]}" for c, v in values))
        for what, words in (("orbits_held_out", "held-out orbits"), ("orbits_fit", "fitted orbits")):
            if not math.isnan(row[what]):
                error = "lost" if math.isinf(row[what]) else f"{100.0 * row[what]:.3g} %"
                parts.append(f"amplitude of {words} {error}")
        lines.append(f"{row['directory']}: {'; '.join(parts)}; {row['unknowns']} unknowns")
    if math.isnan(rows[0]["held_out"]) and math.isnan(rows[0]["orbits_held_out"]):
        lines.append("no pieces were held out (hold_out): the fit alone favours whatever has more unknowns")
    return lines
