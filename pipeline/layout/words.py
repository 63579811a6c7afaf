"""Words for what sections are taken at: the same in cubes, tables and figures."""

from __future__ import annotations

from magpend_core.models.model import Model


def period_of(model: Model | None) -> str:
    """What passes between two sections of a model: a drive period, a return, a strobe period."""
    if model is None:
        return "drive period"
    if model.crossing is not None:
        return "return"
    return "strobe period" if model.autonomous else "drive period"


def periods_of(model: Model | None) -> str:
    """The same, several of them."""
    return f"{period_of(model)}s"


def section_name(model: Model | None) -> str:
    """What the section is called: stroboscopic, or Poincare's."""
    return "stroboscopic section" if model is None or model.crossing is None else "Poincar\u00e9 section"


def once(model: Model | None) -> str:
    """What a dot of the section stands for."""
    if model is None or model.crossing is None:
        return f"once per {period_of(model)}"
    return f"crossing of {model.crossing.sentence}"
