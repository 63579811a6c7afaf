"""Derive the expressions for the engine's functions from the definition of a model given as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from magpend_core.expressions.derivatives import derivatives
from magpend_core.expressions.graph import CONSTANT, STATED, TIMED, Graph, Node, in_order
from magpend_core.models.parameters import POSITIVE
from magpend_core.models.text.contacts import Jump, along, with_contacts
from magpend_core.models.text.definition import Definition
from magpend_core.models.text.grammar import TIMED as TIMED_NAMES
from magpend_core.models.text.grammar import Tree
from magpend_core.models.text.layers import GENERIC, Steep, core_of, place_of, steep_places
from magpend_core.models.text.numeric import node_values
from magpend_core.models.text.sliding import Sliding, sliding_of
from magpend_core.models.text.switching import Instant, Sides, Switch
from magpend_core.sizes import MAX_STATES

NARROW = 0.1
"""A corner in a layer narrower than this, in units of the state's scale, is left to the layer."""
SCANNED = 256
"""Instants of a period at which the sign of an expression is looked at."""


@dataclass(frozen=True)
class Layer:
    """Expressions that `System.layers` returns for one boundary layer (a narrow region where the right-hand side
    changes quickly).
    """

    value: Node
    rate: Node
    half_width: Node
    per_strength: Node
    steep: Steep


@dataclass(frozen=True)
class Wave:
    """Forcing edges at the zeros of a smooth function of time, which has `count` zeros per drive period."""

    value: Node
    slope: Node
    distance: Node
    jump: Node
    count: int
    steep: Steep


@dataclass(frozen=True)
class Derived:
    """Expressions derived from a model given as text: rates, Jacobian, boundary layers, edges, switches, impacts.

    Attributes
    ----------
    rates : tuple of Node
        Time derivative of each state.
    jacobian : tuple of Node
        Derivatives of the rates by the states, row by row; none of more than `sizes.MAX_STATES` states.
    forcing : Node or None
        The one number by which time enters `rates` and `jacobian`; the time itself if there is no other, None
        if there is none.
    instants : tuple of Instant
        At which something jumps in time; before those of `waves` among the edges.
    sliding : Sliding
        Value and rate of each switch, and which of them slide.
    sticks : tuple of int
        See `System.sticks`.
    missed : tuple of str
        Steep places on which steps do not end and which limit none, for people.
    surface : tuple of Node
        Value and rate of the function whose level is the Poincare section; empty for none.
    """

    graph: Graph
    rates: tuple[Node, ...]
    jacobian: tuple[Node, ...]
    quantities: tuple[Node, ...]
    forcing: Node | None
    layers: tuple[Layer, ...]
    waves: tuple[Wave, ...]
    instants: tuple[Instant, ...]
    switches: tuple[Switch, ...]
    sliding: Sliding
    impacts: tuple[Jump, ...]
    sticks: tuple[int, ...]
    missed: tuple[str, ...]
    surface: tuple[Node, ...] = ()

    @property
    def timed_layers(self) -> bool:
        """Whether the boundary layers depend on time."""
        nodes = [n for la in self.layers for n in (la.value, la.rate, la.half_width, la.per_strength)]
        return any(n.op == "time" for n in in_order(nodes))

    @property
    def n_edges(self) -> int:
        """Number of edges (instants at which the forcing changes quickly) in a drive period."""
        return len(self.instants) + sum(w.count for w in self.waves)


