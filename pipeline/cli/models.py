"""Define ``magpend models`` and ``magpend presets``, which list models and their parameter values."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.common import Json, tell
from pipeline.cli.options import completing

if TYPE_CHECKING:
    from magpend_core.models.model import Model
    from magpend_core.models.presets import Preset


DEFAULT = "pendulum"
"""Name of the default model, equal to `magpend_core.models.DEFAULT`, which the help does not import."""


def names() -> Iterable[str]:
    """Return the names of the models that ship with magpend."""
    from magpend_core.models import model_names

    return model_names()


def models(
    name: Annotated[
        str | None,
        typer.Argument(
            help="Show only this model, in full: a name, or a model's file, FILE.toml.",
            autocompletion=completing(names),
        ),
    ] = None,
    json: Json = None,
) -> None:
    """List the models: their states, parameters, quantities and presets."""
    from magpend_core.models import load_model, model_names
    from pipeline.products.product import Table
    from pipeline.specification.models import find_model

    chosen = [find_model(name, at="model")] if name else [load_model(n) for n in model_names()]
    rows = [described(model) for model in chosen]
    if name:
        lines = all_of(chosen[0])
    else:
        width = max(len(model.name) for model in chosen)
        lines = [f"{m.name:{width}}  {m.title}; states {', '.join(m.state_names)}" for m in chosen]
        lines.append('details of one: magpend models NAME; to use it in a specification: model = "NAME"')
    tell(Table(rows, lines), None, json)


def described(model: Model) -> dict[str, Any]:
    """Return all properties of a model as a dictionary that can be written as JSON."""
    about = [
        {"name": s.name, "unit": s.unit, "meaning": s.meaning, "on_circle": s.on_circle, "scale": s.scale}
        for s in model.states
    ]
    return {
        "name": model.name,
        "title": model.title,
        "states": about,
        "parameters": [{"name": p.name, "unit": p.unit, "meaning": p.meaning} for p in model.parameters],
        "quantities": [{"name": q.name, "unit": q.unit, "meaning": q.meaning} for q in model.quantities],
        "motions": list(model.classifier.words) if model.classifier else [],
        "presets": [{"name": p.name, "values": dict(model.load(p.name).as_dict())} for p in model.presets],
    }


def all_of(model: Model) -> list[str]:
    """Return text lines that list the states, parameters, quantities, motions and presets of a model."""
    from pipeline.products.product import padded

    seen = model.clock.meaning + (f"; sections are taken at {model.section}" if model.clock.has_drive else "")
    lines = [f"{model.name}: {model.title}", seen, "", "states"]
    lines += padded([(s.name, s.unit, s.meaning) for s in model.states])
    lines += ["", "parameters"]
    lines += padded([(p.name, p.unit, p.meaning) for p in model.parameters])
    if model.quantities:
        lines += ["", "quantities", *padded([(q.name, q.unit, q.meaning) for q in model.quantities])]
    if model.classifier:
        lines += ["", f"motions: {', '.join(model.classifier.words)} ({model.classifier.meaning})"]
    for preset in model.preset_names:
        lines += ["", *_preset(model, preset)]
    return lines


def _preset(model: Model, name: str | Preset) -> list[str]:
    from pipeline.products.product import padded

    found = model.preset(name)
    known, origin = model.load(found), found.provenance
    rows = [(p.name, f"{known[p.name]:g}", p.unit, p.meaning, origin.get(p.name, "")) for p in model.parameters]
    title = f": {found.title}" if found.title else ""
    return [f"preset {found.name}{title}", *padded(rows)]


def presets(
    name: Annotated[
        str | None, typer.Argument(help="Show only this preset: a name, or a preset's file, FILE.toml.")
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            help="Model, by name or file; a preset's file names its own model.", autocompletion=completing(names)
        ),
    ] = DEFAULT,
) -> None:
    """List the presets of a model: values, units, and the origin of each value."""
    from magpend_core.models.presets import find_preset
    from pipeline.specification.models import find_model

    found = find_preset(name) if name else None
    chosen = find_model(model if model != DEFAULT else getattr(found, "model", "") or model, at="--model")
    for preset in [found] if found else chosen.preset_names:
        console.result(*_preset(chosen, preset))
