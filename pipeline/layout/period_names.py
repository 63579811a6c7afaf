"""Return the words for a model's periods and sections, the same in cubes, tables and figures."""

from __future__ import annotations

from magpend_core.models.model import Model


def period_of(model: Model | None) -> str:
    """Return the word for the time between two section points: drive period, return or strobe period."""
    if model is None:
        return "drive period"
    if model.crossing is not None:
        return "return"
    return "strobe period" if model.autonomous else "drive period"


def periods_of(model: Model | None) -> str:
    """Return the plural of the word that `period_of` returns."""
    return f"{period_of(model)}s"


def section_name(model: Model | None) -> str:
    """Return the name of a model's section: stroboscopic or Poincar\u00e9."""
    return "stroboscopic section" if model is None or model.crossing is None else "Poincar\u00e9 section"


def once(model: Model | None) -> str:
    """Return the phrase for the instants of section points, such as "once per drive period"."""
    if model is None or model.crossing is None:
        return f"once per {period_of(model)}"
    return f"crossing of {model.crossing.sentence}"
