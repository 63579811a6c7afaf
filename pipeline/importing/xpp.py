"""Read the ``.ode`` files of XPPAUT (B. Ermentrout, Simulating, Analyzing, and Animating Dynamical Systems, SIAM 2002).

XPPAUT does not tell capital letters from small ones, groups all operators from the left, and compares before it adds.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from magpend_core.models.text.grammar import FUNCTIONS, Tree
from pipeline.importing.expressions import ZERO, Dialect, Parser, RefusedError, Token, as_condition, number, replaced
from pipeline.importing.numbers import constant
from pipeline.importing.source import Reset, Source, text_of
from pipeline.importing.tables import interpolation
from pipeline.importing.xpp_lines import Line, lines_of

_SAME = dict.fromkeys((">", "<", "==", ">=", "<=", "!=", "^", "**"), 7)
DIALECT = Dialect(
    binary={"+": 4, "-": 4, "|": 4, "*": 6, "/": 6, "&": 6, **_SAME},
    prefix={"-": 7, "+": 7, "!": 7},
    names=r"[it]'|[A-Za-z_]\w*",
    fold=True,
    spelled={"not": "!"},
)
RANDOM = ("ran", "normal", "poisson")
SPELLED = {"ln": "log", "heav": "heaviside", "flr": "floor"}
SPECIAL_FUNCTIONS = ("besselj", "bessely", "besseli", "erf", "erfc", "lgamma")
DELAYS = ("delay", "del_shft")
RESERVED = ("t", "pi", "if", "then", "else", "sum", "of", "shift", *RANDOM, *DELAYS)
SUM, SHIFT = "sum of", "shift"
"""Calls that `resolved` writes out."""
SCREEN_SETTINGS = re.compile(
    r"(x|y|z)(p|plot|lo|hi|min|max)?\d*|nplot|axes|lt|phi|theta|(x|y)nc|smc|umc|but|nout|njmp|maxstor(e)?|runnow|bell|"
    r"back|colormap|grads|height|width|smallfont|bigfont|ps_\w+|nmesh|\w*color|output|but\w*|vmaxpts|autoeval|"
    r"auto[xy](min|max)|plotfmt|tutorial|mouse\w*|aout|dfgrid|dfdraw|ncdraw|tc|forecolor"
)
_NAME = r"([A-Za-z_]\w*)"
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_RATE = re.compile(rf"{_NAME}\s*'\s*=(.*)|d{_NAME}\s*/\s*dt\s*=(.*)", re.IGNORECASE)
_NEXT = re.compile(rf"{_NAME}\s*\(\s*t\s*\+\s*1\s*\)\s*=(.*)", re.IGNORECASE)
_START = re.compile(rf"{_NAME}\s*\(\s*0\s*\)\s*=(.*)")
_FUNCTION = re.compile(rf"{_NAME}\s*\(([\w\s,]*)\)\s*=(.*)")
_PART = re.compile(rf"(!?)\s*{_NAME}\s*=(?!=)(.*)")
_COMMAND = re.compile(r"([A-Za-z_]\w*)\s+(.*)")
_RESET = re.compile(r"([-+]?\s*[01])\s*(?:\{([^{}]*)\}|([^{}]*))\s*\{([^{}]*)\}?\s*")
_SET = re.compile(r"(\S+?)\s*\{([^{}]*)\}?\s*")
_TABLE = re.compile(rf"{_NAME}\s+%\s+(\d+)\s+(\S+)\s+(\S+)\s+(.*)")
_INTEGRAL = re.compile(r"\bint\s*[\[{]", re.IGNORECASE)


def read(path: Path) -> Source:
    """Read an ``.ode`` file. What cannot be carried over stands in `Source.problems`."""
    source = Source(path, "XPPAUT")
    reader = _Reader(source)
    for line in lines_of(text_of(path), source):
        reader.line(line)
    reader.finish()
    return source


class _Reader:
    """Reader of the lines of an ``.ode`` file, one after the other."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.order: list[str] = []  # variables in the order in which shift counts them
        self.conditions: list[tuple[int, str]] = []
        self.left_out: list[str] = []
        self.pending: list[Callable[[], None]] = []

    def line(self, line: Line) -> None:
        """Read a line."""
        source, text = self.source, line.text
        if line.comments:
            known = bool(source.states or source.parameters or source.parts or source.functions)
            target = source.comments.setdefault(self.named(text), []) if known else source.head
            target.extend(line.comments)
        try:
            self.statement(line.number, text)
        except RefusedError as error:
            source.refuse(line.number, str(error))

    def named(self, text: str) -> str:
        """Return the first name that a line defines, to which its comments then belong."""
        words = re.findall(r"[A-Za-z_]\w*", text)[:2]
        is_command = _COMMAND.fullmatch(text) and not _PART.fullmatch(text) and not _RATE.fullmatch(text)
        if is_command and text[:1].lower() not in "pnwa":
            return ""  # a statement that defines no name
        name = (words[-1] if is_command else words[0]).lower() if words else ""
        return name[1:] if re.match(r"d\w+/dt", text, re.IGNORECASE) else name

    def statement(self, n: int, text: str) -> None:
        """Read a statement, by its form."""
        if not text:
            return
        if text.startswith("@"):
            self.options(text[1:])
        elif text.startswith("#include"):
            raise RefusedError("#include: only one file is read; copy the other one into it")
        elif re.match(r"0\s*=", text):
            raise RefusedError("0 = ...: algebraic equations are not carried over; solve for the variable")
        elif match := _RATE.fullmatch(text):
            self.equation(n, match[1] or match[3], match[2] if match[1] else match[4])
        elif match := _NEXT.fullmatch(text):
            self.source.is_map = True
            self.equation(n, match[1], match[2])
        elif match := _START.fullmatch(text):
            self.pending.append(lambda m=match: self.start(n, m[1].lower(), m[2]))  # type: ignore[misc]
        elif match := _FUNCTION.fullmatch(text):
            self.function(n, match[1], match[2], match[3])
        elif match := _PART.fullmatch(text):
            self.part(n, match[2], match[3], is_derived=bool(match[1]))
        elif match := _COMMAND.fullmatch(text):
            self.command(n, match[1].lower(), match[2].strip())
        else:
            raise RefusedError(f"{text[:60]!r} is not understood")

    def define(self, n: int, name: str) -> str:
        """Note where a name is defined and how it is spelled; return it in small letters."""
        low = name.lower()
        if low in RESERVED:
            raise RefusedError(f"{name} has a meaning in XPPAUT, for which {low.upper()} and {low} are one")
        known = self.source.lines.get(low)
        if known is not None:
            raise RefusedError(f"{name} is defined in line {known} already")
        self.source.lines[low], self.source.spelling[low] = n, name
        return low

    def tree(self, n: int, text: str) -> Tree:
        """Parse an expression; say where it compares before it adds."""
        if _INTEGRAL.search(text):
            raise RefusedError("integrals (Volterra equations, convolutions) are not carried over")
        parser = Parser(text, DIALECT, {"if": _conditional, SUM[:3]: _sum})
        tree = number(parser.whole())
        if _mixes_comparison(parser.tokens):
            self.source.notes.append(
                f"line {n}: XPPAUT compares before it adds, and so does the model: a + b < c is a + (b < c)."
            )
        return tree

    def equation(self, n: int, name: str, text: str) -> None:
        """Read the equation of a state."""
        low = self.define(n, name)
        self.order.insert(len(self.source.states), low)
        self.source.states[low] = ZERO
        self.source.states[low] = self.tree(n, text)

    def function(self, n: int, name: str, args: str, text: str) -> None:
        """Read a function; one of t with an integral is a Volterra equation."""
        low = self.define(n, name)
        names = tuple(word.strip().lower() for word in args.split(","))
        if not all(re.fullmatch(r"[a-z_]\w*", word) for word in names) or len(set(names)) < len(names):
            raise RefusedError(f"{name}({args}): arguments must be different names")
        self.source.functions[low] = (names, ZERO)
        self.source.functions[low] = (names, self.tree(n, text))

    def part(self, n: int, name: str, text: str, *, is_derived: bool = False) -> None:
        """Read a fixed variable or a derived parameter."""
        low = self.define(n, name)
        if not is_derived:
            self.order.append(low)
        self.source.parts[low] = ZERO
        self.source.parts[low] = self.tree(n, text)

    def start(self, n: int, name: str, text: str) -> None:
        """Read an initial value, which may be an expression of the parameters."""
        try:
            if name not in self.source.states:
                raise RefusedError(f"{name}(0): there is no such variable")
            self.source.starts[name] = constant(self.source, self.tree(n, text), {"t": 0.0})
        except RefusedError as error:
            self.source.refuse(n, str(error))

    def command(self, n: int, word: str, rest: str) -> None:
        """Read a statement that begins with a word; XPPAUT looks at its first letters."""
        refused = {
            "ma": "Markov variables are not carried over",
            "so": "algebraic equations are not carried over; solve for the variable",
            "sp": "sums over networks (special) are not carried over",
            "ve": "vectors are not carried over",
            "vo": "integrals (Volterra equations) are not carried over",
            "gr": "groups are not carried over",
            "ex": "functions in a compiled library (export) are not carried over",
        }
        readers: dict[str, Callable[[int, str], None]] = {
            "p": self.parameters,
            "n": self.numbers,
            "i": self.initial,
            "w": self.wiener,
            "g": self.reset,
            "au": self.auxiliary,
            "b": self.boundary,
            "se": self.preset,
            "ta": self.table,
            "o": lambda n, rest: self.left_out.append(f"{word} {rest}"[:40]),
        }
        if word[:2] in refused or (word == "v" and "=" in rest):
            raise RefusedError(f"{word}: {refused.get(word[:2], refused['vo'])}")
        known = readers.get(word[:2]) or (readers.get(word[:1]) if len(word[:1]) == 1 else None)
        if known is None or word in ("addtosol", "phsol", "strength", "species", "buffcap"):
            raise RefusedError(f"{word}: XPPAUT's directive is not known here")
        known(n, rest)

    def assigned(self, text: str) -> list[tuple[str, str]]:
        """Split ``a=1, b=2 c`` into names and values."""
        items = re.split(r"[,\s]+", re.sub(r"\s*=\s*", "=", text.strip().strip(",")))
        return [(item.partition("=")[0], item.partition("=")[2]) for item in items if item]

    def value(self, name: str, text: str) -> float:
        """Return a value that is a number; XPPAUT reads no expressions here."""
        if not text:
            return 0.0
        if not _NUMBER.fullmatch(text):
            lead = _NUMBER.match(text)
            read = f"only {lead[0]}" if lead else "0"
            raise RefusedError(f"{name}={text}: must be a number; XPPAUT reads {read} here. Write !{name}={text}")
        value = float(text)
        if abs(value) > 1e300:
            raise RefusedError(f"{name}={text}: is too large")
        return value

    def parameters(self, n: int, text: str) -> None:
        """Read parameters with their values."""
        for name, value in self.assigned(text):
            if not re.fullmatch(_NAME, name):
                raise RefusedError(f"{name!r} is no name of a parameter")
            low = self.define(n, name)
            self.source.parameters[low] = self.value(name, value)

    def numbers(self, n: int, text: str) -> None:
        """Read constants, which become parts of the equations."""
        for name, value in self.assigned(text):
            if not re.fullmatch(_NAME, name):
                raise RefusedError(f"{name!r} is no name of a number")
            low, given = self.define(n, name), self.value(name, value)
            whole = Tree("number", 1, abs(given))
            self.source.parts[low] = Tree("negative", 1, "", (whole,)) if given < 0 else whole

    def initial(self, n: int, text: str) -> None:
        """Read initial values."""

        def put() -> None:
            for name, value in self.assigned(text):
                try:
                    if name.lower() not in self.source.states:
                        raise RefusedError(f"init {name}: there is no such variable")
                    self.source.starts[name.lower()] = self.value(name, value)
                except RefusedError as error:
                    self.source.refuse(n, str(error))

        self.pending.append(put)

    def wiener(self, n: int, text: str) -> None:
        """Read names of white noise."""
        for name, _ in self.assigned(text):
            if not re.fullmatch(_NAME, name):
                raise RefusedError(f"{name!r} is no name of a Wiener variable")
            self.source.noises.append(self.define(n, name))

    def auxiliary(self, n: int, text: str) -> None:
        """Read a quantity; its name may have any characters."""
        name, sign, right = text.partition("=")
        if not sign:
            raise RefusedError(f"aux {text}: must be aux NAME=EXPRESSION")
        low = f"aux {name.strip().lower()}"
        if low in self.source.quantities:
            raise RefusedError(f"aux {name.strip()} is given twice")
        self.source.lines[low], self.source.spelling[low] = n, name.strip()
        self.source.quantities[low] = self.tree(n, right)

    def boundary(self, n: int, text: str) -> None:
        """Note a boundary condition; `finish` judges all of them."""
        self.conditions.append((n, re.sub(r"\s", "", text.lower())))

    def preset(self, n: int, text: str) -> None:
        """Read a named set of values."""
        match = _SET.fullmatch(text)
        if match is None:
            raise RefusedError(f"set {text[:40]}: must be set NAME {{a=1,b=2}}")

        def put() -> None:
            found, others = {}, []
            for name, value in self.assigned(match[2]):
                low = name.lower()
                if low in self.source.parameters and _NUMBER.fullmatch(value):
                    found[low] = float(value)
                elif low in self.source.states or not SCREEN_SETTINGS.fullmatch(low):
                    others.append(f"{name}={value}")
            if found:
                self.source.presets[match[1]] = found
            if others:
                self.source.notes.append(
                    f"line {n}: the set {match[1]} keeps its parameters; left out: {', '.join(others)}."
                )

        self.pending.append(put)

    def reset(self, n: int, text: str) -> None:
        """Read an event: ``SIGN CONDITION {NAME=EXPRESSION;...}``."""
        match = _RESET.fullmatch(text)
        if match is None:
            raise RefusedError(f"global {text[:40]}: must be global SIGN CONDITION {{NAME=EXPRESSION}}")
        direction = int(match[1].replace(" ", ""))
        if direction == 0:
            raise RefusedError("global 0: only passages of zero upwards (1) or downwards (-1) are carried over")
        of = self.tree(n, match[2] if match[2] is not None else match[3])
        values: dict[str, Tree] = {}
        for item in filter(None, (i.strip() for i in match[4].split(";"))):
            name, sign, right = (part.strip() for part in item.partition("="))
            if not sign:
                raise RefusedError(f"global: {item[:40]!r} must be NAME=EXPRESSION")
            if name.lower() in ("out_put", "arret", "no_interp"):
                raise RefusedError(f"global: {name} steers XPPAUT's output, and is not carried over")
            values[name.lower()] = self.tree(n, right)
        self.source.resets.append(Reset(of, direction, values, n))

    def table(self, n: int, text: str) -> None:
        """Read a table, given by a function or in a file, as a function of one argument."""
        match = _TABLE.fullmatch(text)
        if match is not None:
            low = self.define(n, match[1])
            self.source.functions[low] = (("t",), ZERO)
            self.source.functions[low] = (("t",), self.tree(n, match[5]))
            self.source.notes.append(
                f"line {n}: the table {match[1]} is its function itself, as smooth as that; XPPAUT interpolates it "
                f"linearly between {match[2]} points from {match[3]} to {match[4]}."
            )
            return
        name, _, file = text.partition(" ")
        low = self.define(n, name)
        if not re.fullmatch(_NAME, name) or not re.fullmatch(r"[\w.-]+", file.strip()):
            raise RefusedError(f"table {text[:40]}: must name a file beside this one")
        self.source.functions[low] = (("t",), interpolation(self.source.path.parent / file.strip()))
        self.source.notes.append(
            f"line {n}: the table {name} is interpolated linearly, as there: continuous, with corners at its points."
        )

    def options(self, text: str) -> None:
        """Read options; those of the screen are left out."""
        for name, value in self.assigned(text):
            low = name.lower()
            if low == "fold":
                self.source.circles.add(value.lower())
            elif not SCREEN_SETTINGS.fullmatch(low):
                self.source.settings[low] = value.lower()

    def finish(self) -> None:
        """Complete what depends on the whole file: starts, sets, sums, shifts and boundary conditions."""
        source = self.source
        for put in self.pending:
            put()
        if source.settings.get("meth", source.settings.get("method", "")).startswith("d"):
            source.is_map = True
        if "dll_lib" in source.settings:
            source.refuse(1, "functions in a compiled library (dll_lib) are not carried over")
        self.judge_boundary()
        circles = {name for name in source.circles if name in source.states}
        source.circles = circles if abs(float(self.setting("tor_per", 6.283185307)) - 6.283185307) < 1e-4 else set()
        if circles - source.circles:
            source.notes.append("fold: only angles modulo 2 pi are on a circle; others are left unfolded.")
        self.resolve()
        if self.left_out:
            source.notes.append(f"left out, since it concerns the screen: {'; '.join(self.left_out)}.")
        if not source.states:
            source.refuse(1, "there is no equation x' = ..., dx/dt = ... or x(t+1) = ...")

    def setting(self, name: str, default: float) -> float:
        """Return an option that is a number."""
        text = self.source.settings.get(name, "")
        return float(text) if _NUMBER.fullmatch(text) else default

    def judge_boundary(self) -> None:
        """Refuse boundary conditions, but for those of a period, x(0) = x(T), which say what is looked for only."""
        for n, text in self.conditions:
            match = re.fullmatch(r"(\w+)'?-(\w+)'?", text)
            if match is None or match[1] != match[2] or text.count("'") != 1:
                self.source.refuse(n, f"{text}: boundary value problems are not carried over")
            else:
                self.source.notes.append(f"line {n}: {text} is left out: magpend finds periodic motions itself.")

    def resolve(self) -> None:
        """Write out sums, shifts and XPPAUT's functions in all trees."""
        source = self.source
        resolver = _Resolver(source, self.order)
        for table in (source.states, source.parts, source.quantities):
            for name, tree in table.items():
                table[name] = resolver.tree(tree, name)
        for name, (args, tree) in source.functions.items():
            source.functions[name] = (args, resolver.tree(tree, name, frozenset(args)))
        for reset in source.resets:
            source.lines["global"] = reset.line
            reset.of = resolver.tree(reset.of, "global")
            reset.set = {name: resolver.tree(tree, "global") for name, tree in reset.set.items()}


