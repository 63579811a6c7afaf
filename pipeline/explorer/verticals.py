"""What the vertical axis of a diagram can show: states at the sections, quantities there, kept extremes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipeline.explorer.explored import ExplorerError
from pipeline.explorer.plain import plain
from pipeline.spec.problems import unknown_name

if TYPE_CHECKING:
    import xarray as xr

    from pipeline.explorer.explored import ExploredRun

_WORDS = {"min": "least", "max": "largest", "mean": "mean"}


@dataclass(frozen=True)
class Vertical:
    """What a diagram draws upwards.

    Attributes
    ----------
    name, label, unit : str
    angle : bool
        Whether full turns do not matter.
    variable : str
        Of the cube.
    values : callable
        ``values(part)``: of a part of the cube, on the dims of its cells and ``period_index``.
    """

    name: str
    label: str
    unit: str
    angle: bool
    variable: str
    values: Callable[[xr.Dataset], xr.DataArray]

    def describe(self) -> dict[str, Any]:
        """As the page has it."""
        return {"name": self.name, "label": self.label, "unit": self.unit, "angle": self.angle}


def verticals(run: ExploredRun) -> list[Vertical]:
    """Return what a run's diagram can show, first the model's first state that differs between sections."""
    return run.remembered("verticals", lambda: _verticals(run))


def _verticals(run: ExploredRun) -> list[Vertical]:
    model = run.model
    ordered = sorted(model.states, key=lambda s: s.name not in model.section_states)
    found = [
        Vertical(s.name, plain(s.symbol, s.name), s.unit, s.on_circle, "section", _state(s.name))
        for s in ordered
    ]
    cube = run.cube()
    if "extremes" in cube:
        for name in map(str, cube["quantity"].values):
            one = model.state(name) if name in model.state_names else model.quantity(name)
            label = plain(one.symbol, one.name)
            found += [
                Vertical(
                    f"{name}.{kind}", f"{word} {label}", one.unit, False, "extremes", _extreme(name, kind)
                )
                for kind, word in _WORDS.items()
            ]
    return found


def vertical(run: ExploredRun, name: str) -> Vertical:
    """One of them by name; raises `ExplorerError` with the nearest names if there is none."""
    known = {v.name: v for v in verticals(run)}
    if name not in known:
        raise ExplorerError(unknown_name("vertical axis", name, list(known)))
    return known[name]


def _state(name: str) -> Callable[[xr.Dataset], xr.DataArray]:
    return lambda part: part["section"].sel(state=name, drop=True)


def _extreme(quantity: str, kind: str) -> Callable[[xr.Dataset], xr.DataArray]:
    return lambda part: part["extremes"].sel(quantity=quantity, extreme=kind, drop=True)
