"""Evaluate the functions of a system on symbols, and derive from them what an implicit method needs.

The functions run as plain Python with a symbol in place of each number; every operation on symbols adds a node to an
expression graph. So derivatives are exact for every system, however its functions were written, and of a system that
was extended by tangent vectors, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

from magpend_core.engine import simd, vecmath
from magpend_core.engine.jit import inline
from magpend_core.engine.plain_python import plain
from magpend_core.engine.system import System
from magpend_core.expressions.derivatives import derivatives
from magpend_core.expressions.graph import Graph, GraphError, Node
from magpend_core.expressions.writer import SIMD, VECMATH, Writer
from magpend_core.sizes import MAX_STATES


class Symbol:
    """Node of an expression graph with the arithmetic of a number."""

    __slots__ = ("graph", "node")
    __array_ufunc__ = None  # numpy's numbers leave the arithmetic to this class

    def __init__(self, graph: Graph, node: Node) -> None:
        self.graph, self.node = graph, node

    def _chosen(self, other: Any = None) -> bool:
        raise GraphError("they choose by an if, which has no derivative; write simd.where_less")

    __bool__ = __lt__ = __le__ = __gt__ = __ge__ = _chosen

    def __add__(self, other: Any) -> Symbol:
        return _made(self.graph.add, self, other)

    def __sub__(self, other: Any) -> Symbol:
        return _made(self.graph.sub, self, other)

    def __rsub__(self, other: Any) -> Symbol:
        return _made(self.graph.sub, other, self)

    def __mul__(self, other: Any) -> Symbol:
        return _made(self.graph.mul, self, other)

    def __truediv__(self, other: Any) -> Symbol:
        return _made(self.graph.div, self, other)

    def __rtruediv__(self, other: Any) -> Symbol:
        return _made(self.graph.div, other, self)

    def __pow__(self, other: Any) -> Symbol:
        return _made(self.graph.power, self, other)

    def __neg__(self) -> Symbol:
        return _made(self.graph.neg, self)

    def __pos__(self) -> Symbol:
        return self

    __radd__, __rmul__ = __add__, __mul__


def _made(make: Callable[..., Node], *args: Any) -> Symbol:
    graph = next(a.graph for a in args if isinstance(a, Symbol))
    return Symbol(graph, make(*(a.node if isinstance(a, Symbol) else graph.number(float(a)) for a in args)))


def _called(name: str, own: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls another, or makes its node if an argument is a symbol."""

    def call(*args: Any) -> Any:
        symbols = [a for a in args if isinstance(a, Symbol)]
        return _made(lambda *nodes: symbols[0].graph.call(name, *nodes), *args) if symbols else own(*args)

    return call


def _where_less(a: Any, b: Any, yes: Any, no: Any) -> Any:
    symbols = [x for x in (a, b, yes, no) if isinstance(x, Symbol)]
    return _made(symbols[0].graph.where_less, a, b, yes, no) if symbols else simd.where_less(a, b, yes, no)


def _substitutes() -> dict[Callable[..., Any], Callable[..., Any]]:
    alike = ("exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh", "asin", "acos", "atan", "atan2", "sign")
    calls = {name: _called(name, plain(getattr(vecmath, name))) for name in alike}
    calls |= {name: _called(name, getattr(simd, name)) for name in ("sqrt", "absolute", "floor", "minimum", "maximum")}
    power, square = _called("power", plain(vecmath.power)), _called("square", plain(vecmath.square_wave))
    found = {getattr(simd if name in SIMD else vecmath, name): call for name, call in calls.items()}
    return found | {
        simd.where_less: _where_less,
        simd.multiply_add: lambda a, b, c: a * b + c,
        simd.copysign: lambda x, s: calls["absolute"](x) * calls["sign"](s),
        vecmath.expm1: lambda x: calls["exp"](x) - 1.0,
        vecmath.exp2_falling: lambda x: calls["exp"](x * (1.0 / vecmath.LOG2_E)),
        vecmath.sincos: lambda x: (calls["sin"](x), calls["cos"](x)),
        vecmath.inverse_sqrt: lambda x: 1.0 / calls["sqrt"](x),
        vecmath.power: lambda x, y: x**y if isinstance(x, Symbol) else power(x, y),
        vecmath.square_wave: square,
        vecmath.wrapped: lambda x: x - vecmath.TWO_PI * calls["floor"]((x + 0.5 * vecmath.TWO_PI) / vecmath.TWO_PI),
    }


class Linearised(NamedTuple):
    """Derivatives of functions of states and time by the states and by time, as one compiled function.

    ``function(y, t, c)`` returns them as one tuple: those by the states, at the (row, column) in `entries`, then those
    of the rows in `timed` by time.
    """

    function: Callable[..., Any]
    entries: tuple[tuple[int, int], ...]
    timed: tuple[int, ...]


