"""Report a finished identification: ``result.json``, a preset of the values, the residuals and printed lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.preset_writing import write_preset
from pipeline.layout.vocabulary import model_attribute
from pipeline.layout.writing import json_value
from pipeline.rig.identify.directory import Source
from pipeline.rig.identify.identifiability import Direction, DriveFrequency, Profile
from pipeline.rig.identify.judgement import Judgement
from pipeline.rig.identify.local import Fit
from pipeline.rig.identify.measured_orbits import orbit_lines, orbits_result
from pipeline.rig.identify.problem import PHASE, ZERO, Problem
from pipeline.rig.identify.specification import IdentificationSpec
from pipeline.rig.identify.statistics import Covariance
from pipeline.store.provenance import versions


@dataclass(frozen=True)
class Finding:
    """Results of an identification before they are written to files."""

    problem: Problem
    starts: Mapping[int, Fit]  # outcome of each start by its number
    best: Fit
    covariance: Covariance
    directions: Sequence[Direction]
    # judgements of the fitted pieces, and of the held-out ones if there are any
    fitted: Judgement
    held_out: Judgement | None
    n_effective: Mapping[str, float]  # number of independent residuals by channel
    # for each unknown, the bound at which its estimate lies: ``lower``, ``upper`` or an empty text
    at_bound: Sequence[str]
    orbits: Sequence[xr.Dataset] = ()  # judged orbits and bifurcations, one dataset per table
    profiles: Mapping[str, Profile] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    frequencies: Sequence[DriveFrequency] = ()  # estimates of the stated frequencies of known drives

    @property
    def values(self) -> dict[str, float]:
        """Values of all model parameters in the best fit, by name [SI]."""
        return self.problem.values(self.best.theta)

    @property
    def zeros(self) -> dict[str, float]:
        """Fitted zero offsets of the sensors, by name of the unknown."""
        return beside_of(self.problem, self.best, ZERO)

    @property
    def n_same(self) -> int:
        """Number of first guesses from which the fit converged to the best optimum found."""
        return sum(self.is_same(fit) for fit in self.starts.values())

    def is_same(self, fit: Fit) -> bool:
        """Return whether a fit converged to the best optimum, up to a relative difference of 1e-3 in the cost."""
        same = 1e-3  # relative excess of the cost up to which a start has reached the best optimum
        return fit.converged and fit.cost <= (1 + same) * self.best.cost


def beside_of(problem: Problem, fit: Fit, *words: str) -> dict[str, float]:
    """Return the fitted unknowns beside the model's parameters: zeros and phases, or those of the given words."""
    prefixes = tuple(f"{word}." for word in words or (ZERO, PHASE))
    named = zip(problem.names, fit.theta, strict=True)
    return {name: float(value) for name, value in named if name.startswith(prefixes)}


def result_of(
    spec: IdentificationSpec, found: Finding, sources: Sequence[Source], digest: str, findings: Sequence[Sequence[str]]
) -> dict[str, Any]:
    """Return the content of ``result.json`` as plain data. It does not depend on time or speed."""
    names = found.problem.names
    return {
        "title": spec.title,
        "digest": digest,
        "model": spec.model.reference,
        "converged": True,
        "names": list(names),
        "channels": list(found.problem.channels),
        "estimates": {name: _estimate(found, i) for i, name in enumerate(names)},
        "values": found.values,
        "tied": {name: [factor, other] for name, (factor, other) in spec.tied.items()},
        "zeros": found.zeros,
        "cost": found.best.cost,
        "noise": dict(zip(found.problem.channels, found.problem.noise.tolist(), strict=True)),
        "units": {c: spec.model.state(c).unit for c in found.problem.channels},
        **found.fitted.as_dict(),
        "held_out": None if found.held_out is None else found.held_out.as_dict(),
        "orbits": orbits_result(found.orbits),
        "drive_frequencies": [f.as_dict() for f in found.frequencies],
        **_sureness(found),
        "starts": [
            {
                "number": k,
                "cost": json_value(fit.cost),
                "converged": fit.converged,
                "best": found.is_same(fit),
                "message": fit.message,
                "n_evaluations": fit.n_evaluations,
            }
            for k, fit in sorted(found.starts.items())
        ],
        "warnings": list(found.warnings) + _errors(sources, findings),
        "recordings": [
            {"file": s.file, "sha256": s.sha256, "findings": list(said)}
            for s, said in zip(sources, findings, strict=True)
        ],
        "versions": versions(),
    }


