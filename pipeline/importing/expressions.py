"""Parse the expressions of other programs into trees of magpend's text language, and write such trees for people."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

from magpend_core.models.text.grammar import FUNCTIONS, Tree

MAX_LENGTH = 50_000
"""Characters of one expression."""
MAX_DEPTH = 50
"""Brackets and calls within one another."""
MAX_NODES = 40_000
"""Nodes of a tree after functions and sums have been written out."""

ZERO, ONE = Tree("number", 1, 0.0), Tree("number", 1, 1.0)
PI = Tree("name", 1, "pi")


class RefusedError(ValueError):
    """Error: a part of a file cannot be carried over; the message is a sentence without its place."""


_SIGNS = r"\*\*|\.\*|\./|\.\^|<=|>=|==|/=|!=|~=|&&|\|\||[-+*/^()\[\],<>&|!~=?:#@{}%]"
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?"


@dataclass(frozen=True)
class Dialect:
    """Rules by which a program writes expressions.

    Attributes
    ----------
    binary : dict
        Binding strength of each operator; a greater one binds first.
    prefix : dict
        Binding strength of the operand of each sign.
    from_right : frozenset of str
        Operators that are grouped from the right.
    names : str
        Regular expression of a name.
    fold : bool
        Whether capital letters mean the same as small ones.
    square : bool
        Whether indices stand in square brackets, ``x[2]``.
    spelled : dict
        Operators that are written as words.
    """

    binary: Mapping[str, int]
    prefix: Mapping[str, int]
    from_right: frozenset[str] = frozenset()
    names: str = r"[A-Za-z_]\w*"
    fold: bool = False
    square: bool = False
    spelled: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def token(self) -> re.Pattern[str]:
        """Regular expression of a token."""
        return re.compile(rf"\s*(?:(?P<number>{_NUMBER})|(?P<name>{self.names})|(?P<sign>{_SIGNS}))")


COMPARE = {"<": "<", "<=": "<=", ">": ">", ">=": ">=", "==": "==", "!=": "!=", "~=": "!=", "/=": "!="}
AND, OR, NOT, POWER = ("&", "&&"), ("|", "||"), ("not", "!", "~"), ("^", "**", ".^")


@dataclass(frozen=True)
class Token:
    """A token of an expression, with its character, from 1."""

    kind: str
    text: str
    at: int


def tokens_of(text: str, dialect: Dialect) -> list[Token]:
    """Split an expression into tokens.

    Raises
    ------
    RefusedError
        If a character has no meaning.
    """
    if len(text) > MAX_LENGTH:
        raise RefusedError(f"the expression has {len(text)} characters; {MAX_LENGTH} are the most")
    found, place = [], 0
    text = text.rstrip()
    while place < len(text):
        match = dialect.token.match(text, place)
        if match is None:
            odd = text[place:].lstrip()[:1]
            raise RefusedError(f"{odd!r} has no meaning in an expression")
        kind = str(match.lastgroup)
        word = match[kind]
        if kind == "name" and dialect.fold:
            word = word.lower()
        if word.lower() in dialect.spelled:
            kind, word = "sign", dialect.spelled[word.lower()]
        found.append(Token(kind, word, match.start(kind) + 1))
        place = match.end()
    return [*found, Token("end", "", len(text) + 1)]


class Parser:
    """Parser of one expression by precedence climbing. Names and functions are judged by the caller."""

    def __init__(self, text: str, dialect: Dialect, special: Mapping[str, Callable[[Parser, Token], Tree]]) -> None:
        self.dialect, self.special = dialect, special
        self.tokens = tokens_of(text, dialect)
        self.next, self.depth = 0, 0

    @property
    def token(self) -> Token:
        """The next token."""
        return self.tokens[self.next]

    def take(self) -> Token:
        """Return the next token and go past it."""
        token = self.token
        self.next += token.kind != "end"
        return token

    def need(self, text: str) -> None:
        """Go past a token that must stand here."""
        if self.token.text != text:
            raise self.unexpected(f"; {text!r} must stand there")
        self.take()

    def unexpected(self, hint: str = "") -> RefusedError:
        """Return the error that the next token cannot stand where it does."""
        if self.token.kind == "end":
            return RefusedError(f"the expression ends where something must follow{hint}")
        return RefusedError(f"{self.token.text!r} cannot stand at character {self.token.at}{hint}")

    def whole(self) -> Tree:
        """Parse all of the text."""
        tree = self.expression(0)
        if self.token.kind != "end":
            raise self.unexpected()
        return tree

    def expression(self, least: int) -> Tree:
        """Parse an expression whose operators bind at least as strongly as `least`."""
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise RefusedError(f"the expression is nested more than {MAX_DEPTH} deep")
        left = self.operand()
        while (strength := self.dialect.binary.get(self.token.text, -1)) >= least and self.token.kind == "sign":
            token = self.take()
            if token.text == "?":
                left = self.choice(left, token)
                continue
            right = self.expression(strength if token.text in self.dialect.from_right else strength + 1)
            left = joined(token, left, right)
        self.depth -= 1
        return left

    def choice(self, condition: Tree, token: Token) -> Tree:
        """Parse the rest of ``condition ? a : b``."""
        yes = self.expression(1)
        self.need(":")
        return Tree("call", token.at, "where", (as_condition(condition), number(yes), number(self.expression(0))))

    def operand(self) -> Tree:
        """Parse a number, a name, a call, a bracket, or one of them behind a sign."""
        token = self.take()
        if token.kind == "number":
            value = float(token.text.lower().replace("d", "e"))
            if not math.isfinite(value):
                raise RefusedError(f"the number {token.text} is too large")
            if self.token.kind == "name":
                raise self.unexpected("; write a product with *")
            return Tree("number", token.at, value)
        if token.text in self.dialect.prefix:
            return self.signed(token)
        if token.text == "(":
            inner = self.expression(0)
            self.need(")")
            return inner
        if token.kind == "name":
            return self.named(token)
        self.next -= token.kind != "end"
        raise self.unexpected()

    def signed(self, token: Token) -> Tree:
        """Parse the operand of a sign."""
        right = self.expression(self.dialect.prefix[token.text])
        if token.text in NOT:
            return Tree("not", token.at, "", (as_condition(right),))
        return Tree("negative", token.at, "", (number(right),)) if token.text == "-" else number(right)

    def named(self, token: Token) -> Tree:
        """Parse a name, with its arguments or indices."""
        if token.text in self.special:
            return self.special[token.text](self, token)
        brackets = {"(": ")", "[": "]"} if self.dialect.square else {"(": ")"}
        if self.token.text not in brackets:
            return Tree("name", token.at, token.text)
        args = self.arguments(brackets[self.token.text])
        return Tree("call", token.at, token.text, args)

    def arguments(self, closing: str = ")") -> tuple[Tree, ...]:
        """Parse arguments in brackets."""
        self.take()
        args = []
        while self.token.text != closing:
            args.append(self.expression(0))
            if self.token.text != ",":
                break
            self.take()
        self.need(closing)
        return tuple(args)


def joined(token: Token, left: Tree, right: Tree) -> Tree:
    """Return the tree of two operands and the operator between them."""
    sign, at = token.text, token.at
    if sign in COMPARE:
        return compared(COMPARE[sign], number(left), number(right), at)
    if sign in AND or sign in OR:
        return Tree("and" if sign in AND else "or", at, "", (as_condition(left), as_condition(right)))
    left, right = number(left), number(right)
    if sign in POWER:
        return Tree("power", at, "", (left, right))
    if sign in ("-", "/", "./"):
        right = Tree("negative" if sign == "-" else "inverse", at, "", (right,))
    kind = "sum" if sign in "+-" else "product"
    return Tree(kind, at, "", (*(left.args if left.kind == kind else (left,)), right))


def compared(sign: str, left: Tree, right: Tree, at: int = 1) -> Tree:
    """Return a comparison; equality is ``a <= b and a >= b``."""
    if sign == "==":
        return Tree("and", at, "", tuple(Tree("compare", at, s, (left, right)) for s in ("<=", ">=")))
    if sign == "!=":
        return Tree("or", at, "", tuple(Tree("compare", at, s, (left, right)) for s in ("<", ">")))
    return Tree("compare", at, sign, (left, right))


def number(tree: Tree) -> Tree:
    """Return a tree as a number: a condition is 1 where it is true, else 0."""
    return Tree("call", tree.at, "where", (tree, ONE, ZERO)) if tree.is_condition else tree


def as_condition(tree: Tree) -> Tree:
    """Return a tree as a condition: a number is true unless it is 0."""
    if tree.kind == "call" and tree.value == "where" and tree.args[1:] == (ONE, ZERO):
        return tree.args[0]
    return tree if tree.is_condition else compared("!=", tree, ZERO, tree.at)


def walk(tree: Tree) -> Iterator[Tree]:
    """Yield all nodes of a tree."""
    pending = [tree]
    while pending:
        node = pending.pop()
        yield node
        pending += reversed(node.args)


def names_in(tree: Tree) -> set[str]:
    """Return the names in a tree, without those of functions."""
    return {str(node.value) for node in walk(tree) if node.kind == "name"}


def calls_in(tree: Tree) -> set[str]:
    """Return the names of the functions in a tree."""
    return {str(node.value) for node in walk(tree) if node.kind == "call"}


def rewritten(tree: Tree, change: Callable[[Tree], Tree]) -> Tree:
    """Return a tree with `change` applied to every node, innermost first."""
    args = tuple(rewritten(arg, change) for arg in tree.args)
    if any(new is not old for new, old in zip(args, tree.args, strict=True)):
        tree = replace(tree, args=args)
    return change(tree)


def replaced(tree: Tree, names: Mapping[str, Tree]) -> Tree:
    """Return a tree with names replaced by trees."""
    return rewritten(tree, lambda n: names.get(str(n.value), n) if n.kind == "name" else n)


def size(tree: Tree) -> int:
    """Return the number of nodes of a tree."""
    return sum(1 for _ in walk(tree))


def arguments_problem(tree: Tree) -> str | None:
    """Return what is wrong with the number of arguments of a call, or None."""
    least, most = FUNCTIONS[str(tree.value)]
    if least <= len(tree.args) <= most:
        return None
    return f"{tree.value} has {len(tree.args)} arguments; it takes {least if least == most else f'{least} to {most}'}"


_SUM, _PRODUCT, _SIGN, _POWER, _ATOM = range(1, 6)


def written(tree: Tree, names: Mapping[str, str] = {}) -> str:
    """Write a tree as an expression of the text language, with as few brackets as it takes."""
    return _write(tree, names)[0]


def _write(tree: Tree, names: Mapping[str, str]) -> tuple[str, int]:
    """Return the text of a tree, and how strongly its outermost operator binds."""
    if tree.kind == "number":
        return short(float(tree.value)), _ATOM
    if tree.kind == "name":
        return names.get(str(tree.value), str(tree.value)), _ATOM
    parts = [_write(arg, names) for arg in tree.args]
    if tree.kind == "call":
        args = [t[1:-1] if a.is_condition else t for a, (t, _) in zip(tree.args, parts, strict=True)]
        return f"{names.get(str(tree.value), tree.value)}({', '.join(args)})", _ATOM
    if tree.kind == "compare":
        return f"({parts[0][0]} {tree.value} {parts[1][0]})", _ATOM
    if tree.kind in ("and", "or"):
        return f"({f' {tree.kind} '.join(text for text, _ in parts)})", _ATOM
    if tree.kind == "not":
        return f"(not {parts[0][0]})", _ATOM
    if tree.kind == "negative":
        return f"-{_within(parts[0], _PRODUCT)}", _SUM
    if tree.kind == "inverse":
        return f"1/{_within(parts[0], _POWER)}", _PRODUCT
    if tree.kind == "power":
        return f"{_within(parts[0], _ATOM)}**{_within(parts[1], _ATOM)}", _POWER
    if tree.kind == "sum":
        return _written_sum(tree, names), _SUM
    return _written_product(tree, names), _SUM if tree.args[0].kind == "negative" else _PRODUCT


def _within(part: tuple[str, int], least: int) -> str:
    text, binding = part
    return text if binding >= least else f"({text})"


def _written_sum(tree: Tree, names: Mapping[str, str]) -> str:
    text = _within(_write(tree.args[0], names), _SUM)
    for term in tree.args[1:]:
        sign, inner = ("-", term.args[0]) if term.kind == "negative" else ("+", term)
        if term.kind == "product" and term.args[0].kind == "negative":
            sign, inner = "-", replace(term, args=(term.args[0].args[0], *term.args[1:]))
        text += f" {sign} {_within(_write(inner, names), _SUM + 1)}"
    return text


def _written_product(tree: Tree, names: Mapping[str, str]) -> str:
    text = ""
    for factor in tree.args:
        if factor.kind == "inverse":
            text = f"{text or '1'}/{_within(_write(factor.args[0], names), _POWER)}"
        else:
            inner = _within(_write(factor, names), _POWER if text else _SUM if factor.kind == "negative" else _PRODUCT)
            text = f"{text}*{inner}" if text else inner
    return text


def short(value: float) -> str:
    """Write a number of 0 or more as briefly as it reads back."""
    if value == int(value) and abs(value) < 1e15:
        return str(int(value))
    return repr(value)