def derive(definition: Definition) -> Derived:
    """Derive rates, Jacobian, boundary layers, edges, switches and impacts of a model given as text.

    Raises
    ------
    GraphError
        If the equations are too large.
    """
    builder = Builder(definition)
    if definition.is_map:
        return _of_map(builder)
    graph = builder.graph
    scales = tuple(s.scale for s in definition.states)
    presets = [builder.leaf_values(p.values) for p in definition.presets]
    plain = tuple(builder.node(tree) for tree in definition.equations.values())
    sides = Sides(graph, _smoothed(graph, plain, scales, presets[0]))
    if "phase" in definition.used(definition.equations.values()) and _breaks(graph, plain, presets):
        sides.break_at_start()
    smooth = tuple(sides.rewritten(plain))
    drive = builder.names.get(DRIVE)
    sliding = sliding_of(graph, smooth, sides.switches)
    free = tuple(sliding.lowered(smooth))
    jumps = [_jump(builder, sides, sliding, i) for i in range(len(definition.impacts))]
    rates, jumps, sticks = with_contacts(graph, free, jumps, [i.stick for i in definition.impacts])
    jacobian = _jacobian(graph, rates)
    own = sides.rewritten([builder.node(tree) for tree in definition.quantities.values()], more=False)
    steep = steep_places(graph, smooth, scales)
    layers = [_layer(graph, s, sliding) for s in steep if _is_layer(s)]
    waves = [_wave(graph, s, presets) for s in steep if s.value.kind == TIMED]
    late = [s.form for s in steep if s.value.kind != TIMED and not _is_layer(s)]
    preferred = None if drive is None else sliding.lowered(sides.rewritten([drive], more=False))[0]
    return Derived(
        graph,
        rates,
        jacobian,
        tuple(sliding.lowered(own)),
        forcing_of(graph, (*rates, *jacobian), preferred),
        tuple(layers),
        tuple(w for w in waves if w.count),
        tuple(sides.instants),
        tuple(sides.switches),
        sliding,
        tuple(jumps),
        sticks,
        (*(f"{form} beside a jump in time" for form in late), *(["square"] * len(sides.left))),
        _surface(builder, sides, sliding),
    )


def _jacobian(graph: Graph, rates: tuple[Node, ...]) -> tuple[Node, ...]:
    """Return the derivatives of rates by the states, row by row; none of a system too large for tangents."""
    n = len(rates)
    if n > MAX_STATES:
        return ()
    columns = [derivatives(graph, rates, {graph.leaf("state", i): graph.one}) for i in range(n)]
    return tuple(columns[j][i] for i in range(n) for j in range(n))


def _of_map(builder: Builder) -> Derived:
    """Derive the Jacobian of a map. Corners and jumps stay as they are: no step of a map goes across them."""
    graph, own = builder.graph, builder.definition
    images = tuple(builder.node(tree) for tree in own.equations.values())
    jacobian = _jacobian(graph, images)
    quantities = tuple(builder.node(tree) for tree in own.quantities.values())
    sliding = sliding_of(graph, images, ())
    return Derived(graph, images, jacobian, quantities, None, (), (), (), (), sliding, (), (), ())


def _breaks(graph: Graph, rates: tuple[Node, ...], presets: Sequence[Mapping[int, float]]) -> bool:
    """Return whether the rates at one sample state differ between the start and the end of a drive period."""
    leaves = [n for n in in_order(rates) if n.op == "state"]
    states = {n.number: GENERIC[int(n.value) % len(GENERIC)] for n in leaves}
    time = graph.leaf("time").number
    for values in presets:
        ends = [np.array(node_values(rates, {**values, **states, time: t})) for t in (0.0, 1.0)]
        if (np.abs(ends[1] - ends[0]) > 1e-9 * np.abs(ends[0]).max()).any():
            return True
    return False


def _smoothed(
    graph: Graph, rates: tuple[Node, ...], scales: tuple[float, ...], values: Mapping[int, float]
) -> frozenset[int]:
    """Return the graph node numbers of ``abs`` corners inside a narrow boundary layer, where steps are short anyway."""
    cores = set()
    for node in in_order(rates):
        place = place_of(graph, node)
        if place is not None and place.argument.kind == STATED:
            factor, core = core_of(graph, place.argument)
            (width,) = node_values([graph.div(place.distance, factor)], values)
            states = [scales[int(n.value)] for n in in_order([core]) if n.op == "state"]
            if abs(width) < NARROW * min(states, default=1.0):
                cores.add(core)
    corners = [n for n in in_order(rates) if n.op == "absolute"]
    return frozenset(n.number for n in corners if core_of(graph, n.args[0])[1] in cores)


