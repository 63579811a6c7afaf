"""Find corners and jumps of a model's equations: ``sign``, ``abs``, ``min``, ``max``, ``where``, ``square``, ``floor``.

Each is smooth between the places at which an expression passes zero, so it is written with the *side* on
which that expression is: +1 or -1, a number that changes at these places alone and is the same throughout a
step. Places in time alone whose instants can be told beforehand become edges; all others become switches, on
which the engine ends a step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from magpend_core.expressions.derivatives import derivatives
from magpend_core.expressions.graph import (
    CONSTANT,
    STATED,
    TIMED,
    Graph,
    GraphError,
    Node,
    in_order,
    made_again,
    substituted,
)
from magpend_core.models.text.layers import keeps_sign

CORNERED = ("sign", "absolute", "minimum", "maximum", "less", "square", "floor")
"""Functions that are not smooth."""
MAX_SWITCHES, MAX_INSTANTS = 16, 64
MAX_WAVES = 16
"""Most periods of a square wave, and most whole numbers that ``floor`` passes, in one period of the drive."""


@dataclass
class Switch:
    """A switching surface, on which the equations have a corner or a jump.

    Attributes
    ----------
    value : Node
        Zero on the surface.
    side : Node
        The leaf that stands for its sign where something jumps.
    mode : Node
        The leaf that stands for its sign where slopes alone change: 0 on the surface.
    written : Node
        The value as the text has it, for people.
    jumps : bool
        Whether something jumps there.
    whole : bool
        Whether the surface is where `written` is a whole number, and not where it is 0.
    """

    value: Node
    side: Node
    mode: Node
    written: Node
    jumps: bool = False
    whole: bool = False


@dataclass
class Instant:
    """An instant of each drive period at which the right-hand side jumps.

    Attributes
    ----------
    time : Node
        In seconds since the section, in [0, 1/f]; changes with the cell alone.
    rank : Node
        The leaf that stands for its place among all instants of a period, from 1.
    """

    time: Node
    rank: Node


@dataclass
class Sides:
    """Rewriter of expressions: it replaces corners and jumps by signs of smooth expressions, and collects their zero
    surfaces.

    Attributes
    ----------
    smoothed : set of int
        Numbers of nodes that are not rewritten, since their corner lies in a steep layer.
    switches, instants : list
        Switching surfaces and instants found so far.
    left : list of Node
        Jumps in time for which neither a switch nor an instant was found: steps do not end on them.
    """

    graph: Graph
    smoothed: frozenset[int] = frozenset()
    switches: list[Switch] = field(default_factory=list)
    instants: list[Instant] = field(default_factory=list)
    left: list[Node] = field(default_factory=list)
    _known: dict[int, Node] = field(default_factory=dict)
    _surface: dict[int, Node] = field(default_factory=dict)

    def rewritten(self, roots: Iterable[Node], *, more: bool = True) -> list[Node]:
        """Return expressions in which corners and jumps are written with the signs of smooth expressions.

        Parameters
        ----------
        roots
            Expressions to rewrite.
        more
            Whether new switches and instants may be added; if not, corners and jumps not known yet stay unchanged.
        """
        roots = list(roots)
        known = self._known if more else dict(self._known)
        for node in in_order(roots):
            if node.number in known:
                continue
            args = tuple(known[a.number] for a in node.args)
            known[node.number] = self._smooth(node, args, more)
            self._surface[node.number] = self._as_surface(node, known[node.number])
        return [known[root.number] for root in roots]

    def _as_surface(self, node: Node, rewritten: Node) -> Node:
        """Return an expression in the form in which it may define a switching surface: without the modes of other
        switches.

        The engine sets the modes of an initial state one after the other, so no surface may depend on another's mode.
        """
        free = not any(n.op in ("clock", "mode_clock") for n in in_order([rewritten]))
        if node.kind == TIMED and free:
            return rewritten
        args = tuple(self._surface[a.number] for a in node.args)
        same = all(a is b for a, b in zip(args, node.args, strict=True))
        return node if same else made_again(self.graph, node, args)

    def _smooth(self, node: Node, args: tuple[Node, ...], more: bool) -> Node:
        """Rebuild a graph node with rewritten arguments; write a corner or jump with the sign of a
        switching surface.
        """
        g = self.graph
        same = all(a is b for a, b in zip(args, node.args, strict=True))
        plain = node if same else made_again(g, node, args)
        if node.op not in CORNERED or node.number in self.smoothed or plain.kind == CONSTANT:
            return plain
        if node.op == "square":
            return self._square(node, more) or plain
        if node.op == "floor":
            return self._floor(node, args[0], more) or plain
        if node.op in ("sign", "absolute"):
            surface = self._surface[node.args[0].number]
            side = self.side(surface, args[0], node.op == "sign", more, _plain(surface, node.args[0]))
            if side is None:
                return plain
            return side if node.op == "sign" else g.mul(side, args[0])
        yes, no = args[-2:] if node.op != "maximum" else args[::-1]
        a, b = (self._surface[arg.number] for arg in node.args[:2])
        if node.op == "less" and not _moves(g.sub(args[1], args[0])):
            return plain  # both depend on signs only, so they may stay equal for a while: no crossing to detect
        value, written = g.sub(b, a), g.sub(node.args[1], node.args[0])
        side = self.side(value, g.sub(args[1], args[0]), node.op == "less", more, _plain(value, written))
        return plain if side is None else g.choice(side, yes, no)

    def side(
        self,
        value: Node,
        rewritten: Node,
        jumps: bool,
        more: bool = True,
        written: Node | None = None,
        whole: bool = False,
    ) -> Node | None:
        """Return a graph node for the sign of an expression, adding a switch if necessary; None if no switch can stand
        for the sign.
        """
        g = self.graph
        if value.op == "neg":
            inner = self.side(value.args[0], g.neg(rewritten), jumps, more, written, whole)
            return None if inner is None else g.neg(inner)
        if value.op == "mul" and value.args[0].op == "number":  # a positive factor, which does not change the sign
            return self.side(value.args[1], rewritten, jumps, more, written, whole)
        if keeps_sign(g, value):
            return g.one
        if not _moves(rewritten):  # depends on signs only, so it may be 0 for a while: no crossing to detect
            below = g.where_less(rewritten, g.zero, g.number(-1.0), g.zero)
            return g.where_less(g.zero, rewritten, g.one, below)
        for switch in self.switches:
            if switch.value is value:
                switch.jumps = switch.jumps or jumps
                return switch.side if jumps else switch.mode
        if not more or value.kind == CONSTANT:
            return None
        if value.kind == TIMED:
            found = self._in_time(value)
            if found is not None:
                return found
        if len(self.switches) == MAX_SWITCHES:
            raise GraphError(f"the equations have corners or jumps on more than {MAX_SWITCHES} surfaces")
        op, k = "side" if value.kind == STATED else "clock", len(self.switches)
        mode = g.leaf(f"mode_{op}", k)
        switch = Switch(value, g.leaf(op, k), mode, value if written is None else written, jumps, whole)
        self.switches.append(switch)
        return switch.side if jumps else switch.mode

    def _in_time(self, value: Node) -> Node | None:
        """Return the sign of a + b t (a, b constant) as a jump at a computed instant; None for any other expression."""
        g, time = self.graph, self.graph.leaf("time")
        if any(n.op in CORNERED or n.op == "segment" for n in in_order([value])):
            return None
        (slope,) = derivatives(g, (value,), {time: g.one})
        if slope.kind != CONSTANT or slope.is_number(0.0):
            return None
        offset = g.sub(value, g.mul(slope, time))
        if any(n.kind != CONSTANT for n in in_order([offset])):
            (offset,) = _at_time_zero(g, value)
        period = g.div(g.one, g.leaf("frequency"))
        self.break_at_start()
        zero = g.neg(g.div(offset, slope))
        after = g.call("sign", slope)
        middle = g.call("sign", g.add(offset, g.mul(g.number(0.5), slope, period)))

        def inside(yes: Node, no: Node) -> Node:
            return g.where_less(zero, g.zero, no, g.where_less(zero, period, yes, no))

        instant = self._instant(inside(zero, g.mul(g.number(0.5), period)))
        return self._after(instant, inside(g.neg(after), middle), inside(after, middle))

    def break_at_start(self) -> None:
        """Register time 0 of the drive period as an instant at which the right-hand side may jump."""
        self._instant(self.graph.zero)

    def _instant(self, time: Node) -> Instant:
        for known in self.instants:
            if known.time is time:
                return known
        if len(self.instants) == MAX_INSTANTS:
            raise GraphError(f"the equations have jumps at more than {MAX_INSTANTS} instants of a period")
        self.instants.append(Instant(time, self.graph.leaf("rank", len(self.instants))))
        return self.instants[-1]

    def _after(self, instant: Instant, before: Node, after: Node) -> Node:
        """Return an expression that equals `before` until a given instant of each drive period and `after` from then
        on.
        """
        g = self.graph
        return g.where_less(g.leaf("segment"), g.sub(instant.rank, g.number(0.5)), before, after)

    def _square(self, node: Node, more: bool) -> Node | None:
        """Return a square wave as jumps at computed instants; None unless its phase is n f t + a, n integer."""
        g = self.graph
        phase, duty = node.args
        (slope,) = derivatives(g, (phase,), {g.leaf("time"): g.one})
        (offset,) = _at_time_zero(g, phase)
        count = None if _jumps(phase) else _multiple_of(slope, g.leaf("frequency"))
        if not more or count is None or duty.kind != CONSTANT or offset.kind != CONSTANT:
            if more and node.kind != CONSTANT:
                self.left.append(node)
            return None
        rises: list[Instant] = []
        falls: list[Instant] = []
        for edges, shift in ((rises, g.zero), (falls, duty)):
            for j in range(count):
                turns = g.div(g.add(g.number(j), shift, g.neg(offset)), g.number(count))
                share = g.sub(turns, g.call("floor", turns))
                edges.append(self._instant(g.div(share, g.leaf("frequency"))))
        first_rise, first_fall = (self._first([e.rank for e in edges]) for edges in (rises, falls))
        wave = g.where_less(first_rise, first_fall, g.number(-1.0), g.one)
        steps = [self._after(e, g.zero, g.number(2.0)) for e in rises]
        steps += [self._after(e, g.zero, g.number(-2.0)) for e in falls]
        return g.node("add", wave, *steps)

    def _floor(self, node: Node, rewritten: Node, more: bool) -> Node | None:
        """Return a floor with the sign of sin(pi u), which changes where its argument u passes a whole number; jumps at
        computed instants if u is n f t + a, n integer. None if u varies by jumps alone.

        Each side is written such that it stays the same half a unit beyond the numbers where it ends.
        """
        g = self.graph
        if not _moves(rewritten):
            return None
        if node.kind == TIMED and more and (found := self._count(node)) is not None:
            return found
        surface = self._surface[node.args[0].number]
        value, own = (g.call("sin", g.mul(g.number(math.pi), u)) for u in (surface, rewritten))
        side = self.side(value, own, True, more, node.args[0], whole=True)
        if side is None:
            return None
        half, quarter = g.mul(g.number(0.5), rewritten), g.number(0.25)
        even, odd = (g.mul(g.number(2.0), g.call("floor", u)) for u in (g.add(half, quarter), g.sub(half, quarter)))
        return g.choice(side, even, g.add(odd, g.one))

    def _count(self, node: Node) -> Node | None:
        """Return a floor as jumps at computed instants; None unless its argument is n f t + a, n integer."""
        g, u = self.graph, node.args[0]
        (slope,) = derivatives(g, (u,), {g.leaf("time"): g.one})
        (offset,) = _at_time_zero(g, u)
        way = -1.0 if slope.op == "neg" else 1.0
        count = None if _jumps(u) else _multiple_of(g.mul(g.number(way), slope), g.leaf("frequency"))
        if count is None or offset.kind != CONSTANT:
            return None
        steps = []
        for instant in self._at_whole(g.mul(g.number(way), offset), count):
            steps.append(self._after(instant, g.zero, g.number(way)))
        # an instant this near to the end of the period counts as its begin, see `runtime.within`
        begin = g.call("floor", g.sub(offset, g.number(way * 1e-9 * count)))
        return g.node("add", begin, *steps)

    def _at_whole(self, offset: Node, count: int) -> list[Instant]:
        """Return the instants of a period at which count f t + offset is a whole number."""
        g, found = self.graph, []
        for j in range(count):
            turns = g.div(g.add(g.number(j), g.neg(offset)), g.number(count))
            share = g.sub(turns, g.call("floor", turns))
            found.append(self._instant(g.div(share, g.leaf("frequency"))))
        return found

    def _first(self, ranks: list[Node]) -> Node:
        found = ranks[0]
        for rank in ranks[1:]:
            found = self.graph.call("minimum", found, rank)
        return found


def _jumps(phase: Node) -> bool:
    """Return whether a phase has corners or jumps in time, so that its slope alone does not tell where it turns."""
    return any(n.op in CORNERED and n.kind != CONSTANT for n in in_order([phase]))


def _moves(rewritten: Node) -> bool:
    """Return whether an expression varies with state or time other than by jumps."""
    moves: dict[int, bool] = {}
    for node in in_order([rewritten]):
        if node.op in ("square", "sign", "floor"):
            moves[node.number] = False
        else:
            args = node.args[2:] if node.op == "less" else node.args
            moves[node.number] = node.op in ("state", "time") or any(moves[a.number] for a in args)
    return moves[rewritten.number]


def _plain(value: Node, written: Node) -> Node | None:
    """Return the user's form of an expression if it differs from that of the switching surface; else None."""
    return None if value is written else written


def _at_time_zero(graph: Graph, node: Node) -> list[Node]:
    return substituted(graph, [node], {graph.leaf("time"): graph.zero})


def _multiple_of(slope: Node, frequency: Node) -> int | None:
    if slope is frequency:
        return 1
    if slope.op == "mul" and slope.args[0].op == "number" and slope.args[1] is frequency:
        n = slope.args[0].value
        return int(n) if n == int(n) and 1 <= n <= MAX_WAVES else None
    return None
