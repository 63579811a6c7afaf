"""Write a preset of a model's parameters to a TOML file that specifications can name."""

from __future__ import annotations

import json
import uuid
from collections.abc import Mapping
from pathlib import Path

from magpend_core.models import load_model
from magpend_core.models.model import Model
from magpend_core.models.parameters import ParameterError
from magpend_core.models.presets import KEYS, SUFFIX, Preset


def write_preset(
    path: str | Path,
    model: str | Model,
    values: Mapping[str, float],
    sources: Mapping[str, str],
    title: str = "",
    *,
    base: str | Preset | None = None,
) -> Path:
    """Write a preset file that specifications can name by ``preset = "FILE.toml"``.

    Parameters
    ----------
    path
        Ends in ``.toml``; written whole or not at all, over what was there.
    model
        The model, or the name of one that ships.
    values
        By parameter name, in the model's units; numbers that read back the same.
    sources
        Where each of `values` comes from, by its name.
    title
        What it is, in a line.
    base
        Has the values that `values` does not have: one that ships, by name, or one from a file, whose
        values and sources are written with these; None if there are no others.

    Raises
    ------
    ParameterError
        As `Model.load` of what is written; nothing is written then.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise ParameterError([f"{path}: the suffix must be {SUFFIX}."])
    values = {name: float(value) for name, value in values.items()}
    sources = {name: phrase for name, phrase in sources.items() if name in values}
    shipped = base.name if isinstance(base, Preset) else base or ""
    if isinstance(base, Preset) and base.model:  # from a file, which may be gone when this one is read
        values, sources = {**base.values, **values}, {**base.provenance, **sources}
        shipped = base.base
    chosen = load_model(model)
    preset = Preset(path.stem, values, sources, chosen.name, shipped, title)
    chosen.load(preset)
    whole = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    with whole.open("x", encoding="utf-8") as file:
        file.write(_text(preset, chosen))
    whole.replace(path)
    return path


def _text(preset: Preset, model: Model) -> str:
    lines = [f"{key} = {_quoted(getattr(preset, key))}" for key in KEYS if getattr(preset, key)]
    ordered = [p for p in model.parameters if p.name in preset.values]
    width = max((len(f"{p.name} = {preset.values[p.name]!r}") for p in ordered), default=0)
    lines += ["", "[values]"]
    lines += [f"{f'{p.name} = {preset.values[p.name]!r}':{width}}  # {p.unit}, {p.meaning}" for p in ordered]
    lines += ["", "[provenance]"]
    lines += [f"{p.name} = {_quoted(preset.provenance[p.name])}" for p in ordered]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    # JSON escapes what TOML must have escaped, but for DEL
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
