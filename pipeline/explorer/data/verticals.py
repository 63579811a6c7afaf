"""List what a diagram can show on its vertical axis: states, quantities of the model, stored extremes."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.explorer import RequestError
from pipeline.layout.vocabulary import FREQUENCY_DIM, is_start_dim, parameter_name
from pipeline.specification.problems import unknown_name

if TYPE_CHECKING:
    import xarray as xr

    from pipeline.explorer.data.explored import ExploredRun


_SUBSCRIPTS = str.maketrans("0123456789+-aehijklmnoprstuvx", "₀₁₂₃₄₅₆₇₈₉₊₋ₐₑₕᵢⱼₖₗₘₙₒₚᵣₛₜᵤᵥₓ")

_ACCENTS = {"dot": "\u0307", "ddot": "\u0308", "hat": "\u0302", "bar": "\u0304", "tilde": "\u0303"}

_ACCENT = re.compile(r"\\(dot|ddot|hat|bar|tilde)\s*(?:\{([^{}]*)\}|(\\[A-Za-z]+|.))")
_FONT = re.compile(r"\\(?:mathrm|mathit|mathbf|text|operatorname)\s*\{([^{}]*)\}")
_SUBSCRIPT = re.compile(r"_(?:\{([^{}]*)\}|(.))")


def _letter(name: str) -> str:
    known = name.lower().removeprefix("var")
    case = "SMALL" if name[0].islower() else "CAPITAL"
    # Unicode spells lambda differently
    spelled = {"lambda": "lamda"}.get(known, known).upper()
    try:
        return unicodedata.lookup(f"GREEK {case} LETTER {spelled}")
    except KeyError:
        return name


def plain(symbol: str, name: str) -> str:
    r"""Convert a LaTeX symbol (or a name without one) to plain text with Greek letters, accents and subscripts.

    Examples
    --------
    >>> plain(r"\dot{\theta}_1", "rate")
    'θ̇₁'
    """
    if not symbol:
        return name.replace("_", " ")
    text = _FONT.sub(lambda found: f"{{{found[1]}}}", symbol)
    text = _ACCENT.sub(lambda found: f"{found[2] or found[3]}{{{_ACCENTS[found[1]]}}}", text)
    text = re.sub(r"\\([A-Za-z]+)", lambda found: _letter(found[1]), text)
    text = re.sub(r"\{([\u0300-\u036f])\}", r"\1", text)
    return _SUBSCRIPT.sub(_lowered, text).replace("{", "").replace("}", "").strip()


def _lowered(found: re.Match[str]) -> str:
    """Convert a subscript to Unicode's subscript characters, or to ``_TEXT`` if one character has no such form."""
    text = (found[1] if found[1] is not None else found[2]).replace(" ", "")
    small = text.translate(_SUBSCRIPTS)
    return small if all(a != b for a, b in zip(text, small, strict=True)) else f"_{text}"


_WORDS = {"min": "least", "max": "largest", "mean": "mean"}


@dataclass(frozen=True)
class Vertical:
    """A number that a diagram can show on its vertical axis."""

    name: str
    label: str
    unit: str
    angle: bool  # whether full turns do not matter
    variable: str  # name of the cube's variable
    # ``values(part)`` returns the values in a part of the cube, on the dims of its cells and ``period_index``
    values: Callable[[xr.Dataset], xr.DataArray]

    def describe(self) -> dict[str, Any]:
        """Return the vertical axis as a dictionary for the page."""
        return {"name": self.name, "label": self.label, "unit": self.unit, "angle": self.angle}


def verticals(run: ExploredRun) -> list[Vertical]:
    """Return everything that the diagram of a run can show on its vertical axis, the default first."""
    return run.remembered("verticals", lambda: _verticals(run))


def _verticals(run: ExploredRun) -> list[Vertical]:
    model = run.model
    ordered = sorted(model.states, key=lambda s: s.name not in model.section_states)
    found = [Vertical(s.name, plain(s.symbol, s.name), s.unit, s.on_circle, "section", _state(s.name)) for s in ordered]
    if run.spec.motion.has_quantities:
        found += [
            Vertical(q.name, plain(q.symbol, q.name), q.unit, False, "section", _quantity(run, q.name))
            for q in model.quantities
        ]
    cube = run.cube()
    if "extremes" in cube:
        for name in map(str, cube["quantity"].values):
            one = model.state(name) if name in model.state_names else model.quantity(name)
            label = plain(one.symbol, one.name)
            found += [
                Vertical(f"{name}.{kind}", f"{word} {label}", one.unit, False, "extremes", _extreme(name, kind))
                for kind, word in _WORDS.items()
            ]
    return found


def vertical(run: ExploredRun, name: str) -> Vertical:
    """Return a vertical axis by name; raise RequestError with similar names if there is none."""
    known = {v.name: v for v in verticals(run)}
    if name not in known:
        raise RequestError(unknown_name("vertical axis", name, list(known)))
    return known[name]


def _state(name: str) -> Callable[[xr.Dataset], xr.DataArray]:
    return lambda part: part["section"].sel(state=name, drop=True)


def _quantity(run: ExploredRun, name: str) -> Callable[[xr.Dataset], xr.DataArray]:
    """Return a function that computes a quantity of the model at the stored section points of some cells."""
    model = run.model.flow
    column = [q.name for q in model.quantities].index(name)

    def values(part: xr.Dataset) -> xr.DataArray:
        from magpend_core.pointwise import evaluate_packed

        dims = [str(d) for d in part["status"].dims]
        section = part["section"].transpose(*dims, "period_index", "state")
        outer = [d for d in dims if not is_start_dim(d)]
        rows = section.transpose(*outer, ...)
        found = np.full(rows.shape[:-1], np.nan)
        for index in np.ndindex(*(rows.sizes[d] for d in outer)):
            packed, hertz = _point(run, {d: float(part[d].values[i]) for d, i in zip(outer, index, strict=True)})
            states = rows.values[index].reshape(-1, len(model.states))
            finite = np.isfinite(states).all(axis=1)
            out = np.empty((int(finite.sum()), len(model.quantities)))
            if len(out):
                evaluate_packed(model.system, np.zeros(len(out)), states[finite], packed, hertz, out)
            own = np.full(len(states), np.nan)
            own[finite] = out[:, column]
            found[index] = own.reshape(found[index].shape)
        return rows.isel(state=0, drop=True).copy(data=found)

    return values


def _point(run: ExploredRun, values: Mapping[str, float]) -> tuple[np.ndarray, float]:
    changed = {parameter_name(d): v for d, v in values.items() if d != FREQUENCY_DIM}
    own = run.parameters
    packed = np.array([changed.get(n, own[n]) for n in run.model.flow.parameter_names], np.float64)
    fixed = run.spec.frequency_hz
    return packed, values[FREQUENCY_DIM] if FREQUENCY_DIM in values else float(fixed or 1.0)


def _extreme(quantity: str, kind: str) -> Callable[[xr.Dataset], xr.DataArray]:
    return lambda part: part["extremes"].sel(quantity=quantity, extreme=kind, drop=True)
