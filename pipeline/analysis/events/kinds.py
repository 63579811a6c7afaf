"""List the kinds of events: their names, marks, sentences and detectors.

To add a kind, write its detector and add it to `EVENTS`. This module imports no kernel, so that figures and tables need
no compiler.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.analysis.branches.kinds import (
    BRANCHING,
    DOUBLING,
    FOLD,
    HOMOCLINIC,
    HOPF,
    LABELS,
    MARKERS,
    NAMES,
    PITCHFORK,
    SNIC,
    TORUS,
    TRANSCRITICAL,
)
from pipeline.layout.vocabulary import letter

Row = Mapping[str, Any]
"""Row of the table of events, with its ``doublings``."""

UNDECIDED, RANGE_END, LIVES_ON = "not_decided", "range_end", "lives_on"
CASCADE, LOCKING, BREAKUP, TRANSIENT = "cascade", "locking", "torus_breakup", "transient"
BOUNDARY, INTERIOR, BANDS, TWINS = "boundary_crisis", "interior_crisis", "band_merging", "attractor_merging"
GRAZING, SLIDING = "grazing", "grazing_sliding"

INTERMITTENCY = {kind: f"intermittency_{kind}" for kind in ("i", "ii", "iii")}
"""Names of intermittency by its type."""

_ROOM = "pipeline.analysis.events"


@dataclass(frozen=True)
class EventKind:
    """A kind of event: its name, what users read and see of it, and the function that detects it."""

    name: str  # in results
    text: str  # in figures
    marker: str = ""  # in figures
    sentence: Callable[[Row], str] | str = ""  # what happens to the attractor, in words
    label: str = ""  # abbreviation, as other programs have it
    mark: str = ""  # text at the marker, if not the label
    ends: tuple[str, ...] = ()  # kinds of attractors whose ends the detector looks at
    detector: str = ""  # place of a function of a scene, an end and all named ends, which returns the end, named or not
    two_sided: bool = False  # whether ends of two sets at one value are one event

    def told(self, row: Row) -> str:
        """Say what happens to the attractor of a row."""
        return self.sentence if isinstance(self.sentence, str) else self.sentence(row)


# ---- bifurcations of branches ---------------------------------------------------------------------


def _bifurcation(name: str, meets: Callable[[Row], str], **more: Any) -> EventKind:
    def sentence(row: Row) -> str:
        degree = "" if row["criticality"] == "unknown" else f"{row['criticality']} "
        return ", ".join(filter(None, (f"{degree}{NAMES[name]} ({LABELS[name]})", meets(row))))

    return EventKind(name, NAMES[name], MARKERS[name], sentence, LABELS[name], **more)


def _by_degree(row: Row, onto: str, meets: str, sprung: str) -> str:
    """Choose the words on a supercritical or a subcritical bifurcation of the orbit, or on one that it springs from."""
    if not row["is_own"]:
        return sprung
    return {"supercritical": onto, "subcritical": meets}.get(row["criticality"], "")


def _other(row: Row) -> str:
    return "" if row["other_branch"] < 0 else f" (branch {row['other_branch']})"


def _orbit(row: Row) -> str:
    return "equilibrium" if row["set"] == "equilibrium" else "orbit"


def _fold(row: Row) -> str:
    return f"it meets the unstable {_orbit(row)} of branch {row['branch']}"


def _doubling(row: Row) -> str:
    twice, half = (f"orbit of period {n}{_other(row)}" for n in (2 * row["period"], row["period"] // 2))
    return _by_degree(row, f"onto the {twice}", f"it meets the unstable {twice}", f"it shrinks onto the {half}")


def _hopf(row: Row) -> str:
    cycle = f"limit cycle{_other(row)}"
    onto, meets = f"it sheds a stable {cycle}", f"it meets an unstable {cycle}"
    return _by_degree(row, onto, meets, f"it shrinks onto the equilibrium{_other(row)}")


def _neimark_sacker(row: Row) -> str:
    if row["set"] == "torus":
        return f"the torus shrinks onto the orbit of branch {row['branch']}"
    return _by_degree(row, "onto a torus", "it meets an unstable torus", _branching(row))


def _pitchfork(row: Row) -> str:
    onto, meets = (
        f"{what}{_other(row)}" for what in ("it passes its stability to two arms", "it meets two unstable arms")
    )
    return _by_degree(row, onto, meets, f"it meets the other arm on the {_orbit(row)} between them{_other(row)}")


def _branching(row: Row) -> str:
    return f"it meets the {_orbit(row)}{_other(row)}"


def _transcritical(row: Row) -> str:
    return f"it exchanges stability with the {_orbit(row)}{_other(row)}"


def _homoclinic(row: Row) -> str:
    return f"homoclinic end ({LABELS[HOMOCLINIC]}) at a saddle; its period grows without bound"


def _snic(row: Row) -> str:
    is_at_rest = row["set"] == "equilibrium"
    meets = f"it meets the unstable equilibrium of branch {row['branch']} on a cycle"
    return f"{NAMES[SNIC]} ({LABELS[SNIC]}); {meets if is_at_rest else 'its period grows without bound'}"


# ---- chaotic sets and tori ------------------------------------------------------------------------


def _cascade(row: Row) -> str:
    listed = ", ".join(f"{x:.7g}" for x in row["doublings"])
    return f"end of a cascade of doublings ({LABELS[DOUBLING]} at {listed}; ratio {row['ratio']:.3f})"


def _passage(kind: str, ghost: str) -> EventKind:
    def sentence(row: Row) -> str:
        power = f"-{row['exponent']:.2f} ± {row['exponent_error']:.1g} of the distance"
        where = f"at the {ghost} of the orbit of branch {row['branch']}"
        return f"intermittency of type {kind.upper()} {where}, laminar phases grow with the power {power}"

    text = f"intermittency {kind.upper()}"
    return EventKind(INTERMITTENCY[kind], text, "h", sentence, mark=kind.upper(), ends=_CHAOS, detector=_PASSAGES)


def _locking(row: Row) -> str:
    of = f" as {row['rotation']}" if row["rotation"] else ""
    return f"it locks{of} at the fold ({LABELS[FOLD]}) of the orbit of branch {row['branch']}"


def _crisis(name: str, text: str, marker: str) -> EventKind:
    """Return a crisis, whose sentence tells the orbit that is met, and how lifetimes grow if they tell a power."""

    def sentence(row: Row) -> str:
        who = "the set beyond" if row["lives_beyond"] else "it"
        twin = f" together with {letter(row['twin'])}" if row["twin"] >= 0 else ""
        orbit = f"the unstable orbit of period {row['met_period']}"
        if np.isnan(row["exponent"]):
            return f"{text}, {who} meets {orbit} along the unstable manifold of an equilibrium"
        times = _power(row, "lifetimes" if name == BOUNDARY else "lifetimes of its parts")
        return f"{text}, {who} meets {orbit}{twin}; {times}"

    return EventKind(name, text, marker, sentence, ends=_CHAOS, detector=_CRISES, two_sided=True)


def _transient(row: Row) -> str:
    return f"lost into a transient, {_power(row, 'lifetimes beyond')}; no orbit that it meets is proved"


def _power(row: Row, times: str) -> str:
    return f"{times} grow with the power -{row['exponent']:.2f} ± {row['exponent_error']:.2f} of the distance"


# ---- orbits ---------------------------------------------------------------------------------------


def _touch(name: str, text: str, how: str, mark: str = "") -> EventKind:
    detector = f"{_ROOM}.grazing:name_touch"
    return EventKind(name, text, "<", f"{text}, {how}", mark=mark, ends=("periodic_orbit",), detector=detector)


# ---- the list -------------------------------------------------------------------------------------

_CHAOS, _TORUS = ("chaotic_set",), ("torus",)
_PASSAGES, _CRISES = f"{_ROOM}.passages:name_passage", f"{_ROOM}.crises:name_crisis"

EVENTS = {
    kind.name: kind
    for kind in (
        EventKind(UNDECIDED, "not decided"),
        EventKind(RANGE_END, "end of the range"),
        EventKind(LIVES_ON, "stable, but no cell finds it"),
        _bifurcation(FOLD, _fold),
        _bifurcation(DOUBLING, _doubling),
        _bifurcation(TORUS, _neimark_sacker, ends=_TORUS, detector=f"{_ROOM}.cascades:name_torus"),
        _bifurcation(BRANCHING, _branching),
        _bifurcation(HOPF, _hopf),
        _bifurcation(PITCHFORK, _pitchfork),
        _bifurcation(TRANSCRITICAL, _transcritical),
        EventKind(HOMOCLINIC, NAMES[HOMOCLINIC], MARKERS[HOMOCLINIC], _homoclinic, LABELS[HOMOCLINIC]),
        EventKind(SNIC, NAMES[SNIC], MARKERS[SNIC], _snic, LABELS[SNIC]),
        EventKind(CASCADE, "end of a cascade", "*", _cascade, ends=_CHAOS, detector=f"{_ROOM}.cascades:name_cascade"),
        _passage("i", f"fold ({LABELS[FOLD]})"),
        _passage("ii", f"subcritical Neimark-Sacker point ({LABELS[TORUS]})"),
        _passage("iii", f"subcritical doubling ({LABELS[DOUBLING]})"),
        EventKind(LOCKING, "locking", ">", _locking, ends=_TORUS, detector=_PASSAGES),
        EventKind(
            BREAKUP,
            "break-up of a torus",
            "8",
            "break-up of the torus into a chaotic set",
            ends=_TORUS + _CHAOS,
            detector=f"{_ROOM}.breakups:name_breakup",
            two_sided=True,
        ),
        _crisis(BOUNDARY, "boundary crisis", "X"),
        _crisis(INTERIOR, "interior crisis", "P"),
        _crisis(BANDS, "merging of bands", "d"),
        _crisis(TWINS, "merging of attractors", "H"),
        EventKind(TRANSIENT, "lost into a transient", "x", _transient, ends=_CHAOS, detector=_CRISES),
        _touch(GRAZING, "grazing", "a peak of it begins to touch a surface of impacts or switches"),
        _touch(SLIDING, "grazing-sliding", "its stay on the surface of a switch shrinks to a touch", mark="S"),
    )
}
"""Kinds of events by name.

An attractor *lives on* if it is stable up to the bound of the branches, but no cell found it. The position of a kind is
its code in results, and detectors are tried in this order.
"""


def detectors_of(attractor: str) -> list[str]:
    """Return the detectors of ends of a kind of attractors, in the order in which they are tried."""
    found = (kind.detector for kind in EVENTS.values() if attractor in kind.ends)
    return list(dict.fromkeys(found))
