"""Take white noise out of equations, as the strengths of the table ``[noise]``."""

from __future__ import annotations

from magpend_core.models.text.grammar import Tree
from pipeline.importing.expressions import ONE, RefusedError, names_in, replaced
from pipeline.importing.source import Source


def strengths_of(source: Source) -> dict[str, Tree]:
    """Remove the noises of a source from its equations; return the strength of the noise of each state."""
    noises = set(source.noises)
    used_by: dict[str, str] = {}
    strengths: dict[str, Tree] = {}
    noisy_parts = {n: tree for n, tree in source.parts.items() if names_in(tree) & noises}
    for name, tree in source.states.items():
        for _ in range(len(noisy_parts) if names_in(tree) & noisy_parts.keys() else 0):
            tree = replaced(tree, noisy_parts)
        found = sorted(names_in(tree) & noises)
        try:
            for noise in found:
                if used_by.setdefault(noise, name) != name:
                    raise RefusedError(f"the noise {noise} is in two equations; magpend's noises are independent")
            if found:
                source.states[name], strengths[name] = _without(tree, found)
        except RefusedError as error:
            source.refuse(source.line_of(name), str(error))
    for name in noisy_parts:
        del source.parts[name]
    for name in [n for n, tree in source.quantities.items() if names_in(tree) & (noises | noisy_parts.keys())]:
        source.notes.append(f"line {source.line_of(name)}: aux {source.spelled(name)} is left out: it contains noise.")
        del source.quantities[name]
    return strengths


def _without(tree: Tree, noises: list[str]) -> tuple[Tree, Tree]:
    """Return a rate without its noises, and their strength: the root of the sum of squares of several."""
    factors = []
    for noise in noises:
        tree, factor = _split(tree, noise)
        factors.append(factor)
    if len(factors) == 1:
        return tree, _positive(factors[0])
    two = Tree("number", 1, 2.0)
    squares = tuple(Tree("power", 1, "", (factor, two)) for factor in factors)
    return tree, Tree("call", 1, "sqrt", (Tree("sum", 1, "", squares),))


def _positive(tree: Tree) -> Tree:
    """Return a strength without its sign, which noise does not show."""
    return tree.args[0] if tree.kind == "negative" else tree


def _split(tree: Tree, noise: str) -> tuple[Tree, Tree]:
    """Return a and b of a + b*noise."""
    zero = Tree("number", 1, 0.0)
    if tree.kind == "name" and tree.value == noise:
        return zero, ONE
    if tree.kind == "negative":
        rest, factor = _split(tree.args[0], noise)
        return (zero if rest == zero else Tree("negative", 1, "", (rest,))), factor
    noisy = [arg for arg in tree.args if noise in names_in(arg)]
    if len(noisy) != 1 or tree.kind not in ("sum", "product") or noisy[0].kind == "inverse":
        raise RefusedError(f"the noise {noise} enters otherwise than as a summand")
    rest, factor = _split(noisy[0], noise)
    others = tuple(arg for arg in tree.args if arg is not noisy[0])
    if tree.kind == "product":
        product = Tree("product", 1, "", (*others, factor)) if factor != ONE else _all(others)
        return (zero if rest == zero else Tree("product", 1, "", (*others, rest))), product
    kept = (*others, *(() if rest == zero else (rest,)))
    return (Tree("sum", 1, "", kept) if len(kept) > 1 else kept[0]), factor


def _all(factors: tuple[Tree, ...]) -> Tree:
    return factors[0] if len(factors) == 1 and factors[0].kind != "inverse" else Tree("product", 1, "", factors)
