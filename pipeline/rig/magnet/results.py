"""Write the results of a torque fit: ``fit.json``, presets with the origin of each value, a printed summary."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from magpend_core.models import load_model
from magpend_core.models.pendulum import magnet_torque as laws
from magpend_core.models.preset_writing import write_preset
from magpend_core.models.presets import Preset, find_preset
from pipeline.layout.writing import json_value, write_atomically
from pipeline.products.product import padded
from pipeline.rig.magnet.fitting import DipoleFit, JointFit, Outcome, Quality
from pipeline.rig.magnet.measurement import Measurement
from pipeline.store.provenance import provenance, versions

REPORT, PRESET, DIPOLE_PRESET = "fit.json", "preset.toml", "preset-dipoles.toml"


def report_of(outcome: Outcome) -> dict[str, Any]:
    """Return all numbers of a torque fit as plain data, in SI units, or in degrees where the key says so."""
    m = outcome.measured
    curves = [
        {
            laws.LOCKED + "_deg": round(math.degrees(fit.curve.locked), 9),
            "side": laws.SIDES[fit.curve.side],
            "n": len(fit.curve.rows),
            "values": fit.values,
            "standard_errors": fit.errors,
            "r2": fit.quality.r2,
            "rms_Nm": fit.quality.rms,
        }
        for fit in outcome.curves
    ]
    return {
        "title": m.header.title,
        "synthetic": m.header.synthetic,
        "model": m.header.model,
        "header": m.path.name,
        "file": m.header.file,
        "sha256": m.digest,
        "n_readings": len(m.torque),
        "correction": m.header.correction.model_dump(mode="json"),
        "parameters": {name: m.parameters[name] for name in sorted(m.header.parameters)},
        "curves": curves,
        "over_locked_angle": {
            "values": outcome.laws.values,
            "standard_errors": outcome.laws.errors,
            "r2": outcome.laws.r2,
        },
        "joint": _joint(outcome.joint),
        "joint_with_nothing_held": _joint(outcome.unheld) if outcome.unheld else None,
        "point_dipoles": {"at_the_magnet": _dipoles(outcome.dipoles), "best_place": _dipoles(outcome.placed_dipoles)},
        "versions": versions(),
        **provenance(),
    }


def _joint(fit: JointFit) -> dict[str, Any]:
    line = laws.transition(fit.values)
    return {
        "values": {name: fit.values[name] for name in laws.FITTED},
        "held": [name for name in laws.FITTED if name not in fit.free],
        "standard_errors": fit.errors,
        "standard_errors_by_curve": json_value(fit.errors_by_curve),
        "correlation": {"names": list(fit.free), "matrix": fit.correlation.tolist()},
        "transition": {"slope": line.slope, "offset_rad": line.offset},
        "r2": fit.quality.r2,
        "rms_Nm": fit.quality.rms,
        "neighbours_correlate": fit.neighbours,
        "undetermined": fit.undetermined,
    }


def _dipoles(fit: DipoleFit) -> dict[str, Any]:
    return {"values": fit.values, "r2": fit.quality.r2, "rms_Nm": fit.quality.rms}


def write_results(outcome: Outcome, folder: Path) -> list[Path]:
    """Write ``fit.json`` and the presets into an existing folder; return the paths of all files."""
    report = folder / REPORT
    text = json.dumps(report_of(outcome), indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(report, text + "\n")
    return [report, *write_presets(outcome, folder)]


def write_presets(outcome: Outcome, folder: Path) -> list[Path]:
    """Write a preset of the fitted torque, and a preset of point dipoles for comparison."""
    m, joint = outcome.measured, outcome.joint
    kind = "SYNTHETIC readings, " if m.header.synthetic else ""
    origin = f"{len(outcome.curves)} torque curves ({kind}{m.header.file}, sha256 {m.digest[:12]})"
    stated = dict(m.header.parameters)
    known = {name: m.header.provenance[name] for name in stated}
    fitted = {name: joint.values[name] for name in joint.free}
    sources = {name: f"joint fit of {origin}, {_error(joint, name, m)}" for name in fitted}
    first = write_preset(
        folder / PRESET, m.header.model, stated | fitted, known | sources, m.label, base=_base(m, m.header.model)
    )
    poles = {name: value for name, value in outcome.dipoles.values.items() if name != "h"}
    phrase = f"point dipoles fitted to {origin}, R2 = {outcome.dipoles.quality.r2:.3f}"
    names = load_model(laws.DIPOLES).parameter_names
    shared = {name: value for name, value in stated.items() if name in names}
    second = write_preset(
        folder / DIPOLE_PRESET,
        laws.DIPOLES,
        shared | poles,
        known | dict.fromkeys(poles, phrase),
        f"point dipoles for {m.label}",
        base=_base(m, laws.DIPOLES),
    )
    return [first, second]


def _base(measured: Measurement, model: str) -> str | Preset:
    """Return the preset of the parameters that are not fitted; of a file, only the model's parameters."""
    name = measured.header.preset
    if name is None:
        return load_model(model).presets[0].name
    found = find_preset(name, measured.path.parent)
    if isinstance(found, str):
        return found
    known = load_model(model).parameter_names
    return replace(found, values={n: value for n, value in found.values.items() if n in known})


