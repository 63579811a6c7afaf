"""Parse arithmetic expressions given as text, with a whitelist and without evaluating them.

Numbers, names, ``+ - * / **``, comparisons, ``and or not``, calls of `FUNCTIONS`, elements ``x[i + 1]``, and
``sum(j=1..20, x[j])``. There is nothing else: no attributes, no text, no assignment. Length, nesting,
and what numbers may be are bounded, so that whatever is given ends in a tree or in one `GrammarError`, in time
proportional to its length.
"""

from __future__ import annotations

import itertools
import keyword
import math
import re
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from magpend_core.models.parameters import near_names

MAX_LENGTH = 8000
"""Characters of one expression."""
MAX_DEPTH = 60
"""Parentheses, calls and signs within one another."""
MAX_NAME = 40
"""Characters of a name."""

MANY = 8
"""Most arguments of `min` and `max`."""

FUNCTIONS: dict[str, tuple[int, int]] = {
    **dict.fromkeys(
        ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "exp", "log", "log10", "sqrt", "abs"),
        (1, 1),
    ),
    **dict.fromkeys(("ln", "sign", "heaviside", "floor", "ceil"), (1, 1)),
    "mod": (2, 2),
    "atan2": (2, 2),
    "min": (2, MANY),
    "max": (2, MANY),
    "where": (3, 3),
    "square": (2, 2),
}
"""Least and greatest number of arguments by name; ``ln`` is read as ``log``."""

TIMED = ("t", "f", "phase")
"""Time since the section [s], drive frequency [Hz], and t f in [0, 1)."""

BUILT_IN = (*TIMED, "pi")
"""Names with a meaning in all expressions."""

ELSEWHERE = {
    "arctan": "atan",
    "arcsin": "asin",
    "arccos": "acos",
    "arctan2": "atan2",
    "fabs": "abs",
    "pow": "**",
    "sgn": "sign",
    "heav": "heaviside",
    "Heaviside": "heaviside",
    "flr": "floor",
    "fmod": "mod",
    "remainder": "mod",
    "ceiling": "ceil",
    "if": "where",
    "Piecewise": "where",
    "Abs": "abs",
    "power": "**",
    "minimum": "min",
    "maximum": "max",
    "time": "t",
    "frequency": "f",
    "frequency_hz": "f",
}
"""What other languages call it."""

_TOKEN = re.compile(
    r"(?P<number>(?:\d+(?:\.(?!\.)\d*)?|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_][A-Za-z0-9_]*)"
    r"|(?P<sign>\*\*|<=|>=|==|!=|\.\.|[-+*/(),<>^=\[\]])"
)
_SPACE = re.compile(r"[ \t\r\n]*")
_COMPARISONS = ("<", "<=", ">", ">=")
_OR, _AND, _NOT, _COMPARE, _SUM, _PRODUCT, _SIGN, _POWER = range(1, 9)
_BINDING = {
    "or": _OR,
    "and": _AND,
    **dict.fromkeys(_COMPARISONS, _COMPARE),
    "+": _SUM,
    "-": _SUM,
    "*": _PRODUCT,
    "/": _PRODUCT,
    "**": _POWER,
    "^": _POWER,
}


class GrammarError(ValueError):
    """Error: a text is not a valid expression.

    Attributes
    ----------
    problems : tuple of str
        All that is wrong, each with its place; after a wrong sign or bracket only names are judged.
    names : tuple of (str, int)
        Names in the text, each with its place.
    """

    def __init__(self, problems: str | Iterable[str], names: Iterable[tuple[str, int]] = ()) -> None:
        self.problems = (problems,) if isinstance(problems, str) else tuple(problems)
        self.names = tuple(names)
        super().__init__("; ".join(self.problems))


@dataclass(frozen=True, slots=True)
class Tree:
    """Syntax tree of a parsed expression, in the order in which it was written.

    Attributes
    ----------
    kind : str
        ``number``, ``name``, ``call``, ``sum``, ``product``, ``negative``, ``inverse``, ``power``,
        ``compare``, ``and``, ``or`` or ``not``. A difference is the sum with a negative, a quotient the
        product with an inverse. Before it is written out (`calls`) also ``index``, an element of the name `value`,
        and ``total``, a sum over the index `value`, of lowest and highest index and term.
    at : int
        Character of the text, from 1.
    value : float or str
        Of a number; the name of a name or function; the sign of a comparison.
    """

    kind: str
    at: int
    value: float | str = ""
    args: tuple[Tree, ...] = ()

    @property
    def is_condition(self) -> bool:
        """Whether the expression is a condition (true or false) and not a number."""
        return self.kind in ("compare", "and", "or", "not")


NONE: Mapping[str, Any] = {}