def _is_layer(steep: Steep) -> bool:
    """Return whether a steep function makes a boundary layer: it depends on the state, and on no sign that changes with
    time alone.
    """
    return steep.value.kind == STATED and not any(n.op == "clock" for n in in_order([steep.value]))


def _layer(graph: Graph, steep: Steep, sliding: Sliding) -> Layer:
    (value,) = sliding.lowered([steep.value])
    (rate,) = along(graph, (value,))
    strength = graph.mul(steep.half_width, graph.call("maximum", steep.jump, graph.number(1e-30)))
    (lowered,) = sliding.lowered([graph.div(graph.one, strength)])
    return Layer(value, rate, steep.half_width, lowered, steep)


def _wave(graph: Graph, steep: Steep, presets: Sequence[Mapping[int, float]]) -> Wave:
    (slope,) = derivatives(graph, (steep.value,), {graph.leaf("time"): graph.one})
    count = max(_zeros(graph, steep.value, values) for values in presets)
    return Wave(steep.value, slope, steep.half_width, steep.jump, count, steep)


def _zeros(graph: Graph, node: Node, values: Mapping[int, float]) -> int:
    """Return how often an expression of time changes its sign in a period of 1 s."""
    times = (np.arange(SCANNED + 1) - 0.37) / SCANNED
    (found,) = node_values([node], {**values, graph.leaf("time").number: times})
    return int(np.count_nonzero(np.diff(np.sign(np.broadcast_to(found, times.shape))) != 0.0))


def _jump(builder: Builder, sides: Sides, sliding: Sliding, k: int) -> Jump:
    impact = builder.definition.impacts[k]
    graph = builder.graph
    trees = [impact.of, *impact.set.values()]
    value, *changed = sliding.lowered(sides.rewritten([builder.node(tree) for tree in trees], more=False))
    (rate,) = along(graph, (value,))
    new = dict(zip(impact.set, changed, strict=True))
    states = [new.get(s.name, graph.leaf("state", i)) for i, s in enumerate(builder.definition.states)]
    return Jump(value, rate, impact.direction, tuple(states))


def _surface(builder: Builder, sides: Sides, sliding: Sliding) -> tuple[Node, ...]:
    tree = builder.definition.surface
    if tree is None:
        return ()
    (value,) = sliding.lowered(sides.rewritten([builder.node(tree)], more=False))
    return value, *along(builder.graph, (value,))


DRIVE = "drive"
"""A definition of this name is what a recording replaces, if time enters by it alone."""


MOST_LOOKED_AT = 100
"""Parts that are looked at before the forcing is the time itself."""


def forcing_of(graph: Graph, roots: tuple[Node, ...], preferred: Node | None) -> Node | None:
    """Return the largest state-free expression that contains every occurrence of time; None if time does not occur."""
    if preferred is not None and preferred.kind == TIMED and not _reaches_time(roots, preferred):
        return preferred
    order = in_order(roots)
    timed = [n for n in order if n.kind != CONSTANT and n.kind != STATED]
    if not timed:
        return None
    largest_first = (n for n in timed[: -MOST_LOOKED_AT - 1 : -1] if not _reaches_time(roots, n))
    found = next(largest_first, graph.leaf("time"))
    (slope,) = derivatives(graph, (found,), {graph.leaf("time"): graph.one})
    # what grows for ever has no period, but the rates that it enters have
    steady = slope.kind == CONSTANT and not slope.is_number(0.0)
    return graph.leaf("time") if steady else found


def _reaches_time(roots: tuple[Node, ...], without: Node) -> bool:
    pending, seen = list(roots), {without.number}
    while pending:
        node = pending.pop()
        if node.number in seen or node.kind == CONSTANT:
            continue
        if node.op == "time":
            return True
        seen.add(node.number)
        pending += node.args
    return False


