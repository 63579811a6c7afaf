"""Write the tables of a specification as TOML, in the order in which the docs explain them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.specification.models import model_toml
from pipeline.specification.toml import toml_key, toml_value

ORDER = (
    "parameters",
    "axes",
    "initial_conditions",
    "section",
    "drive",
    "drift",
    "noise",
    "continuation",
    "integration",
    "products",
    "execution",
    "smoke",
)
"""Tables of a specification in the order of a file. A model as text comes last, with its own tables."""


def specification_toml(tables: Mapping[str, Any]) -> str:
    """Return the tables of a specification as TOML text. Empty tables are left out.

    Parameters
    ----------
    tables
        Plain data with the keys of a specification. Values that no specification has are written as they
        are, for the reader to report.
    """
    model = tables.get("model")
    text = model_toml(model) if isinstance(model, str | Mapping) else None
    plain = {key: value for key, value in tables.items() if key != "model" and not isinstance(value, Mapping)}
    lines = [f"{toml_key(key)} = {toml_value(value)}" for key, value in plain.items()]
    if model is not None and (text is None or not text.startswith("[")):
        lines.append(text.rstrip("\n") if text is not None else f"model = {toml_value(model)}")
    names = [key for key in tables if key not in plain and key != "model"]
    for name in sorted(names, key=lambda n: ORDER.index(n) if n in ORDER else len(ORDER)):
        entries = [f"{toml_key(k)} = {toml_value(v)}" for k, v in tables[name].items()]
        lines += ["", f"[{toml_key(name)}]", *entries] if entries else []
    if text is not None and text.startswith("["):
        lines += ["", text.rstrip("\n")]
    return "\n".join(lines).lstrip("\n") + "\n"
