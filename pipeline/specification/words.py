"""Put the default and the bounds of a key of a specification into words, for the docs and for docstrings."""

from __future__ import annotations

from typing import Any, Literal, get_args, get_origin

from pipeline.products.product import bounds_of


def default_in_words(info: Any) -> str:
    """Return the default of a key as Markdown; empty if it says nothing."""
    if info.is_required():
        return "required"
    default = info.get_default(call_default_factory=True)
    if default is None or default in ("", {}):
        return ""
    return f"`{str(default).lower() if isinstance(default, bool) else repr(default)}`"


def bounds_in_words(info: Any) -> str:
    """Return the bounds or the choices of a key as Markdown."""
    if get_origin(info.annotation) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(info.annotation))
    inner = [part for kind in get_args(info.annotation) for part in getattr(kind, "__metadata__", ())]
    words = [bounds_of(info)] + [bounds_of(part) for part in inner if hasattr(part, "metadata")]
    return ", ".join(word for word in words if word)
