"""Name attractors by letters, the same in tables and in figures."""

from __future__ import annotations


def letter(attractor: int) -> str:
    """Return the letter of an attractor id: A to Z, then AA and so on; a dash for a negative id."""
    if attractor < 0:
        return "-"
    text = ""
    attractor += 1
    while attractor:
        attractor, digit = divmod(attractor - 1, 26)
        text = chr(ord("A") + digit) + text
    return text
