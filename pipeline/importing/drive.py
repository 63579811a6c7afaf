"""Find the periodic drive in equations that depend on time, and write it with the drive's angular frequency omega."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from fractions import Fraction
from math import gcd, lcm, pi

from magpend_core.models.text.grammar import Tree
from pipeline.importing.expressions import MAX_NODES, PI, RefusedError, names_in, replaced, rewritten, size, walk
from pipeline.importing.source import Source

TIME = "t"
OMEGA, PHASE = "@omega", "@phase"
"""Names in trees of the drive's angular frequency and phase; no file can have them."""
PERIODIC = ("sin", "cos", "tan")
MOST_HARMONIC = 64
"""Highest multiple of the drive's frequency."""
_T = Tree("name", 1, TIME)


@dataclass(frozen=True)
class Rate:
    """An angular frequency: a number times powers of names."""

    factor: float
    powers: tuple[tuple[str, int], ...] = ()


def drive_of(source: Source) -> float | None:
    """Rewrite the equations of a source as driven by omega; return omega's value, or None if nothing depends on time.

    Time that does not enter as ``sin(w*t + a)`` or ``mod(t, T)``, with one frequency and its multiples, becomes a
    state, a clock. A clock of a map counts iterations.
    """
    trees = {**source.states, **{f"reset {i}": reset.of for i, reset in enumerate(source.resets)}}
    for reset in source.resets:
        trees |= {f"{reset.line} {name}": tree for name, tree in reset.set.items()}
    timed = _timed_parts(source)
    if not any(names_in(tree) & ({TIME} | timed) for tree in trees.values()):
        _drop_timed_quantities(source, timed)
        return None
    if source.is_map:
        _add_clock(source, "it counts iterations")
        return None
    before = dict(source.parts), dict(source.states), [(r.of, r.set) for r in source.resets]
    try:
        _inline(source, timed)
        return _rewrite(source)
    except RefusedError as error:
        source.parts, source.states = before[0], before[1]
        for reset, (of, values) in zip(source.resets, before[2], strict=True):
            reset.of, reset.set = of, values
        _add_clock(source, str(error))
        return None


def _timed_parts(source: Source) -> set[str]:
    """Return the parts that depend on time."""
    found: set[str] = set()
    while True:
        new = {n for n, tree in source.parts.items() if n not in found and names_in(tree) & ({TIME} | found)}
        if not new:
            return found
        found |= new


def _drop_timed_quantities(source: Source, timed: set[str]) -> None:
    for name in [n for n, tree in source.quantities.items() if names_in(tree) & ({TIME} | timed)]:
        place = f"line {source.line_of(name)}: aux {source.spelled(name)}"
        source.notes.append(f"{place} is left out: it needs time, and the equations do not.")
        del source.quantities[name]


def _add_clock(source: Source, reason: str) -> None:
    """Make time a state."""
    name = "clock"
    while name in source.lines or name in source.states:
        name += "_"
    clock = {TIME: Tree("name", 1, name)}
    one = Tree("number", 1, 1.0)
    source.rewrite(lambda tree: replaced(tree, clock))
    source.states[name] = Tree("sum", 1, "", (clock[TIME], one)) if source.is_map else one
    source.starts[name] = constant_setting(source, "t0", 0.0)
    source.notes.append(
        f"t is the state {name} ({reason}): no motion closes, so trajectories have a meaning, attractors none."
    )


def constant_setting(source: Source, name: str, default: float) -> float:
    """Return an option of the source that is a number."""
    try:
        value = float(source.settings.get(name, default))
    except ValueError:
        return default
    return value if abs(value) < 1e300 else default


def _inline(source: Source, timed: set[str]) -> None:
    """Put parts that depend on time, but for those periodic by themselves, where they are used."""
    linear = {n for n in timed if _part_of_phase(source.parts[n])}
    for _ in range(len(linear)):
        trees = {n: source.parts[n] for n in linear}
        for table in (source.states, source.parts, source.quantities):
            for name, tree in table.items():
                if names_in(tree) & linear:
                    table[name] = replaced(tree, {n: t for n, t in trees.items() if n != name})
                    if size(table[name]) > MAX_NODES:
                        raise RefusedError("the parts with t make the equations too long")
        for reset in source.resets:
            reset.of = replaced(reset.of, trees)
            reset.set = {n: replaced(tree, trees) for n, tree in reset.set.items()}
    for name in linear:
        del source.parts[name]