class Builder:
    """Builder of a model's expression graph from parsed expressions; each definition becomes one node."""

    def __init__(self, definition: Definition) -> None:
        self.definition = definition
        self.graph = graph = Graph()
        time, frequency = graph.leaf("time"), graph.leaf("frequency")
        phase = graph.mul(time, frequency)
        self.names = {"pi": graph.number(math.pi)}
        self.names |= {
            k: v for k, v in zip(TIMED_NAMES, (time, frequency, phase), strict=True) if k in definition.timed
        }
        for i, state in enumerate(definition.states):
            self.names[state.name] = graph.leaf("state", i)
        for i, parameter in enumerate(definition.parameters):
            self.names[parameter.name] = graph.leaf("parameter", i)
        graph.positive = frozenset(i for i, p in enumerate(definition.parameters) if p.bound == POSITIVE)

    def leaf_values(self, parameters: Mapping[str, float]) -> dict[int, float]:
        """Return parameter values by graph node number, with a drive frequency of 1 Hz."""
        own = {self.names[name].number: value for name, value in parameters.items()}
        return {**own, self.graph.leaf("frequency").number: 1.0}

    def node(self, tree: Tree) -> Node:
        """Return the graph node of a parsed expression; first add the definitions used in it."""
        for name in self.definition.used([tree]):
            if name not in self.names:
                node = self._node(self.definition.define[name])
                # held together, or factors would join those of the sums and products that it enters
                holds = name == DRIVE and node.kind == TIMED
                self.names[name] = self.graph.node("held", node) if holds else node
        return self._node(tree)

    def _node(self, tree: Tree) -> Node:
        g = self.graph
        if tree.kind == "number":
            return g.number(float(tree.value))
        if tree.kind == "name":
            return self.names[str(tree.value)]
        if tree.kind == "product":
            return self._product(tree)
        if tree.kind == "call":
            return self._call(tree)
        args = [self._node(arg) for arg in tree.args]
        if tree.kind == "sum":
            return g.add(*args)
        return g.neg(args[0]) if tree.kind == "negative" else g.power(*args)

    def _product(self, tree: Tree) -> Node:
        g = self.graph
        above = [self._node(a) for a in tree.args if a.kind != "inverse"]
        below = [self._node(a.args[0]) for a in tree.args if a.kind == "inverse"]
        top = g.mul(*above) if above else g.one
        return g.div(top, g.mul(*below)) if below else top

    def _call(self, tree: Tree) -> Node:
        g, name = self.graph, str(tree.value)
        if name == "where":
            return self._where(tree.args[0], self._node(tree.args[1]), self._node(tree.args[2]))
        args = [self._node(arg) for arg in tree.args]
        if name in ("min", "max"):
            found = args[0]
            for other in args[1:]:
                found = g.call(f"{name}imum", found, other)
            return found
        return _BUILT[name](g, *args) if name in _BUILT else g.call(name, *args)

    def _where(self, condition: Tree, yes: Node, no: Node) -> Node:
        g = self.graph
        if condition.kind == "not":
            return self._where(condition.args[0], no, yes)
        if condition.kind == "and":
            for part in reversed(condition.args):
                yes = self._where(part, yes, no)
            return yes
        if condition.kind == "or":
            for part in reversed(condition.args):
                no = self._where(part, yes, no)
            return no
        a, b = (self._node(arg) for arg in condition.args)
        if condition.value == "<":
            return g.where_less(a, b, yes, no)
        if condition.value == ">":
            return g.where_less(b, a, yes, no)
        # a <= b is not (b < a)
        return g.where_less(b, a, no, yes) if condition.value == "<=" else g.where_less(a, b, no, yes)


def _mod(g: Graph, x: Node, y: Node) -> Node:
    """Return x - y floor(x/y); division by 1/f is multiplication by f, so that jumps in time have known instants."""
    is_inverse = y.op == "div" and y.args[0].is_number(1.0)
    return g.sub(x, g.mul(y, g.call("floor", g.mul(x, y.args[1]) if is_inverse else g.div(x, y))))


_BUILT: dict[str, Callable[..., Node]] = {
    "abs": lambda g, x: g.call("absolute", x),
    "ceil": lambda g, x: g.neg(g.call("floor", g.neg(x))),
    "heaviside": lambda g, x: g.where_less(x, g.zero, g.zero, g.one),
    "log10": lambda g, x: g.div(g.call("log", x), g.number(math.log(10.0))),
    "mod": _mod,
}
"""Nodes of functions that the graph has under another name, or writes with others."""