def _sureness(found: Finding) -> dict[str, Any]:
    """Return covariance, correlations, singular values and profiles of an identification as plain data."""
    names = found.problem.names
    return {
        "covariance": {
            "estimator": found.covariance.estimator,
            "why": found.covariance.why,
            "critical": found.covariance.critical,
            "degrees_of_freedom": found.covariance.degrees,
            "inflation": found.covariance.inflation,
            "n_samples": int(sum(np.isfinite(r).sum() for r in found.best.residuals)),
            "n_effective": dict(found.n_effective),
            "matrix": json_value(found.covariance.matrix),
        },
        "correlations": {
            name: dict(zip(names, row, strict=True))
            for name, row in zip(names, json_value(found.covariance.correlations), strict=True)
        },
        "singular_values": [
            {
                "value": d.singular_value,
                "error": json_value(d.error),
                "vector": dict(zip(names, d.vector.tolist(), strict=True)),
            }
            for d in found.directions
        ],
        "profiles": {
            name: {"values": json_value(p.values), "growth": json_value(p.growth), "interval": json_value(p.interval)}
            for name, p in found.profiles.items()
        },
    }


def _errors(sources: Sequence[Source], findings: Sequence[Sequence[str]]) -> list[str]:
    return [
        f"{s.file} has an {line}"
        for s, said in zip(sources, findings, strict=True)
        for line in said
        if line.startswith("error")
    ]


def _estimate(found: Finding, i: int) -> dict[str, Any]:
    free, value = found.problem.free[i], float(found.best.theta[i])
    error = float(found.covariance.errors[i])
    low, high = interval_of(found, i)
    entry: dict[str, Any] = {
        "value": value,
        "unit": free.unit,
        "meaning": free.meaning,
        "error": json_value(error),
        "interval": [json_value(low), json_value(high)],
        "start": free.start,
        "bounds": [json_value(free.lower), json_value(free.upper)],
        "at_bound": found.at_bound[i],
    }
    if free.has_prior:
        entry["prior"] = {"mean": free.prior_mean, "sd": free.prior_sd}
    if free.name in found.profiles:
        entry["profile_interval"] = json_value(found.profiles[free.name].interval)
    return entry


def interval_of(found: Finding, i: int) -> tuple[float, float]:
    """Return the 95 % interval of unknown `i` from its standard error, cut off at its bounds."""
    free, value = found.problem.free[i], float(found.best.theta[i])
    half = found.covariance.critical * float(found.covariance.errors[i])
    return max(value - half, free.lower), min(value + half, free.upper)


def write_values(path: Path, spec: IdentificationSpec, found: Finding, sources: Sequence[Source]) -> None:
    """Write the identified, tied and fixed parameters as a preset file, each with its origin."""
    files = ", ".join(f"{s.file} (sha256 {s.sha256[:12]})" for s in sources) or "measured orbits"
    phrases = {}
    for i, free in enumerate(found.problem.free):
        low, high = interval_of(found, i)
        phrases[free.name] = f"identified from {files}; 95 % interval {low:.6g} to {high:.6g}"
    for name, (factor, other) in spec.tied.items():
        phrases[name] = f"tied: {factor:g} times {other}" if factor != 1 else f"tied to {other}"
    base = spec.model.preset(spec.preset_found)
    for name in spec.values:
        if name not in phrases:
            own = "stated in the specification of the identification" if name in spec.parameters else ""
            phrases[name] = own or base.provenance.get(name, "")
    title = spec.title or f"identified parameters of {spec.model.name}"
    write_preset(path, spec.model, found.values, phrases, title)


