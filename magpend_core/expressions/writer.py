"""Write expressions as source lines of a Python function that computes them.

Sums are written as nested ``multiply_add``, so that no two bare products are added: the compiler could fuse
either of them, and its choice depends on what else it sees.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from magpend_core.expressions.graph import STATED, Node, in_order

SIMD = ("sqrt", "absolute", "minimum", "maximum", "copysign", "where_less", "multiply_add", "floor")
"""What comes from `engine.simd`."""
VECMATH = (
    *("sincos", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "exp", "expm1", "log"),
    *("power", "sign", "square_wave", "inverse_sqrt"),
)
"""What comes from `engine.vecmath`."""
_NAMES = {"less": "where_less", "square": "square_wave"}


class Writer:
    """Writer of the source lines of one generated function.

    Parameters
    ----------
    leaves
        How a node is called that is given, by its number.
    """

    def __init__(self, leaves: Mapping[int, str]) -> None:
        self.leaves = leaves
        self.lines: list[str] = []
        self.inverse_roots: set[int] = set()

    def write(self, roots: Iterable[Node]) -> list[str]:
        """Write the lines that compute the given graph nodes; return the names of their values in the
        generated code.
        """
        roots = list(roots)
        wanted = self._wanted(roots)
        for node in in_order(wanted.values()):
            if node.number in wanted and node.op != "number" and node.number not in self.leaves:
                self._line(node, wanted)
        return [self.name(root) for root in roots]

    def _wanted(self, roots: list[Node]) -> dict[int, Node]:
        """Return the graph nodes that get a variable in the generated code; a product inside a sum gets none."""
        wanted: dict[int, Node] = {}
        pending = list(roots)
        while pending:
            node = pending.pop()
            if node.number in wanted:
                continue
            wanted[node.number] = node
            if node.number in self.leaves:
                continue
            under = root_under(node)
            if under is not None:
                pending += (node.args[0], under[0])
                continue
            if (power := self._less_one(node)) is not None:
                pending.append(power)
                continue
            for arg in node.args:
                unfolds = arg.op == "neg" and node.op == "add" and arg.number not in self.leaves
                inner = arg.args[0] if unfolds else arg
                fused = node.op == "add" and inner.op == "mul" and inner.number not in self.leaves
                pending += inner.args if fused else (inner,)
        return wanted

    def _less_one(self, node: Node) -> Node | None:
        """Return x if a graph node has the form exp(x) - 1 or 1 - exp(x) and depends on the state; else None.

        Computed as a difference it has no digits near x = 0, where rates of ion channels divide by it.
        """
        if node.op != "add" or node.kind != STATED or len(node.args) != 2 or node.args[0].op != "number":
            return None
        one, other = node.args
        sign, inner = (1.0, other.args[0]) if other.op == "neg" else (-1.0, other)
        known = inner.op != "exp" or not self.leaves.keys().isdisjoint((inner.number, other.number))
        return None if known or not one.is_number(sign) else inner.args[0]

    def name(self, node: Node) -> str:
        """Return what stands for a graph node's value in the generated code: a variable or a number."""
        if node.number in self.leaves:
            return self.leaves[node.number]
        if node.op == "number":
            return repr(node.value)
        return f"v{node.number}"

    def _line(self, node: Node, wanted: Mapping[int, Node]) -> None:
        target = f"v{node.number}"
        under = root_under(node)
        if under is not None:
            self.lines.append(f"{target} = {self._by_root(node.args[0], *under)}")
            return
        if node.op in ("sin", "cos"):
            other = _twin(node, wanted)
            if other is not None and other.number not in self.leaves:
                if other.number > node.number:
                    sine, cosine = (node, other) if node.op == "sin" else (other, node)
                    names = f"v{sine.number}, v{cosine.number}"
                    self.lines.append(f"{names} = sincos({self.name(node.args[0])})")
                return
        self.lines.append(f"{target} = {self._value(node)}")

    def _by_root(self, above: Node, x: Node, n: int) -> str:
        """Return source code for a / x**(n/2), from an inverse square root and products. The products are never fused
        with sums.
        """
        root = f"w{x.number}"
        if x.number not in self.inverse_roots:
            self.inverse_roots.add(x.number)
            self.lines.append(f"{root} = inverse_sqrt({self.name(x)})")
        factors = [root] if n == 1 else [root, f"({root} * {root})"] if n == 3 else []
        if n == 5:
            self.lines.append(f"{root}_2 = {root} * {root}")
            factors = [root, f"({root}_2 * {root}_2)"]
        if not above.is_number(1.0):
            factors = [self.name(above), " * ".join(factors)]
        return factors[0] if len(factors) == 1 else f"multiply_add({factors[0]}, {factors[1]}, 0.0)"

    def _value(self, node: Node) -> str:
        args = [self.name(arg) for arg in node.args] if node.op != "add" else []
        if node.op == "add":
            return self._sum(node)
        if node.op == "mul":
            return f"{args[0]} * {args[1]}"
        if node.op == "div":
            return f"{args[0]} / {args[1]}"
        if node.op == "neg":
            return f"-{args[0]}"
        if node.op == "held":
            return args[0]
        if node.op == "choice":
            raise AssertionError("choices are spelled out before")
        return f"{_NAMES.get(node.op, node.op)}({', '.join(args)})"

    def _sum(self, node: Node) -> str:
        if (power := self._less_one(node)) is not None:
            return f"{'-' if node.args[0].is_number(1.0) else ''}expm1({self.name(power)})"
        plain: list[tuple[str, Node]] = []
        products: list[tuple[str, Node]] = []
        for term in node.args:
            known = term.number in self.leaves  # minus a parameter is a constant of the cell
            sign, inner = ("-", term.args[0]) if term.op == "neg" and not known else ("", term)
            fused = inner.op == "mul" and inner.number not in self.leaves
            (products if fused else plain).append((sign, inner))
        plain.sort(key=lambda term: term[0] == "-")  # begin with what needs no sign
        total = ""
        for sign, inner in plain:
            name = self.name(inner)
            total = f"{total} {sign or '+'} {name}" if total else f"{sign}{name}"
        for sign, inner in products:
            a, b = (self.name(arg) for arg in inner.args)
            total = f"multiply_add({sign}{a}, {b}, {total})" if total else f"{sign}{a} * {b}"
        return total


def root_under(node: Node) -> tuple[Node, int] | None:
    """Return x and n if a graph node has the form a / x**(n/2) with n = 1, 3 or 5 and depends on the state;
    else None.
    """
    if node.op != "div" or node.args[1].kind != STATED:
        return None
    below = node.args[1]
    if below.op == "sqrt":
        return below.args[0], 1
    if below.op != "mul":
        return None
    for whole, root in (below.args, below.args[::-1]):
        if root.op == "sqrt":
            x = root.args[0]
            if whole is x:
                return x, 3
            if whole.op == "mul" and whole.args[0] is x and whole.args[1] is x:
                return x, 5
    return None


def _twin(node: Node, wanted: Mapping[int, Node]) -> Node | None:
    """Return the cosine that the code needs beside a sine of one argument, or the sine beside a cosine; else None."""
    other = "cos" if node.op == "sin" else "sin"
    for candidate in wanted.values():
        if candidate.op == other and candidate.args[0] is node.args[0]:
            return candidate
    return None