def _part_of_phase(tree: Tree) -> bool:
    """Return whether time stands outside of any periodic function."""
    if tree.kind == "name":
        return tree.value == TIME
    if tree.kind == "call" and tree.value in (*PERIODIC, "mod"):
        return False
    return any(map(_part_of_phase, tree.args))


def _rewrite(source: Source) -> float:
    """Write each ``w*t`` with omega; return omega's value."""
    trees = [*source.states.values(), *source.parts.values(), *source.quantities.values()]
    trees += [t for r in source.resets for t in (r.of, *r.set.values())]
    rates = [rate for tree in trees for rate in _rates(source, tree)]
    if not rates:
        raise RefusedError("t does not enter as sin(w*t)")
    base = _base(rates)
    value = _value(source, base)
    if not 0.0 < value < 1e9:
        raise RefusedError(f"the frequency of the drive is {value:g} at the parameters of the file")
    replaceable = [n for n, power in base.powers if n in source.parameters and abs(power) == 1]
    if base.powers and not replaceable:
        raise RefusedError("the frequency is no product of a parameter")
    source.rewrite(lambda tree: rewritten(tree, lambda node: _phase(source, node, base)))
    if any(TIME in names_in(_without_phases(tree)) for tree in source.states.values()):
        raise RefusedError("t stands outside of sin(w*t)")
    if replaceable:
        _replace_parameter(source, replaceable[0], base)
    return value


def _rates(source: Source, tree: Tree) -> list[Rate]:
    """Return the angular frequencies with which time enters a tree."""
    found = []
    for node in walk(tree):
        if node.kind == "call" and node.value in PERIODIC and TIME in names_in(node):
            slope, _ = _linear(node.args[0])
            found.append(_rate(source, slope))
        elif node.kind == "call" and node.value == "mod" and TIME in names_in(node):
            found.append(_period_rate(source, node))
    return found


def _period_rate(source: Source, node: Tree) -> Rate:
    """Return the angular frequency of ``mod(t, T)``."""
    if node.args[0] != Tree("name", node.args[0].at, TIME) or TIME in names_in(node.args[1]):
        raise RefusedError("t enters mod otherwise than as mod(t, T)")
    period = _rate(source, node.args[1])
    return Rate(2.0 * pi / period.factor, tuple((n, -power) for n, power in period.powers))


def _linear(tree: Tree) -> tuple[Tree, Tree | None]:
    """Return the factor of time in an expression linear in it, and the rest (None for 0)."""
    one = Tree("number", 1, 1.0)
    if tree == Tree("name", tree.at, TIME):
        return one, None
    if tree.kind == "negative":
        slope, rest = _linear(tree.args[0])
        return Tree("negative", 1, "", (slope,)), None if rest is None else Tree("negative", 1, "", (rest,))
    timed = [arg for arg in tree.args if TIME in names_in(arg)]
    if len(timed) != 1 or tree.kind not in ("sum", "product") or timed[0].kind == "inverse":
        raise RefusedError("t enters otherwise than as sin(w*t + a)")
    slope, rest = _linear(timed[0])
    others = tuple(arg for arg in tree.args if arg is not timed[0])
    if tree.kind == "sum":
        return slope, Tree("sum", 1, "", (*others, *([] if rest is None else [rest])))
    return (Tree("product", 1, "", (slope, *others)), None if rest is None else Tree("product", 1, "", (rest, *others)))


def _rate(source: Source, tree: Tree) -> Rate:
    """Return an expression as a number times powers of names."""
    factor, powers = 1.0, Counter[str]()
    pending = [(tree, 1)]
    while pending:
        node, power = pending.pop()
        if node.kind == "number":
            if node.value == 0.0:
                raise RefusedError("the frequency is 0")
            factor *= float(node.value) ** power
        elif node.kind == "negative":
            factor = -factor
            pending.append((node.args[0], power))
        elif node.kind == "product":
            pending += [(arg, power) for arg in node.args]
        elif node.kind == "inverse":
            pending.append((node.args[0], -power))
        elif node.kind == "name" and node.value == "pi":
            factor *= pi**power
        elif node.kind == "name" and node.value in source.parts:
            pending.append((source.parts[str(node.value)], power))
        elif node.kind == "name" and node.value in source.parameters:
            powers[str(node.value)] += power
        else:
            raise RefusedError("the frequency is no product of numbers and parameters")
    return Rate(factor, tuple(sorted((n, p) for n, p in powers.items() if p)))


