"""Letters of attractors: the same in tables and in figures."""

from __future__ import annotations


def letter(attractor: int) -> str:
    """Letter of an id: A to Z, then AA and on; a dash for no attractor."""
    if attractor < 0:
        return "-"
    text = ""
    attractor += 1
    while attractor:
        attractor, digit = divmod(attractor - 1, 26)
        text = chr(ord("A") + digit) + text
    return text