class _Resolver:
    """Writes out sums and shifts, and spells XPPAUT's functions as magpend does."""

    def __init__(self, source: Source, order: list[str]) -> None:
        self.source, self.order = source, order
        self.budget = 200_000

    def tree(self, tree: Tree, name: str, args: frozenset[str] = frozenset()) -> Tree:
        """Return a tree that is written out; refuse what cannot be."""
        try:
            return self.resolved(tree, args)
        except RefusedError as error:
            self.source.refuse(self.source.line_of(name), str(error))
            return ZERO

    def resolved(self, tree: Tree, args: frozenset[str]) -> Tree:
        """Return a tree that is written out; `args` are the arguments of the function around it."""
        self.budget -= 1
        if self.budget < 0:
            raise RefusedError("sums make the equations too long")
        if tree.kind == "call" and tree.value == SUM:
            return self.summed(tree, args)
        inner = tuple(self.resolved(arg, args) for arg in tree.args)
        tree = Tree(tree.kind, tree.at, tree.value, inner)
        if tree.kind != "call" or tree.value in self.source.functions:
            return tree
        if tree.value == SHIFT:
            return self.shifted(tree, args)
        return spelled(tree)

    def summed(self, tree: Tree, args: frozenset[str]) -> Tree:
        """Return the terms of a sum."""
        low, high = (int(self.constant(arg, args)) for arg in tree.args[:2])
        if high - low >= 2000:
            raise RefusedError(f"sum({low},{high}): has more than 2000 terms")
        terms = []
        for i in range(low, high + 1):
            index = Tree("number", 1, float(abs(i)))
            index = Tree("negative", 1, "", (index,)) if i < 0 else index
            terms.append(self.resolved(replaced(tree.args[2], {"i'": index}), args))
        return Tree("sum", tree.at, "", tuple(terms)) if len(terms) > 1 else (terms or [ZERO])[0]

    def constant(self, tree: Tree, args: frozenset[str]) -> float:
        """Return the value of an expression of numbers."""
        try:
            return constant(self.source, self.resolved(tree, args), {})
        except RefusedError:
            raise RefusedError("the bounds of sums and the second argument of shift must be numbers") from None

    def shifted(self, tree: Tree, args: frozenset[str]) -> Tree:
        """Return the variable so many places after another."""
        if len(tree.args) != 2 or tree.args[0].kind != "name":
            raise RefusedError("shift must be shift(NAME, NUMBER)")
        name, step = str(tree.args[0].value), int(self.constant(tree.args[1], args))
        names = self.order if name in self.order else list(self.source.parameters)
        if name not in names or not 0 <= names.index(name) + step < len(names):
            raise RefusedError(f"shift({name}, {step}): there is no such variable")
        return Tree("name", tree.at, names[names.index(name) + step])


