"""Specifications as files: TOML in, plain tables out."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.spec.problems import SpecError


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the tables of a TOML file; raises `SpecError` if it cannot be read."""
    try:
        return tomllib.loads(Path(path).read_text("utf-8"))
    except OSError as error:
        raise SpecError([f"{path}: cannot be read ({error.strerror or error})."]) from None
    except UnicodeDecodeError:
        raise SpecError([f"{path}: is not text in UTF-8; a specification is a TOML file."]) from None
    except tomllib.TOMLDecodeError as error:
        raise SpecError([f"{path}: is not valid TOML: {error}."]) from None


def nested(table: Mapping[str, Any]) -> dict[str, Any]:
    """Spread quoted dotted keys: ``{"a.b": 1}`` becomes ``{"a": {"b": 1}}``."""
    result: dict[str, Any] = {}
    for key, value in table.items():
        *parents, last = key.split(".")
        inner = nested(value) if isinstance(value, dict) else value
        for parent in reversed(parents):
            inner, last = {last: inner}, parent
        result = merged(result, {last: inner})
    return result


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with the leaves of `changes` put in; tables merge, everything else is replaced."""
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        result[key] = merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return result
