"""Derive sliding motion on switching surfaces, with Filippov's equivalent control in place of the sign of the side.

Where the motions on both sides point to the surface, the state stays on it. The sign s of the side is then replaced by
a number sigma in [-1, 1] such that the surface's function stays 0. Its time derivative r(s) is linear in s, so sigma
solves r(sigma) = 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from magpend_core.expressions.derivatives import derivatives
from magpend_core.expressions.graph import STATED, Graph, Node, in_order, made_again, substituted
from magpend_core.models.text.switching import Switch

_NO_DIFFERENCE = 1e-300
"""What a side makes less of than this counts as none."""

MAX_JOINT = 3
"""Most surfaces on which a state slides at once, each of which the others' sides act on."""


@dataclass(frozen=True)
class Sliding:
    """Sliding motion as expressions: for each switching surface, the expression that replaces the sign of its side.

    Attributes
    ----------
    graph : Graph
        Expression graph of the model.
    effective : dict
        Expression that replaces the sign of each side, by the leaf of the sign.
    slides : tuple of bool
        On which switches the state can slide.
    pairs : tuple of (Node, Node)
        Value and rate of each switch, as `System.switches` returns them.
    """

    graph: Graph
    effective: Mapping[Node, Node]
    slides: tuple[bool, ...]
    pairs: tuple[tuple[Node, Node], ...]

    def lowered(self, roots: Iterable[Node]) -> list[Node]:
        """Replace the sign of each switching surface in expressions: by the mode of its switch or, during sliding, by
        the equivalent control.
        """
        return _spelled(self.graph, substituted(self.graph, list(roots), self.effective))


def sliding_of(graph: Graph, rates: Sequence[Node], switches: Sequence[Switch]) -> Sliding:
    """Find the switching surfaces on which a state can slide, and the equivalent control on each.

    Parameters
    ----------
    graph
        Expression graph of the model.
    rates
        Time derivatives of the states, written with the signs of the sides.
    switches
        All switching surfaces of the model.
    """
    speeds = [_speed(graph, s.value, rates) for s in switches]
    # these rates are used only on the surface of the switch, where its mode is 0
    speeds = [substituted(graph, [v], {s.mode: graph.zero})[0] for v, s in zip(speeds, switches, strict=True)]
    pulls = [[_pull(graph, speed, s.side) for s in switches] for speed in speeds]
    slides = [s.jumps and not pulls[k][k].is_number(0.0) for k, s in enumerate(switches)]
    modes = [s.mode for s in switches]
    sigma = _spelled(graph, _solved(graph, speeds, pulls, slides, switches, modes))
    effective = {s.side: _while_sliding(graph, modes[k], sigma[k], modes[k]) for k, s in enumerate(switches)}
    pairs = []
    for k, s in enumerate(switches):
        (value,) = _spelled(graph, substituted(graph, [s.value], effective))
        pair = value, _along(graph, value)
        if slides[k]:
            room = graph.sub(graph.one, graph.mul(sigma[k], sigma[k]))
            other = room, _along(graph, room)
            pair = tuple(  # type: ignore[assignment]
                _while_sliding(graph, modes[k], b, a) for a, b in zip(pair, other, strict=True)
            )
        pairs.append(pair)
    return Sliding(graph, effective, tuple(slides), tuple(pairs))


def _spelled(graph: Graph, roots: list[Node]) -> list[Node]:
    """Rewrite `choice` nodes of the expression graph as comparisons with 0; interpolate only where a sliding mode lies
    between -1 and 1.
    """
    known: dict[int, Node] = {}
    for node in in_order(roots):
        args = tuple(known[a.number] for a in node.args)
        if node.op == "choice":
            side, yes, no = args
            exact = side.kind != STATED or side.op == "mode_side"
            known[node.number] = _chosen(graph, side, yes, no, exact)
        else:
            same = all(a is b for a, b in zip(args, node.args, strict=True))
            known[node.number] = node if same else made_again(graph, node, args)
    return [known[root.number] for root in roots]


