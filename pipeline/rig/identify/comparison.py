"""Compare identifications by how well they predict the held-out pieces of the recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.products.product import Table
from pipeline.rig.identify.directory import read_info, read_result
from pipeline.specification.problems import SpecError


def compare(directories: Sequence[str | Path]) -> Table:
    """Compare finished identifications in a table, sorted by their residuals on held-out pieces.

    Parameters
    ----------
    directories
        Directories of identifications of the same recordings, with the same pieces held out.

    Returns
    -------
    Table
        A row for each identification: directory, title and number of unknowns. ``fit`` and ``held_out`` are
        the root mean squares over all channels of fitted and of held-out pieces, each channel in units of its
        noise in the first identification. ``fit_NAME`` and ``held_out_NAME`` are those of each channel [SI].
        ``orbits_fit`` and ``orbits_held_out`` are the root mean squares of the amplitudes' relative errors of measured
        orbits. Rows are sorted by held-out pieces, else held-out orbits, else by the fit; without one of these its
        values are NaN.

    Raises
    ------
    SpecError
        If recordings, channels or held-out pieces differ, since residuals cannot be compared then.
    RefusedError
        If one is not finished.
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
