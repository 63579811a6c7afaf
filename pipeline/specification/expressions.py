"""Read the expressions that users write beside a model: densities, quantities, origins of starts."""

from __future__ import annotations

from collections.abc import Iterable

from magpend_core.models.text.calls import Writing
from magpend_core.models.text.grammar import GrammarError, Tree, names, parse, unknown

CONSTANTS = ("pi", "f")
"""Names in every expression: pi, and the drive frequency [Hz]."""


def read_expression(key: str, text: str, known: Iterable[str]) -> Tree:
    """Parse the expression of an option, which may use some names and `CONSTANTS`; the option's name is for errors.

    Raises
    ------
    ValueError
        If it is no arithmetic expression (`magpend_core.models.text.grammar`), or uses another name.
    """
    known = [*known, *CONSTANTS]
    try:
        tree = parse(text)
    except GrammarError as error:
        raise ValueError(f"{key} = {text!r}: {error}.") from None
    for name, at in names(tree):
        if name not in known:
            raise ValueError(f"{key} = {text!r}: {unknown(name, at, known, 'name')}.")
    return Writing().out(tree, known)