def _base(rates: list[Rate]) -> Rate:
    """Return the greatest angular frequency that divides all others without remainder."""
    first = rates[0]
    if any(rate.powers != first.powers for rate in rates):
        raise RefusedError("t enters with several frequencies")
    ratios = [Fraction(rate.factor / first.factor).limit_denominator(MOST_HARMONIC) for rate in rates]
    for ratio, rate in zip(ratios, rates, strict=True):
        if ratio == 0 or abs(float(ratio) * first.factor / rate.factor - 1.0) > 1e-12:
            raise RefusedError("t enters with frequencies that are no multiples of one")
    common = lcm(*(r.denominator for r in ratios))
    multiples = [int(r * common) for r in ratios]
    shared = gcd(*multiples)
    if max(map(abs, multiples)) // shared > MOST_HARMONIC:
        raise RefusedError("t enters with frequencies that are no small multiples of one")
    return Rate(abs(first.factor) * shared / common, first.powers)


def _value(source: Source, rate: Rate) -> float:
    value = rate.factor
    for name, power in rate.powers:
        given = source.parameters[name]
        if given == 0.0:
            raise RefusedError(f"the frequency of the drive is 0 or infinite with {source.spelled(name)} = 0")
        value *= given**power
    return value


def _phase(source: Source, node: Tree, base: Rate) -> Tree:
    """Return a periodic function of time, written with omega; any other node unchanged."""
    if node.kind != "call" or TIME not in names_in(node):
        return node
    omega = Tree("name", 1, OMEGA)
    if node.value == "mod":
        if _multiple(_period_rate(source, node), base) != 1:
            raise RefusedError("t enters mod with a multiple of the drive's frequency")
        return Tree("product", 1, "", (node.args[1], Tree("name", 1, PHASE)))
    if node.value not in PERIODIC or (node.args[0].kind == "product" and omega in node.args[0].args):
        return node
    slope, rest = _linear(node.args[0])
    k = _multiple(_rate(source, slope), base)
    factors = ([Tree("number", 1, float(abs(k)))] if abs(k) != 1 else []) + [omega, _T]
    turning = Tree("product", 1, "", tuple(factors))
    if k < 0:
        turning = Tree("negative", 1, "", (turning,))
    return Tree("call", node.at, node.value, (turning if rest is None else Tree("sum", 1, "", (turning, rest)),))


def _multiple(rate: Rate, base: Rate) -> int:
    return round(rate.factor / base.factor)


def _without_phases(tree: Tree) -> Tree:
    """Return a tree without its periodic functions."""
    return rewritten(tree, lambda n: PI if n.kind == "call" and n.value in (*PERIODIC, "mod") else n)


def _replace_parameter(source: Source, name: str, base: Rate) -> None:
    """Make the parameter that decides the frequency a part, an expression of omega."""
    power = dict(base.powers)[name]
    factors = [Tree("number", 1, base.factor)] if base.factor != 1.0 else []
    for other, p in base.powers:
        if other != name:
            one = Tree("name", 1, other)
            for _ in range(abs(p)):
                factors.append(one if p > 0 else Tree("inverse", 1, "", (one,)))
    omega = Tree("name", 1, OMEGA)
    if power > 0:
        tree = Tree("product", 1, "", (omega, *(_inverse(f) for f in factors))) if factors else omega
    else:
        tree = Tree("product", 1, "", (*(factors or [Tree("number", 1, 1.0)]), Tree("inverse", 1, "", (omega,))))
    del source.parameters[name]
    for found in source.presets.values():
        if found.pop(name, None) is not None:
            source.notes.append(f"{source.spelled(name)} is left out of the sets: it is the drive's frequency.")
    if name == "omega":
        _rename(source, name, OMEGA)
        source.notes.append("omega is the angular frequency of the drive; a specification gives it below [parameters].")
        return
    source.parts = {name: tree, **source.parts}
    source.notes.append(
        f"{source.spelled(name)} is no parameter: it follows from the drive's angular frequency omega, which a "
        "specification gives below [parameters]."
    )


def _rename(source: Source, old: str, new: str) -> None:
    other = {old: Tree("name", 1, new)}
    source.rewrite(lambda tree: replaced(tree, other))


def _inverse(tree: Tree) -> Tree:
    return tree.args[0] if tree.kind == "inverse" else Tree("inverse", 1, "", (tree,))