def _chosen(graph: Graph, side: Node, yes: Node, no: Node, exact: bool) -> Node:
    if exact:
        return graph.where_less(graph.zero, side, yes, no)
    share = graph.add(graph.number(0.5), graph.mul(graph.number(0.5), side))
    between = graph.add(no, graph.mul(share, graph.sub(yes, no)))
    upper = graph.where_less(side, graph.one, between, yes)
    return graph.where_less(graph.number(-1.0), side, upper, no)


def _while_sliding(graph: Graph, mode: Node, sliding: Node, else_: Node) -> Node:
    return graph.where_less(graph.call("absolute", mode), graph.number(0.5), sliding, else_)


def _speed(graph: Graph, value: Node, rates: Sequence[Node]) -> Node:
    """Return the time derivative of an expression along the motion."""
    seeds = {n: rates[int(n.value)] for n in in_order([value]) if n.op == "state"}
    (found,) = derivatives(graph, (value,), {**seeds, graph.leaf("time"): graph.one})
    return found


def _along(graph: Graph, value: Node) -> Node:
    """Return the time derivative of an expression, in terms of symbols for the states' time derivatives."""
    seeds = {n: graph.leaf("rate", int(n.value)) for n in in_order([value]) if n.op == "state"}
    (found,) = derivatives(graph, (value,), {**seeds, graph.leaf("time"): graph.one})
    return found


def _pull(graph: Graph, speed: Node, side: Node) -> Node:
    """Return half the jump of `speed` (time derivative of a surface function) between the two sides of a surface."""
    (slope,) = derivatives(graph, (speed,), {side: graph.one})
    if side not in in_order([slope]):
        return slope
    above, below = (substituted(graph, [speed], {side: graph.number(s)})[0] for s in (1.0, -1.0))
    return graph.mul(graph.number(0.5), graph.sub(above, below))


def _solved(
    graph: Graph,
    speeds: Sequence[Node],
    pulls: Sequence[Sequence[Node]],
    slides: Sequence[bool],
    switches: Sequence[Switch],
    modes: Sequence[Node],
) -> list[Node]:
    """Return the equivalent control on each switching surface, or the mode of the switch where no state can slide."""
    zeros = {s.side: graph.zero for s in switches}
    found = []
    for k in range(len(switches)):
        if not slides[k]:
            found.append(modes[k])
            continue
        (rest,) = substituted(graph, [speeds[k]], zeros)
        joint = [j for j in range(len(switches)) if j != k and not pulls[k][j].is_number(0.0)]
        for j in joint:
            (pull,) = substituted(graph, [pulls[k][j]], zeros)
            rest = graph.add(rest, graph.mul(pull, modes[j]))
        partner = [j for j in joint if slides[j] and not pulls[j][k].is_number(0.0)]
        if partner and len(partner) < MAX_JOINT:
            found.append(_joint(graph, k, partner[0], speeds, pulls, modes, zeros))
            continue
        (own,) = substituted(graph, [pulls[k][k]], zeros)
        found.append(graph.neg(_quotient(graph, rest, own)))
    return found


def _quotient(graph: Graph, top: Node, bottom: Node) -> Node:
    """Return a quotient whose divisor is replaced by 1 where it is 0.

    Where that is 0, as of friction without a coefficient, no state stays on the surface: any number will do.
    """
    makes_none = graph.call("absolute", bottom), graph.number(_NO_DIFFERENCE)
    return graph.div(top, graph.where_less(*makes_none, graph.one, bottom))


def _joint(
    graph: Graph,
    k: int,
    j: int,
    speeds: Sequence[Node],
    pulls: Sequence[Sequence[Node]],
    modes: Sequence[Node],
    zeros: Mapping[Node, Node],
) -> Node:
    """Return the equivalent control of surface k while the state may also slide on surface j, from two linear
    equations.
    """
    rest_k, rest_j, kk, kj, jk, jj = substituted(
        graph, [speeds[k], speeds[j], pulls[k][k], pulls[k][j], pulls[j][k], pulls[j][j]], zeros
    )
    alone = graph.neg(_quotient(graph, graph.add(rest_k, graph.mul(kj, modes[j])), kk))
    both = _quotient(
        graph, graph.sub(graph.mul(kj, rest_j), graph.mul(jj, rest_k)), graph.sub(graph.mul(kk, jj), graph.mul(kj, jk))
    )
    return _while_sliding(graph, modes[j], both, alone)
