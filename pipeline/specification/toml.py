"""Write plain data as TOML that reads back as the same data."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any


def toml_key(key: str) -> str:
    """Format a TOML key, quoted if necessary."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key)


def toml_value(value: Any) -> str:
    """Format a number, text, boolean, list or inline table as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON escapes every character that TOML requires, except DEL
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{toml_key(k)} = {toml_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        items = [toml_value(v) for v in value]
        if any(isinstance(v, list | tuple) for v in value):
            return "[\n" + "".join(f"    {item},\n" for item in items) + "]"
        return "[" + ", ".join(items) + "]"
    return repr(value)


def table_lines(head: str, table: Mapping[str, Any]) -> list[str]:
    """Return the TOML lines of a table and of the tables in it, each below its own header."""
    plain = {key: value for key, value in table.items() if not isinstance(value, Mapping)}
    lines = [f"[{head}]", *(f"{toml_key(key)} = {toml_value(value)}" for key, value in plain.items())]
    for key, inner in table.items():
        if key not in plain:
            entries = (f"{toml_key(k)} = {toml_value(v)}" for k, v in inner.items())
            lines += ["", f"[{head}.{toml_key(key)}]", *entries]
    return lines
