"""Let the constants of a system be polynomials in time, on each interval between two instants.

The functions of a system see its parameters through the constants that it computes from them. Where a parameter
moves, some of these constants move. Within an interval each of them is a polynomial in time, which interpolates
it at Chebyshev-Lobatto points: it is evaluated at the time of each stage, with one multiplication and one
addition per degree, constant and stage. This serves every system, whatever it computes of its parameters.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from fractions import Fraction
from functools import cache
from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.placeholders import no_edges, no_forcing
from magpend_core.engine.simd import multiply_add
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import tanh

HZ, OFFSET = "drift_hz", "drift_offset_s"
"""Parameters of an interval: the drive's frequency, and the time from the section before to the interval."""

NEAR = 1e-12
"""Two instants closer than this part of a drive period are one."""

AFFINE, DEGREE = 1, 8
"""Degrees of the polynomials: for constants that are linear in time, and for others."""


@dataclasses.dataclass(frozen=True)
class Moving:
    """What moves in a system.

    Attributes
    ----------
    parameters : tuple of int
        Numbers of the parameters that move.
    smooth : tuple of bool
        Which of them move as the tanh of a linear function of time.
    constants : tuple of int
        Numbers of the constants that move with them.
    degree : int
        Of the polynomials, `AFFINE` or even.
    """

    parameters: tuple[int, ...]
    smooth: tuple[bool, ...]
    constants: tuple[int, ...]
    degree: int

    def names(self, system: System) -> tuple[str, ...]:
        """Return the names of the parameters that an interval adds to those of the system.

        For each parameter its values at the interval's ends; or, if it is smooth, the argument of the tanh at
        both ends, the middle of the ramp's values, and half their range over the tanh of the ramp's end.
        """
        found = [HZ, OFFSET]
        for i, smooth in zip(self.parameters, self.smooth, strict=True):
            keys = ("x0", "x1", "middle", "half") if smooth else ("begin", "end")
            found += [f"drift_{system.parameter_names[i]}_{key}" for key in keys]
        return tuple(found)


def nodes_of(degree: int) -> tuple[float, ...]:
    """Return the interpolation points in [-1, 1], rising: both ends and, of an even degree, the middle among them."""
    # rounded, so that they are the same numbers with every library of mathematics
    return tuple(round(-math.cos(math.pi * j / degree), 6) + 0.0 for j in range(degree + 1))


def coefficients_of(degree: int) -> tuple[tuple[float, ...], ...]:
    """Return the matrix from values at the interpolation points to coefficients of 1, s, s**2, ..., row by row."""
    nodes = [Fraction(s) for s in nodes_of(degree)]
    columns = []
    for j, node in enumerate(nodes):
        product = [Fraction(1)]
        for i, other in enumerate(nodes):
            if i != j:
                shifted = [Fraction(0), *product]
                product = [
                    (a - other * b) / (node - other) for a, b in zip(shifted, [*product, Fraction(0)], strict=True)
                ]
        columns.append(product)
    return tuple(tuple(float(column[k]) for column in columns) for k in range(degree + 1))


@cache
def with_moving_constants(system: System, moving: Moving) -> System:
    """Return `system` with constants that are polynomials in time on each interval.

    A period of the result is an interval of any length that lies within a drive period; see `Moving.names` for
    the parameters that describe it. The forcing's phase goes on from interval to interval.

    Parameters
    ----------
    system
        Any system without a section by crossing.
    moving
        What moves.

    Returns
    -------
    System
        With the parameters of `Moving.names` behind its own. Its own values of the parameters that move do not
        matter.
    """
    builder = _Builder(system, moving)
    n_scratch = 3 * system.n_edges if system.has_segments else 0
    digest = hashlib.sha256(repr(moving).encode()).hexdigest()[:8]
    return dataclasses.replace(
        system,
        **builder.functions(),
        name=f"{system.name}_drift_{digest}",
        parameter_names=(*system.parameter_names, *moving.names(system)),
        n_constants=builder.first + len(moving.constants) * (moving.degree + 1) + n_scratch,
        forcing_is_time=True,
        timed_layers=system.has_layers,
        recorded_for=system,
    )