def parse(text: object, functions: Mapping[str, int] = NONE, known: Mapping[str, str] = NONE) -> Tree:
    """Parse an arithmetic expression.

    Parameters
    ----------
    text
        A string; a number, as TOML has it without quotes, stands for itself.
    functions
        Numbers of arguments of further functions, by name.
    known
        What names mean, such as ``state``, for messages.

    Raises
    ------
    GrammarError
        If it is no expression. Names are not judged here but for their form: see `names`.
    """
    if isinstance(text, (int, float)) and not isinstance(text, bool):
        if not -1e300 < text < 1e300:
            raise GrammarError("is not a finite number")
        return _number(float(text), 1)
    tree = _parse(text, functions, known)
    if tree.is_condition:
        raise GrammarError("is true or false and not a number; use where(condition, a, b)")
    return tree


def parse_condition(text: object, functions: Mapping[str, int] = NONE, known: Mapping[str, str] = NONE) -> Tree:
    """Parse a condition, such as ``x < 0 and v > 1``; arguments are those of `parse`.

    Raises
    ------
    GrammarError
        If it is none.
    """
    tree = _parse(text, functions, known)
    if not tree.is_condition:
        raise GrammarError("must be a condition, such as x < 0")
    return tree


def _parse(text: object, functions: Mapping[str, int], known: Mapping[str, str]) -> Tree:
    if not isinstance(text, str):
        raise GrammarError("must be an expression in quotes")
    if len(text) > MAX_LENGTH:
        raise GrammarError(f"has {len(text)} characters; {MAX_LENGTH} are the most, use define for parts")
    if not text.strip():
        raise GrammarError("is empty; write an expression")
    tokens, problems = _tokens(text)
    tree = None
    numbers = {**FUNCTIONS, **{name: (n, n) for name, n in functions.items()}}
    if not problems:
        parser = _Parser(tokens, numbers, known)
        problems = parser.problems
        try:
            tree = parser.whole()
        except GrammarError as error:
            problems += error.problems
    if tree is None:
        problems += [p for p in _unknown_functions(tokens, numbers, known) if p not in problems]
    if tree is None or problems:
        raise GrammarError(problems, _names_among(tokens))
    return tree


def _unknown_functions(
    tokens: list[_Token], functions: Mapping[str, tuple[int, int]], known: Mapping[str, str]
) -> Iterator[str]:
    for token, after in itertools.pairwise(tokens):
        is_call = token.kind == "name" and after.text == "(" and token.text not in ("and", "or", "not")
        if is_call and token.text not in functions:
            yield _no_function(token, functions, known)


def _no_function(token: _Token, functions: Iterable[str], known: Mapping[str, str]) -> str:
    if token.text in known:
        return (
            f"{token.text!r} at character {token.at} is a {known[token.text]} and takes no arguments; for a product "
            f"write {token.text}*(...)"
        )
    return unknown(token.text, token.at, functions, "function")


def _names_among(tokens: list[_Token]) -> Iterator[tuple[str, int]]:
    left_out = {"and", "or", "not"} | {token.text for token, after in itertools.pairwise(tokens) if after.text == "="}
    for token, after in itertools.pairwise(tokens):
        if token.kind == "name" and after.text not in ("(", "[") and token.text not in left_out:
            yield token.text, token.at


def names(tree: Tree) -> Iterator[tuple[str, int]]:
    """Yield each name in an expression with its character position; names of functions, of elements and of the indices
    of sums are left out.
    """
    if tree.kind == "name":
        yield str(tree.value), tree.at
    for arg in tree.args[:2] if tree.kind == "total" else tree.args:
        yield from names(arg)
    if tree.kind == "total":
        yield from (found for found in names(tree.args[2]) if found[0] != tree.value)


def name_problem(name: object, free: Container[str] = ()) -> str | None:
    """Return what is wrong with a name given by the user, or None; built-in names among `free` are good."""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        return "must begin with a letter and go on with letters, digits and underscores"
    if len(name) > MAX_NAME:
        return f"has {len(name)} characters; {MAX_NAME} are the most"
    if name in FUNCTIONS or (name in BUILT_IN and name not in free):
        return "has a meaning of its own in expressions; choose another name"
    if keyword.iskeyword(name) or name in ("nan", "inf"):
        return f"is a word of Python; choose another name, such as {name}_"
    return None


def _number(value: float, at: int) -> Tree:
    if value < 0.0:
        return Tree("negative", at, "", (Tree("number", at, -value),))
    return Tree("number", at, value)


@dataclass(frozen=True, slots=True)
class _Token:
    kind: str  # number, name, sign, end
    text: str
    at: int