class _Traced:
    """Rates of a system, and its forcing, as expressions of states, time and constants."""

    def __init__(self, system: System) -> None:
        self.system, self.graph = system, Graph()
        graph, n = self.graph, (system.tangents_of or system).n_states
        self.time, self.drive = graph.leaf("time"), graph.leaf("clock")
        self.states = [graph.leaf("state", i) for i in range(system.known)]
        self.own = self.states[:n]
        self.vector = [graph.leaf("rate", i) for i in range(n)]
        constants = [graph.leaf("parameter", i) for i in range(system.n_constants + system.n_modes)]
        y, c = (tuple(Symbol(graph, node) for node in nodes) for nodes in (self.states, constants))
        self.rates = _nodes(graph, _called_plain(system.rhs, y, Symbol(graph, self.drive), c))
        forcing = _nodes(graph, [_called_plain(system.forcing, Symbol(graph, self.time), c)])
        (self.speed,) = derivatives(graph, forcing, {self.time: graph.one})
        self.names = {node.number: f"y[{i}]" for i, node in enumerate(self.states)}
        self.names |= {node.number: f"v[{i}]" for i, node in enumerate(self.vector)}
        self.names |= {node.number: f"c[{i}]" for i, node in enumerate(constants)}
        self.names |= {self.time.number: "t", self.drive.number: "u"}

    def along_vector(self) -> tuple[Node, ...]:
        """Return the products of the Jacobian and a vector."""
        return tuple(derivatives(self.graph, self.rates, dict(zip(self.own, self.vector, strict=True))))

    def trace(self) -> Node:
        """Return the trace of the Jacobian."""
        pairs = zip(self.rates, self.own, strict=True)
        return self.graph.add(*(derivatives(self.graph, (rate,), {x: self.graph.one})[0] for rate, x in pairs))

    def linearised(self, roots: tuple[Node, ...], arguments: str) -> Linearised:
        """Compile the derivatives of expressions by the states, without tangent vectors, and by time."""
        graph = self.graph
        columns = [derivatives(graph, roots, {state: graph.one}) for state in self.own]
        places = [(i, j) for i in range(len(roots)) for j in range(len(self.own))]
        entries = [(i, j) for i, j in places if not columns[j][i].is_number(0.0)]
        by_time = derivatives(graph, roots, {self.drive: self.speed})
        timed = [i for i, node in enumerate(by_time) if not node.is_number(0.0)]
        writer = Writer(self.names)
        values = writer.write([*(columns[j][i] for i, j in entries), *(by_time[i] for i in timed)])
        results = "".join(f"zero + {value}, " for value in values)
        lines = ["u = _forcing(t, c)", "zero = 0.0 * y[0]", *writer.lines, f"return ({results})"]
        scope: dict[str, Any] = {"__name__": self.system.rhs.__module__, "_forcing": self.system.forcing}
        scope |= {name: getattr(simd, name) for name in SIMD}
        scope |= {name: getattr(vecmath, name) for name in VECMATH}
        exec(f"def linearise({arguments}):\n    " + "\n    ".join(lines) + "\n", scope)
        return Linearised(inline(scope["linearise"]), tuple(entries), tuple(timed))


@cache
def _traced(system: System) -> _Traced:
    return _Traced(system)


@cache
def linearised(system: System) -> Linearised:
    """Derive the derivatives of a system's rates.

    Parameters
    ----------
    system
        System whose rates are smooth but for choices by `simd.where_less`. If it has tangent vectors, derivatives by
        them are left out.

    Returns
    -------
    Linearised

    Raises
    ------
    GraphError
        If the functions do more than arithmetic with functions of `simd` and `vecmath`.
    """
    traced = _traced(system)
    return traced.linearised(traced.rates, "y, t, c")


@cache
def curved(system: System) -> tuple[Linearised, Linearised]:
    """Derive the derivatives of J v, with the Jacobian J of a system's rates and a vector v, and of the trace of J.

    The function of the first has the arguments ``(y, v, t, c)``. The trace has one row.
    """
    traced = _traced(system)
    of_vector = traced.linearised(traced.along_vector(), "y, v, t, c")
    return of_vector, traced.linearised((traced.trace(),), "y, t, c")


def _called_plain(function: Callable[..., Any], *args: Any) -> Any:
    try:
        return plain(function, _substitutes())(*args)
    except (TypeError, AttributeError, NotImplementedError) as error:
        raise GraphError(f"they do more than arithmetic ({error})") from error


def implicit_problem(system: System) -> str | None:
    """Return why a system cannot be integrated by an implicit method, as a sentence; None if it can."""
    n = (system.tangents_of or system).n_states
    if n > MAX_STATES:
        return f"{system.name} has {n} states; rodas5p solves linear systems of at most {MAX_STATES}; choose dopri5."
    try:
        linearised(system)
    except GraphError as error:
        return f"rodas5p needs derivatives of the equations of {system.name}: {error}; or choose dopri5."
    return None


def check_implicit(system: System) -> None:
    """Raise `ValueError` for a system of an implicit method that cannot be integrated by it."""
    if system.is_stiff and (problem := implicit_problem(system)):
        raise ValueError(problem)


def _nodes(graph: Graph, values: Sequence[Any]) -> tuple[Node, ...]:
    return tuple(value.node if isinstance(value, Symbol) else graph.number(float(value)) for value in values)