def _error(fit: JointFit, name: str, measured: Measurement) -> str:
    """Format a parameter's standard error, the larger of that by residuals and that by a jackknife over curves."""
    error, unit = np.fmax(fit.errors[name], fit.errors_by_curve[name]), _unit(name, measured)
    return f"standard error {error:.2g} {unit}".rstrip()


def _unit(name: str, measured: Measurement) -> str:
    unit = measured.parameters.model.parameter(name).unit
    return "" if unit == "1" else unit


# ---- for people ----------------------------------------------------------------------------------


def summary_of(outcome: Outcome) -> list[str]:
    """Return the printed summary of a torque fit, line by line."""
    m, joint = outcome.measured, outcome.joint
    r2 = [fit.quality.r2 for fit in outcome.curves]
    line = laws.transition(joint.values)
    lines = [
        m.label,
        f"{len(m.torque)} readings in {len(r2)} curves; each fitted alone: R2 {min(r2):.4f} to {max(r2):.4f}",
        *_table(joint, m),
        f"transition: {laws.ANGLE} = {line.slope:.4f} {laws.LOCKED} {line.offset:+.5f} rad",
        f"joint fit: {_quality(joint.quality)}",
    ]
    if outcome.unheld:
        lines.append(f"joint fit, nothing held: {_quality(outcome.unheld.quality)}")
    for what, fit in (("at the magnet", outcome.dipoles), ("where it fits best", outcome.placed_dipoles)):
        h = fit.values["h"]
        lines.append(f"point dipoles, the fixed one {what} (h = {h:.4f} m): {_quality(fit.quality)}")
    return lines


def _quality(quality: Quality) -> str:
    return f"R2 = {quality.r2:.4f}, rms {1e3 * quality.rms:.1f} mN m"


def _table(joint: JointFit, m: Measurement) -> list[str]:
    rows = [("parameter", "value", "standard error", "by curve", "")]
    for name in laws.FITTED:
        errors = ("held", "")
        if name in joint.free:
            errors = (f"{joint.errors[name]:.2g}", f"{joint.errors_by_curve[name]:.2g}")
        rows.append((name, f"{joint.values[name]:.6g}", *errors, _unit(name, m)))
    return padded(rows)


def warnings_of(outcome: Outcome) -> list[str]:
    """Return warnings: columns accepted by similar names, undetermined parameters, correlated residuals."""
    alike = 0.3  # correlation of neighbouring residuals above which the law is wrong; white noise stays below
    joint, found = outcome.joint, list(outcome.measured.warnings)
    for name, partner in joint.undetermined.items():
        found.append(
            f"{name} is hardly determined by these readings (standard error {joint.errors[name]:.2g} of "
            f"{joint.values[name]:.3g}): it correlates with {partner}; hold one of them by its name in hold."
        )
    if joint.neighbours > alike:
        found.append(
            f"residuals of neighbouring readings correlate ({joint.neighbours:.2f}): the law does not fit, and"
            " they are more than noise; use the standard errors by curve."
        )
    return found