def residuals_of(spec: IdentificationSpec, found: Finding) -> xr.Dataset:
    """Return measured values and residuals of all pieces as a dataset, one piece after the other."""
    parts = [(found.fitted, 0)] + ([(found.held_out, 1)] if found.held_out is not None else [])
    columns: dict[str, list[np.ndarray]] = {}

    def add(name: str, values: np.ndarray) -> None:
        columns.setdefault(name, []).append(values)

    for judgement, is_held in parts:
        for piece, residuals in zip(judgement.pieces, judgement.residuals, strict=True):
            n = len(piece.time)
            for name, number in (("recording", piece.recording), ("piece", piece.number), ("held_out", is_held)):
                add(name, np.full(n, number, np.int32))
            add("time", piece.time)
            for c, channel in enumerate(judgement.channels):
                add(f"{channel}_measured", piece.measured[:, c])
                add(f"{channel}_residual", residuals[:, c])
    names = ["recording", "piece", "held_out", "time"]
    for name in () if columns else names:
        add(name, np.zeros(0))
    ds = xr.Dataset({name: ("sample", np.concatenate(values)) for name, values in columns.items()})
    for channel in found.problem.channels:
        unit = spec.model.state(channel).unit
        ds[f"{channel}_measured"].attrs = {"units": unit, "long_name": f"{channel}, measured"}
        ds[f"{channel}_residual"].attrs = {"units": unit, "long_name": f"{channel}, measured less computed"}
    ds["time"].attrs = {"units": "s", "long_name": "time since the piece's start"}
    ds["held_out"].attrs = {"long_name": "1 in pieces that were not fitted"}
    attrs = {"model": model_attribute(spec.model), "title": spec.title, "channels": " ".join(found.problem.channels)}
    return ds.set_coords(names).assign_attrs(attrs)


def lines_of(result: Mapping[str, Any]) -> list[str]:
    """Return the content of ``result.json`` as lines to print."""
    estimates = result["estimates"]
    width = max(map(len, estimates))
    lines = []
    for name in result["names"]:
        e = estimates[name]
        low, high = (("-" if v is None else f"{v:.6g}") for v in e["interval"])
        bound = f", at its {e['at_bound']} bound" if e["at_bound"] else ""
        unit = "" if e["unit"] in ("", "1") else f" {e['unit']}"
        lines.append(f"{name:{width}} = {e['value']:.6g}{unit}   95 %: {low} to {high}{bound}")
    lines += judgement_lines(result, result["units"])
    if result["held_out"] is not None:
        lines += [f"held out: {line}" for line in judgement_lines(result["held_out"], result["units"])]
    lines += orbit_lines(result["orbits"])
    lines += [
        f"drive of recording {f['recording']}: {f['frequency_hz']:.8g} Hz stated, {f['estimate_hz']:.8g} Hz estimated "
        f"(standard error {f['error_hz']:.2g} Hz): {f['verdict']}"
        for f in result["drive_frequencies"]
    ]
    same = sum(s["best"] for s in result["starts"])
    lines.append(f"{same} of {len(result['starts'])} starts reached this optimum")
    lines.append(f"intervals: {result['covariance']['why']}")
    return lines + [f"warning: {w}" for w in result["warnings"]]


def judgement_lines(judged: Mapping[str, Any], units: Mapping[str, str]) -> list[str]:
    """Return a printed line for each channel: rms of its residuals, and correlation with computed values."""
    lines = []
    for name, rms in judged["rms"].items():
        shown = "-" if rms is None else f"{rms:.4g} {units[name]}"
        correlation = judged["correlation"][name]
        lines.append(
            f"{name}: root mean square {shown}, correlation " + ("-" if correlation is None else f"{correlation:.6f}")
        )
    return lines
