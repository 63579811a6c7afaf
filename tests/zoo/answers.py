"""Known answers of the zoo: one file NAME.answer.toml beside each specification NAME.toml.

Keys of a file: `source` (where the answer comes from), `quick` (whether the suite has the system), sets
as tables ``[[set]]``, `also` (stabilities besides those of the sets that rows may have), `share_error`, and
`sample` (arguments of `independent.shares`), `sizes` and `time` (units of the states and of time [s] in which
`independent` computes).

Keys of a set:

=================== =====================================================================================
`where`             parameter point; all points if it is absent
`kind`              as the analysis names it, or "any"
`stability`         "attracts" (the default), "unstable", "neutral", "transient", or "semistable": attracts
                    from one side alone, and may be listed as anything but an attractor
`or_neutral`        of a degenerate attractor: "neutral" is as right as "attracts"
`many`              any number of rows may show the set; for sets that are no attractors
`at`, `at_error`    a point of it, and how far the nearest point listed may be from it
`period`            in drive periods or returns
`seconds`           period of a limit cycle [s], with `seconds_error` if it is above 1e-5 of it
`multiplier`        largest modulus of its Floquet multipliers
`eigenvalue`        real part of its leading eigenvalue [1/s]; modulus of the imaginary part unless ambiguous
`lyapunov`          largest exponent [1/s], with `lyapunov_error`
`share`             of the cells that end on attractors, with `share_error`
`lifetime`          bounds of a transient's mean lifetime [drive periods or returns]
=================== =====================================================================================
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

SYSTEMS = Path(__file__).parent / "systems"

ATTRACTS = "attracts"


@dataclass(frozen=True)
class Known:
    """A set that a system has; see the module's table."""

    kind: str
    where: Mapping[str, float] = field(default_factory=dict)
    stability: str = ATTRACTS
    or_neutral: bool = False
    many: bool = False
    at: tuple[float, ...] = ()
    at_error: float = 0.0
    period: int = 0
    seconds: float = 0.0
    seconds_error: float = 0.0
    multiplier: float | None = None
    eigenvalue: tuple[float, ...] | None = None
    lyapunov: float | None = None
    lyapunov_error: float = 0.0
    share: float | None = None
    share_error: float = 0.0
    lifetime: tuple[float, float] | None = None

    @property
    def attracts(self) -> bool:
        """Whether it is an attractor."""
        return self.stability == ATTRACTS

    @property
    def words(self) -> str:
        """Describe it in a few words."""
        parts = [self.kind.replace("_", " ")]
        parts += [f"period {self.period}"] if self.period else []
        parts += [f"|m| {self.multiplier:.4g}"] if self.multiplier is not None else []
        parts += [f"eigenvalue {self.eigenvalue[0]:.4g}"] if self.eigenvalue else []
        parts += [f"exponent {self.lyapunov:.3g}"] if self.lyapunov is not None else []
        return " ".join([*parts, *([] if self.attracts else [f"({self.stability})"])])


@dataclass(frozen=True)
class Answer:
    """Everything known of a system."""

    name: str
    source: str
    sets: tuple[Known, ...]
    also: tuple[str, ...] = ()
    quick: bool = False
    share_error: float = 0.03

    def at(self, point: Mapping[str, float]) -> list[Known]:
        """Sets that exist at a parameter point."""
        return [s for s in self.sets if all(_same(v, point[k]) for k, v in s.where.items())]


def _same(a: float, b: float) -> bool:
    return abs(a - b) <= 1e-9 * max(abs(a), abs(b), 1e-9)


def names() -> list[str]:
    """Names of the systems that have an answer."""
    return sorted(p.name.removesuffix(".answer.toml") for p in SYSTEMS.glob("*.answer.toml"))


def load(name: str) -> Answer:
    """Read the answer of a system."""
    data: dict[str, Any] = tomllib.loads((SYSTEMS / f"{name}.answer.toml").read_text("utf-8"))
    return from_data(name, data)


def from_data(name: str, data: Mapping[str, Any]) -> Answer:
    """Make an answer from plain data; keys that `independent` alone reads are left out."""
    own = {f.name for f in fields(Known)}
    sets = tuple(
        Known(**{k: tuple(v) if isinstance(v, list) else v for k, v in one.items() if k in own})
        for one in data.get("set", [])
    )
    return Answer(
        name,
        data["source"],
        sets,
        tuple(data.get("also", ())),
        bool(data.get("quick", False)),
        float(data.get("share_error", 0.03)),
    )
