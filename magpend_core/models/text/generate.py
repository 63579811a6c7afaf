"""Generate Python source for the engine's functions from derived expressions.

No name and no character of a model's text stands in it: states, parameters and constants are numbered.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from magpend_core.expressions.graph import CONSTANT, STATED, Node, in_order
from magpend_core.expressions.writer import Writer
from magpend_core.models.text.derive import Derived
from magpend_core.sizes import WRITTEN_OUT


def constants_of(roots: Iterable[Node]) -> list[Node]:
    """Return the largest subexpressions without time and state; they are computed once per trajectory."""
    roots = list(roots)
    found = {root.number: root for root in roots if root.kind == CONSTANT}
    for node in in_order(roots):
        if node.kind != CONSTANT:
            found.update({a.number: a for a in node.args if a.kind == CONSTANT})
    return [node for _, node in sorted(found.items()) if node.op != "number"]


@dataclass(frozen=True)
class Source:
    """Generated source of a system's functions, with the number of constants, modes and edges in it.

    Attributes
    ----------
    text : str
        Python source.
    n_constants, n_modes, n_edges : int
        Number of constants, modes and edges.
    jacobian_entries : tuple of int or None
        See `System.jacobian_entries`.
    """

    text: str
    n_constants: int
    n_modes: int
    n_edges: int
    jacobian_entries: tuple[int, ...] | None = None


def source_of(derived: Derived) -> Source:
    """Generate the source of all functions of a system."""
    forcing = () if derived.forcing is None else (derived.forcing,)
    layers = [node for la in derived.layers for node in (la.value, la.rate, la.half_width, la.per_strength)]
    switches = [node for pair in derived.sliding.pairs for node in pair]
    impacts = [node for jump in derived.impacts for node in (jump.value, jump.rate)]
    resets = [node for jump in derived.impacts for node in (*jump.states, *jump.at_rest)]
    roots = (*derived.rates, *derived.jacobian, *derived.quantities, *forcing, *layers, *switches, *impacts, *resets)
    constants = constants_of((*roots, *derived.surface))
    n_contacts = len(derived.sticks) if any(derived.sticks) else 0
    n_constants = max(1, len(constants))
    n_modes = len(derived.switches) + n_contacts + bool(derived.instants)
    leaves = _leaves(derived, constants, n_constants, n_modes)
    timed = leaves | {n.number: "t" for n in derived.graph.nodes if n.op == "time"}
    behind = dict.fromkeys((n for n, name in timed.items() if name == "t"), f"dy[{len(derived.rates)}]")
    driven = leaves if derived.forcing is None else leaves | {derived.forcing.number: "u"}
    entries = _entries(derived)
    jacobian = derived.jacobian if entries is None else [derived.jacobian[i] for i in entries]
    parts = [
        *_edges(derived),
        _constants(constants),
        _forcing(derived.forcing, timed),
        _tuple("rhs", "y, u, c", derived.rates, driven),
        _tuple("jacobian", "y, u, c", jacobian, driven),
        _tuple("quantities", "t, y, dy, u, c", derived.quantities, timed | driven),
        _tuple("layers", "y, dy, c", layers, leaves | behind, 4),
        _tuple("switches", "t, y, dy, c", switches, timed, 2),
        _tuple("impacts", "t, y, dy, c", impacts, timed, 2),
        _reset(derived, timed),
    ]
    if derived.surface:
        parts.append(_tuple("surface", "t, y, dy, c", derived.surface, timed, 2))
    return Source("\n\n".join(parts) + "\n", n_constants, n_modes, derived.n_edges, entries)


def _entries(derived: Derived) -> tuple[int, ...] | None:
    """Return the positions of the entries of a large Jacobian that are not always 0; None for a small Jacobian."""
    if len(derived.rates) <= WRITTEN_OUT or not derived.jacobian:
        return None
    found = tuple(i for i, node in enumerate(derived.jacobian) if not node.is_number(0.0))
    return found or (0,)


def _leaves(derived: Derived, constants: list[Node], n_constants: int, n_modes: int) -> dict[int, str]:
    names = {node.number: f"c[{i}]" for i, node in enumerate(constants)}
    for node in derived.graph.nodes:
        if node.op in ("state", "rate"):
            names[node.number] = f"{'y' if node.op == 'state' else 'dy'}[{int(node.value)}]"
        if node.op in ("mode_side", "mode_clock"):
            names[node.number] = f"c[{n_constants + int(node.value)}]"
        if node.op == "mode_contact":
            names[node.number] = f"c[{n_constants + len(derived.switches) + int(node.value)}]"
        if node.op == "segment":
            names[node.number] = f"c[{n_constants + n_modes - 1}]"
    return names


def _cell(roots: Iterable[Node]) -> dict[int, str]:
    """Return how generated code writes each parameter, the frequency, the time and the rank of a forcing edge, by graph
    node number.
    """
    names = {}
    for node in in_order(roots):
        if node.op == "parameter":
            names[node.number] = f"p[{int(node.value)}]"
        if node.op == "frequency":
            names[node.number] = "frequency"
        if node.op == "time":
            names[node.number] = "t"
        if node.op == "rank":
            names[node.number] = f"(rank(at, {int(node.value)}) + 1.0)"
    return names


def _function(name: str, arguments: str, lines: list[str]) -> str:
    return "\n    ".join((f"def {name}({arguments}):", *lines))


def _constants(constants: list[Node]) -> str:
    writer = Writer(_cell(constants))
    names = writer.write(constants)
    lines = [f"out[{i}] = {name}" for i, name in enumerate(names)] or ["out[0] = 0.0"]
    ranked = any(n.op == "rank" for n in in_order(constants))
    first = ["at = instants(frequency, p)"] if ranked else []
    return _function("constants", "frequency, p, out", [*first, *writer.lines, *lines])


def _scalar(name: str, arguments: str, roots: list[Node]) -> str:
    """Return source code of a function of plain numbers (frequency, parameters, time) that computes expressions."""
    writer = Writer(_cell(roots))
    names = [f"{name} + 0.0" for name in writer.write(roots)]
    return _function(name, arguments, [*writer.lines, f"return {', '.join(names)}" + "," * (len(names) > 1)])


def _edges(derived: Derived) -> list[str]:
    """Return source code of the functions that compute the times, half-widths and jumps of the forcing's edges in a
    period.
    """
    n_instants, parts, names = len(derived.instants), [], []
    for i, instant in enumerate(derived.instants):
        parts.append(_scalar(f"instant{i}", "frequency, p", [instant.time]))
        names.append(f"within(instant{i}(frequency, p), period)")
    widths, jumps = ["math_inf"] * n_instants, ["1.0"] * n_instants
    for i, wave in enumerate(derived.waves):
        parts.append(_scalar(f"wave{i}", "t, frequency, p", [wave.value]))
        parts.append(_scalar(f"slope{i}", "t, frequency, p", [wave.slope]))
        parts.append(_scalar(f"strength{i}", "frequency, p", [wave.distance, wave.jump]))
        parts.append(_ZERO.format(i=i))
        for k in range(wave.count):
            names.append(f"zero{i}(frequency, p, {k})")
            slope = f"max(abs(slope{i}(at[{len(names) - 1}], frequency, p)), 1e-300)"
            widths.append(f"max(strength{i}(frequency, p)[0] / {slope}, 1e-300)")
            jumps.append(f"strength{i}(frequency, p)[1]")
    if not names:
        return []
    lines = ["period = 1.0 / frequency", f"return ({', '.join(names)},)"]
    parts.append(_function("instants", "frequency, p", lines))
    lines = ["at = instants(frequency, p)", "set_times(at, 1.0 / frequency, times)"]
    for i, (width, jump) in enumerate(zip(widths, jumps, strict=True)):
        lines += [f"half_widths[rank(at, {i})] = {width}", f"jumps[rank(at, {i})] = {jump}"]
    parts.append(_function("edges", "frequency, p, times, half_widths, jumps", lines))
    return parts


# bisected between instants that do not lie symmetrically about 0, where drives like to begin
_ZERO = """def zero{i}(frequency, p, k):
    period = 1.0 / frequency
    step = period / 256.0
    found = 0
    for j in range(256):
        low = (j - 0.37) * step
        high = low + step
        below = wave{i}(low, frequency, p)
        if below * wave{i}(high, frequency, p) < 0.0 or below == 0.0:
            if found == k:
                for _ in range(60):
                    middle = 0.5 * (low + high)
                    if below * wave{i}(middle, frequency, p) > 0.0:
                        low = middle
                    else:
                        high = middle
                time = 0.5 * (low + high)
                return within(time + period if time < 0.0 else time, period)
            found += 1
    return period * (1.0 - 1e-6 * (k + 1))"""


def _forcing(forcing: Node | None, leaves: Mapping[int, str]) -> str:
    if forcing is None or forcing.op == "time":
        return _function("forcing", "t, c", [f"return {0.0 if forcing is None else 1.0} * t"])
    writer = Writer(leaves)
    if forcing.op == "held":
        forcing = forcing.args[0]
    sign, inner = ("-", forcing.args[0]) if forcing.op == "neg" else ("", forcing)
    if inner.op == "mul":  # no bare product: where it is added to another, either could be fused
        a, b = writer.write(inner.args)
        value = f"multiply_add({sign}{a}, {b}, 0.0)"
    else:
        (value,) = writer.write((forcing,))
    return _function("forcing", "t, c", [*writer.lines, f"return {value}"])


def _tuple(name: str, arguments: str, roots: Iterable[Node], leaves: Mapping[int, str], group: int = 0) -> str:
    """Return source code of a function that returns the values of expressions as a tuple, or as a tuple of tuples of
    length `group`.
    """
    roots = list(roots)
    writer = Writer(leaves)
    values = writer.write(roots)
    results = []
    for root, value in zip(roots, values, strict=True):
        if root.is_number(0.0):
            results.append("zero")
        else:  # a number per lane, whatever it depends on
            results.append(value if root.kind == STATED else f"zero + {value}")
    if group:
        results = [f"({', '.join(results[i : i + group])})" for i in range(0, len(results), group)]
    lines = [*writer.lines, "zero = 0.0 * y[0]"]
    return _function(name, arguments, [*lines, f"return ({', '.join(results)}{',' if results else ''})"])


def _reset(derived: Derived, leaves: Mapping[int, str]) -> str:
    lines = ["zero = 0.0 * y[0]"]
    n = len(derived.impacts)
    maps = {k: jump.states for k, jump in enumerate(derived.impacts)}
    maps |= {n + k: jump.at_rest for k, jump in enumerate(derived.impacts) if jump.at_rest}
    for k, states in maps.items():
        writer = Writer(leaves)
        values = [f"zero + {value}" for value in writer.write(states)]
        lines.append(f"if k == {k}:")
        lines += [f"    {line}" for line in (*writer.lines, f"return ({', '.join(values)},)")]
    same = ", ".join(f"zero + y[{i}]" for i in range(len(derived.rates)))
    return _function("reset", "k, t, y, c", [*lines, f"return ({same},)"])
