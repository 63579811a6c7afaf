"""Write model symbols as plain text, for places that do not render LaTeX."""

from __future__ import annotations

import re
import unicodedata

_SUBSCRIPTS = str.maketrans("0123456789+-aehijklmnoprstuvx", "₀₁₂₃₄₅₆₇₈₉₊₋ₐₑₕᵢⱼₖₗₘₙₒₚᵣₛₜᵤᵥₓ")

_ACCENTS = {"dot": "\u0307", "ddot": "\u0308", "hat": "\u0302", "bar": "\u0304", "tilde": "\u0303"}

_ACCENT = re.compile(r"\\(dot|ddot|hat|bar|tilde)\s*(?:\{([^{}]*)\}|(\\[A-Za-z]+|.))")
_FONT = re.compile(r"\\(?:mathrm|mathit|mathbf|text|operatorname)\s*\{([^{}]*)\}")
_SUBSCRIPT = re.compile(r"_(?:\{([^{}]*)\}|(.))")


def _letter(name: str) -> str:
    """Return a Greek letter by its LaTeX name; keep any other word."""
    known = name.lower().removeprefix("var")
    case = "SMALL" if name[0].islower() else "CAPITAL"
    # Unicode spells lambda differently
    spelled = {"lambda": "lamda"}.get(known, known).upper()
    try:
        return unicodedata.lookup(f"GREEK {case} LETTER {spelled}")
    except KeyError:
        return name


def plain(symbol: str, name: str) -> str:
    r"""Write a symbol without LaTeX: Greek letters, accents and subscripts of Unicode.

    Parameters
    ----------
    symbol
        LaTeX without dollar signs; may be empty.
    name
        Name to use if there is no symbol.

    Examples
    --------
    >>> plain(r"\dot{\theta}_1", "rate")
    'θ̇₁'
    """
    if not symbol:
        return name.replace("_", " ")
    text = _FONT.sub(lambda found: f"{{{found[1]}}}", symbol)
    text = _ACCENT.sub(lambda found: f"{found[2] or found[3]}{{{_ACCENTS[found[1]]}}}", text)
    text = re.sub(r"\\([A-Za-z]+)", lambda found: _letter(found[1]), text)
    text = re.sub(r"\{([\u0300-\u036f])\}", r"\1", text)
    return _SUBSCRIPT.sub(_lowered, text).replace("{", "").replace("}", "").strip()


def _lowered(found: re.Match[str]) -> str:
    """Return a subscript in Unicode subscript characters, or as ``_TEXT`` if a character has no such form."""
    text = (found[1] if found[1] is not None else found[2]).replace(" ", "")
    small = text.translate(_SUBSCRIPTS)
    return small if all(a != b for a, b in zip(text, small, strict=True)) else f"_{text}"