class _Builder:
    """Writer of the functions of a system whose constants move."""

    def __init__(self, system: System, moving: Moving) -> None:
        self.system, self.moving = system, moving
        # behind the own constants: offset, twice the interval's frequency, segments passed
        self.offset, self.rate, self.passed = (system.n_constants + i for i in range(3))
        self.first = system.n_constants + 3
        self.n = len(moving.constants) * (moving.degree + 1)

    def functions(self) -> dict[str, Any]:
        """Return the functions by the names of the fields of `System`."""
        system = self.system
        self.bound: dict[str, Any] = {"multiply_add": multiply_add, "tanh": tanh, "inf": math.inf}
        for name in ("constants", "forcing", "rhs", "jacobian", "layers", "quantities", "edges"):
            self.bound[f"_{name}"] = getattr(system, name)
        for name in ("switches", "impacts", "reset"):
            self.bound[f"_{name}"] = getattr(system, name)
        self.bound["_own"] = self._compiled("t, c", self._own_constants())
        self.bound["_move"] = self._compiled("p, w", self._moved_parameters())
        stepwise = f"k = _own(u, c); t = u + c[{self.offset}]"
        found = {
            "constants": self._compiled("frequency, p, out", self._constants()),
            "forcing": self._compiled("t, c", ["return t + 0.0"]),
            "rhs": self._compiled("y, u, c", [stepwise, "return _rhs(y, _forcing(t, k), k)"]),
        }
        if system.forcing is no_forcing:
            found["rhs"] = self._compiled("y, u, c", [stepwise, "return _rhs(y, 0.0 * t, k)"])
        if system.jacobian is not None:
            found["jacobian"] = self._compiled("y, u, c", [stepwise, "return _jacobian(y, _forcing(t, k), k)"])
        timed = f"t + c[{self.offset}], y, dy"
        if system.quantities is not None:
            lines = [f"k = _own(t, c); s = t + c[{self.offset}]", "return _quantities(s, y, dy, _forcing(s, k), k)"]
            found["quantities"] = self._compiled("t, y, dy, u, c", lines)
        if system.has_layers:
            n = system.n_states
            rates = f"dy[:{n}] + (dy[{n}] + c[{self.offset}],)" if system.timed_layers else f"dy[:{n}]"
            found["layers"] = self._compiled("y, dy, c", [f"return _layers(y, {rates}, _own(dy[{n}], c))"])
        for name in ("switches", "impacts"):
            if getattr(system, name) is not None:
                found[name] = self._compiled("t, y, dy, c", [f"return _{name}({timed}, _own(t, c))"])
        if system.reset is not None:
            lines = [f"return _reset(k, t + c[{self.offset}], y, _own(t, c))"]
            found["reset"] = self._compiled("k, t, y, c", lines)
        found["edges"] = self._compiled("frequency, p, times, half_widths, jumps", self._edges())
        if system.edges is no_edges:
            found["edges"] = no_edges
        return found

    def _compiled(self, head: str, lines: list[str]) -> Any:
        """Compile a function given as lines, as if it were defined beside the system's own (see `jit.keeping`)."""
        source = "\n".join([f"def function({head}):", *(f"    {line}" for line in lines)])
        scope: dict[str, Any] = {"__name__": self.system.rhs.__module__, **self.bound}
        exec(source + "\n", scope)
        return inline(scope["function"])

    def _own_constants(self) -> list[str]:
        """Return the lines of the function that computes the system's own constants at a time of the interval."""
        degree, lines = self.moving.degree, [f"s = multiply_add(t, c[{self.rate}], -1.0)"]
        names = [f"c[{i}]" for i in range(self.system.n_constants)]
        for place, k in enumerate(self.moving.constants):
            at = self.first + place * (degree + 1)
            lines.append(f"k{k} = c[{at + degree}]")
            lines += [f"k{k} = multiply_add(k{k}, s, c[{at + d}])" for d in range(degree - 1, -1, -1)]
            names[k] = f"k{k}"
        total = self.first + self.n + (3 * self.system.n_edges if self.system.has_segments else 0)
        names += [f"c[{total + i}]" for i in range(self.system.n_modes)]
        if self.system.has_segments:
            names[-1] = f"c[{total + self.system.n_modes - 1}] + c[{self.passed}]"
        return [*lines, f"return ({', '.join(names)},)"]

    def _moved_parameters(self) -> list[str]:
        """Return the lines that set the moving parameters where the part `w` of the interval is over."""
        lines, at = [], len(self.system.parameter_names) + 2
        for i, smooth in zip(self.moving.parameters, self.moving.smooth, strict=True):
            if smooth:
                x = f"p[{at}] * (1.0 - w) + p[{at + 1}] * w"
                lines.append(f"p[{i}] = p[{at + 2}] + p[{at + 3}] * tanh({x})")
            else:
                lines.append(f"p[{i}] = p[{at}] * (1.0 - w) + p[{at + 1}] * w")
            at += 4 if smooth else 2
        return lines

    def _constants(self) -> list[str]:
        """Return the lines that interpolate the moving constants over the interval."""
        degree, m = self.moving.degree, len(self.system.parameter_names)
        nodes, lines = nodes_of(degree), []
        for j, node in enumerate(nodes):
            lines += [f"_move(p, {0.5 + 0.5 * node!r})", f"_constants(p[{m}], p, out)"]
            for place, k in enumerate(self.moving.constants):
                lines.append(f"out[{self.first + place * (degree + 1) + j}] = out[{k}]")
        lines += [
            f"out[{self.offset}] = p[{m + 1}]",
            f"out[{self.rate}] = 2.0 * frequency",
            f"out[{self.passed}] = 0.0",
        ]
        for place in range(len(self.moving.constants)):
            at = self.first + place * (degree + 1)
            lines += [f"v{j} = out[{at + j}]" for j in range(degree + 1)]
            lines += self._interpolated(at)
        if self.system.has_segments:
            lines += self._segments(m)
        return lines

    def _interpolated(self, at: int) -> list[str]:
        """Return the lines from values v0, v1, ... at the nodes to coefficients; a constant's are exact."""
        degree = self.moving.degree
        if degree == AFFINE:
            return [f"out[{at}] = 0.5 * v0 + 0.5 * v1", f"out[{at + 1}] = 0.5 * (v1 - v0)"]
        matrix, middle = coefficients_of(degree), degree // 2
        lines = [f"v{j} = v{j} - v{middle}" for j in range(degree + 1) if j != middle]
        lines.append(f"out[{at}] = v{middle}")
        for d in range(1, degree + 1):
            terms = [f"({matrix[d][j]!r}) * v{j}" for j in range(degree + 1) if j != middle]
            lines.append(f"out[{at + d}] = {' + '.join(terms)}")
        return lines

    def _segments(self, m: int) -> list[str]:
        """Return the lines that count the edges of the drive period before the interval."""
        n, at = self.system.n_edges, self.first + self.n
        parts = [f"out[{at + i * n}:{at + (i + 1) * n}]" for i in range(3)]
        return [
            f"times = {parts[0]}",
            f"_edges(p[{m}], p, times, {parts[1]}, {parts[2]})",
            f"for i in range({n}):",
            f"    if times[i] < p[{m + 1}] - {NEAR!r} / p[{m}]:",
            f"        out[{self.passed}] += 1.0",
            # the scratch counts as constants, which are finite
            f"    out[{at + n} + i] = 0.0",
        ]

    def _edges(self) -> list[str]:
        """Return the lines that find the edges of the drive period that lie within the interval.

        The places of the others follow at the interval's end, where they end nothing and limit no step, but for
        the edge with which the next drive period begins.
        """
        m, n = len(self.system.parameter_names), self.system.n_edges
        return [
            "_move(p, 0.5)",
            f"_edges(p[{m}], p, times, half_widths, jumps)",
            f"period = 1.0 / p[{m}]; length = 1.0 / frequency; near = {NEAR!r} * period",
            f"begin = p[{m + 1}]",
            "if begin > 0.0 or length < period - near:",
            "    returns = times[0] == 0.0 and begin + length > period - near",
            "    width = half_widths[0]; jump = jumps[0]; found = 0",
            f"    for i in range({n}):",
            "        at = times[i] - begin",
            "        if at > -near and at < length - near:",
            "            times[found] = at if at > near else 0.0",
            "            half_widths[found] = half_widths[i]; jumps[found] = jumps[i]",
            "            found += 1",
            f"    for i in range(found, {n}):",
            "        times[i] = length; half_widths[i] = inf; jumps[i] = 1.0",
            f"    if returns and found < {n}:",
            "        half_widths[found] = width; jumps[found] = jump",
        ]