def spelled(tree: Tree) -> Tree:
    """Spell a call of a function of XPPAUT as magpend does; raise if there is none."""
    name, args = str(tree.value), tree.args
    if name in SPELLED:
        return Tree("call", tree.at, SPELLED[name], args)
    if name in RANDOM:
        raise RefusedError(f"{name}: random numbers are not carried over; white noise is (wiener)")
    if name in DELAYS:
        raise RefusedError(f"{name}: delays are not carried over")
    if name in SPECIAL_FUNCTIONS:
        raise RefusedError(f"{name}: the text of a model has no such function")
    if name == "hom_bcs":
        raise RefusedError("hom_bcs: boundary value problems are not carried over")
    if name not in FUNCTIONS or (name in ("where", "square") and len(args) != 3):
        raise RefusedError(f"{name}: there is no such function")
    return tree


def _conditional(parser: Parser, token: Token) -> Tree:
    """Parse ``if(a)then(b)else(c)`` from the bracket after ``if``."""
    parts = []
    for word in ("", "then", "else"):
        if word:
            parser.need(word)
        parser.need("(")
        parts.append(parser.expression(0))
        parser.need(")")
    return Tree("call", token.at, "where", (as_condition(parts[0]), number(parts[1]), number(parts[2])))


def _sum(parser: Parser, token: Token) -> Tree:
    """Parse ``sum(a,b)of(c)`` from the bracket after ``sum``."""
    if parser.token.text != "(":
        raise parser.unexpected()
    bounds = parser.arguments()
    parser.need("of")
    parser.need("(")
    body = parser.expression(0)
    parser.need(")")
    if len(bounds) != 2:
        raise RefusedError("sum must be sum(FIRST,LAST)of(EXPRESSION)")
    return Tree("call", token.at, SUM, (*bounds, number(body)))


def _mixes_comparison(tokens: list[Token]) -> bool:
    """Return whether a comparison has an arithmetic operator beside it within the same brackets."""
    levels: list[list[str]] = [[]]
    for before, token in zip([Token("sign", "(", 0), *tokens], tokens, strict=False):
        if token.text == "(":
            levels.append([])
        elif token.text in (")", ",") and _mixed(levels[-1]):
            return True
        elif token.text == ")" and len(levels) > 1:
            levels.pop()
        elif token.text == ",":
            levels[-1] = []
        elif token.kind == "sign" and not (token.text == "-" and before.text in ("(", ",")):
            levels[-1].append(token.text)
    return any(map(_mixed, levels))


def _mixed(signs: list[str]) -> bool:
    return any(s in _SAME and s not in ("^", "**") for s in signs) and any(s in ("+", "-", "*", "/") for s in signs)