def _tokens(text: str) -> tuple[list[_Token], list[str]]:
    found: list[_Token] = []
    odd: dict[str, int] = {}
    place = 0
    while True:
        space = _SPACE.match(text, place)
        place = space.end() if space else place
        if place == len(text):
            problems = [f"{char!r} at character {at} has no meaning here" for char, at in odd.items()]
            return [*found, _Token("end", "", place + 1)], problems
        match = _TOKEN.match(text, place)
        if match is None:
            odd.setdefault(text[place], place + 1)
            place += 1
            continue
        found.append(_Token(str(match.lastgroup), match.group(), place + 1))
        place = match.end()


class _Parser:
    """Parser of expressions by precedence climbing; each level of brackets takes two nested calls."""

    def __init__(
        self, tokens: list[_Token], functions: Mapping[str, tuple[int, int]], known: Mapping[str, str]
    ) -> None:
        self.tokens, self.functions, self.known = tokens, functions, known
        self.next = 0
        self.depth = 0
        self.problems: list[str] = []  # those after which the rest can still be read

    @property
    def token(self) -> _Token:
        return self.tokens[self.next]

    def take(self) -> _Token:
        token = self.token
        self.next += token.kind != "end"
        return token

    def whole(self) -> Tree:
        tree = self.expression(_OR)
        if self.token.kind != "end":
            raise self.unexpected(self.token)
        return tree

    def unexpected(self, token: _Token) -> GrammarError:
        hints = {
            "==": "; compare with < or >",
            "!=": "; compare with < or >",
            "=": "; an expression assigns nothing",
            ")": ": there is no ( for it",
        }
        if token.kind == "end":
            return GrammarError("ends where something must follow")
        before = self.tokens[self.next - 1] if self.next else None
        # where an operator is missing
        if before is not None and token is self.token and (token.kind != "sign" or token.text == "("):
            return GrammarError(
                f"{token.text!r} at character {token.at} follows {before.text!r} without a sign; for a "
                f"product write {before.text}*{token.text}"
            )
        return GrammarError(f"{token.text!r} at character {token.at} cannot stand here{hints.get(token.text, '')}")

    def expression(self, least: int) -> Tree:
        """Parse an expression whose operators bind at least as strongly as `least`."""
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise GrammarError(f"is nested more than {MAX_DEPTH} deep; use define for parts")
        left = self.prefix()
        while True:
            token = self.token
            lacks_sign = self.lacks_sign(token)
            binding = _PRODUCT if lacks_sign else _BINDING.get(token.text, 0)
            if binding == 0 or binding < least:
                break
            if lacks_sign:  # read on as if a product were written
                self.problems += self.unexpected(token).problems
            left = self.joined(left, token if lacks_sign else self.take(), binding)
        self.depth -= 1
        return left

    def lacks_sign(self, token: _Token) -> bool:
        """Return whether an operand begins where an operator is expected."""
        is_operand = token.kind in ("number", "name") or token.text == "("
        return is_operand and token.text not in ("and", "or", "not")

    def joined(self, left: Tree, token: _Token, binding: int) -> Tree:
        """Parse the right operand of a binary operator, and return the joined expression."""
        if binding == _POWER:
            begin = self.next
            right = self.expression(_SIGN)
            self.check_tower(token, begin)
            return Tree("power", token.at, "", self.numbers((left, right), token))
        right = self.expression(binding + 1)
        if binding == _COMPARE:
            self.numbers((left, right), token)
            if self.token.text in _COMPARISONS:
                raise GrammarError(
                    f"{self.token.text!r} at character {self.token.at}: compare two at a time, joined by and"
                )
            return Tree("compare", token.at, token.text, (left, right))
        if binding in (_AND, _OR):
            self.conditions((left, right), token)
            return _flat(token.text, left, right)
        self.numbers((left, right), token)
        if token.text == "-":
            right = Tree("negative", token.at, "", (right,))
        if token.text == "/":
            right = Tree("inverse", token.at, "", (right,))
        return _flat("sum" if binding == _SUM else "product", left, right)

    def check_tower(self, token: _Token, begin: int) -> None:
        """Report a power of a power without brackets: languages evaluate ``a^b^c`` in different orders."""
        depth, powers = 0, [token]
        for inner in self.tokens[begin : self.next]:
            depth += (inner.text == "(") - (inner.text == ")")
            powers += [inner] if depth == 0 and inner.text in ("**", "^") else []
        if len(powers) == 2 and "^" in {power.text for power in powers}:
            self.problems.append(
                f"{powers[1].text!r} at character {powers[1].at}: a power of a power is read from the "
                "left by some languages and from the right by others; write brackets, as in x**(y**z)"
            )

    def prefix(self) -> Tree:
        """Parse the beginning of an expression: a sign, a number, a name, a call or a bracket."""
        token = self.take()
        if token.kind == "number":
            value = float(token.text)
            if not math.isfinite(value):
                self.problems.append(f"the number at character {token.at} is too large")
            return Tree("number", token.at, value)
        if token.text in ("+", "-"):
            right = self.expression(_SIGN)
            self.numbers((right,), token)
            return Tree("negative", token.at, "", (right,)) if token.text == "-" else right
        if token.text == "not":
            right = self.expression(_NOT)
            self.conditions((right,), token)
            return Tree("not", token.at, "", (right,))
        if token.text == "(":
            inner = self.expression(_OR)
            self.close(token)
            return inner
        if token.kind == "name" and token.text not in ("and", "or"):
            if self.token.text == "[":
                return self.element(token)
            is_sum = token.text == "sum" and self.token.text == "("
            return self.total(token) if is_sum else self.call(token) if self.token.text == "(" else _name(token)
        self.next -= token.kind != "end"
        raise GrammarError(
            "ends where something must follow"
            if token.kind == "end"
            else f"{token.text!r} at character {token.at} cannot stand here"
        )

    def close(self, opened: _Token, sign: str = ")") -> None:
        if self.token.text == sign:
            self.take()
        elif self.token.kind == "end":
            raise GrammarError(f"the {opened.text} at character {opened.at} is not closed")
        else:
            raise self.unexpected(self.token)

    def element(self, name: _Token) -> Tree:
        """Parse the index of an element, such as ``x[i + 1]``."""
        opened = self.take()
        index = self.expression(_OR)
        self.numbers((index,), opened)
        self.close(opened, "]")
        return Tree("index", name.at, _name(name).value, (index,))

    def total(self, name: _Token) -> Tree:
        """Parse a sum over an index, such as ``sum(j=1..20, x[j])``."""
        opened, variable = self.take(), self.take()
        form = GrammarError(f"sum at character {name.at} needs an index with its range: sum(j=1..20, x[j])")
        if variable.kind != "name" or self.take().text != "=":
            raise form
        if (problem := name_problem(variable.text)) is not None:
            self.problems.append(f"the index {variable.text!r} at character {variable.at} {problem}")
        low = self.expression(_SUM)
        if self.take().text != "..":
            raise form
        high = self.expression(_SUM)
        if self.take().text != ",":
            raise form
        term = self.expression(_OR)
        self.numbers((term,), name)
        self.close(opened)
        return Tree("total", name.at, variable.text, (low, high, term))

    def call(self, name: _Token) -> Tree:
        opened = self.take()
        if name.text not in self.functions:
            self.problems.append(_no_function(name, self.functions, self.known))
        args: list[Tree] = []
        while self.token.text != ")":
            args.append(self.expression(_OR))
            if self.token.text != ",":
                break
            self.take()
        self.close(opened)
        self.check_arguments(name, args)
        return Tree("call", name.at, "log" if name.text == "ln" else name.text, tuple(args))

    def check_arguments(self, name: _Token, args: list[Tree]) -> None:
        least, most = self.functions.get(name.text, (0, len(args)))
        if not least <= len(args) <= most:
            wanted = f"{least}" if least == most else f"{least} to {most}"
            given = f"{len(args)} argument{'s' * (len(args) != 1)}"
            self.problems.append(f"{name.text} at character {name.at} has {given}; it takes {wanted}")
        elif name.text == "where":
            if not args[0].is_condition:
                self.problems.append(
                    f"where at character {name.at} needs a condition first, such as where(x < 0, a, b)"
                )
            self.numbers(tuple(args[1:]), name)
        else:
            self.numbers(tuple(args), name)

    def numbers(self, parts: tuple[Tree, ...], token: _Token) -> tuple[Tree, ...]:
        self.problems += [
            f"a condition stands at character {part.at} where {token.text!r} needs a number; use where(condition, a, b)"
            for part in parts
            if part.is_condition
        ]
        return parts

    def conditions(self, parts: tuple[Tree, ...], token: _Token) -> None:
        self.problems += [
            f"a number stands at character {part.at} where {token.text!r} needs a condition (x < 0, say)"
            for part in parts
            if not part.is_condition
        ]


def unknown(name: str, at: int, known: Iterable[str], what: str) -> str:
    """Return an error sentence for an unknown name, with the nearest known ones."""
    if name in ELSEWHERE:
        return f"unknown {what} {name!r} at character {at}; here it is {ELSEWHERE[name]}"
    hint = near_names(name[:MAX_NAME], known, f"{what}s").rstrip(".")
    return f"unknown {what} {name[:MAX_NAME]!r} at character {at}; {hint}"


def _name(token: _Token) -> Tree:
    if len(token.text) > MAX_NAME:
        raise GrammarError(f"the name at character {token.at} has more than {MAX_NAME} characters")
    return Tree("name", token.at, token.text)


def _flat(kind: str, left: Tree, right: Tree) -> Tree:
    """Append an operand to a sum, product, ``and`` or ``or`` of the same kind, without a further level of nesting."""
    args = left.args if left.kind == kind else (left,)
    return Tree(kind, left.at, "", (*args, right))
