"""What the engine needs to know of a dynamical system."""

from __future__ import annotations

import hashlib
from collections import namedtuple
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any


def positions(names: Iterable[str]) -> Any:
    """Return where each name stands: a named tuple of integers 0, 1, 2, ...

    Compiled functions read it as a global, so that they say ``p[AT.q]`` and not ``p[16]``; the number
    is a constant of the machine code.

    Parameters
    ----------
    names
        Distinct Python identifiers that do not begin with an underscore, such as the parameters of a
        system in the order of its packed vector.

    Raises
    ------
    ValueError
        If a name is given twice, or cannot be an attribute.
    AttributeError
        From the result, for a name that it does not have.

    Examples
    --------
    >>> AT = positions(("mass", "stiffness"))
    >>> AT.stiffness
    1
    """
    ordered = tuple(names)
    return namedtuple("Positions", ordered)(*range(len(ordered)))


@dataclass(frozen=True)
class System:
    """A periodically forced system of ordinary differential equations, as compiled functions.

    The functions of the hot path (`forcing`, `rhs`, `layers`) are decorated with `jit.inline` and
    use arithmetic, `simd` and `vecmath` only: they are compiled for groups of lanes. `constants`
    and `edges` run once per trajectory on plain numbers.

    Attributes
    ----------
    name : str
        One name, one set of functions: it names the compiled code.
    state_names : tuple of str
    is_angle : tuple of bool
        Which states live on a circle of 2 pi. They are brought back to (-pi, pi] at every section,
        their full turns counted apart; `rhs` must not change under such a shift.
    scales : tuple of float
        Size of each state that counts as 1 when sections are compared.
    parameter_names : tuple of str
        Order of the packed parameter vector.
    n_constants : int
        Length of the vector that `constants` fills.
    constants : callable
        ``constants(frequency, p, out)``: from the drive frequency [Hz] and the packed parameters
        `p` to what `forcing`, `rhs` and `layers` use.
    forcing : callable
        ``forcing(t, c)``: the explicit time dependence, a number, at time `t` [s] since the last
        section; `c` is the tuple of constants.
    rhs : callable
        ``rhs(y, u, c)``: time derivatives as a tuple, from the states `y` and the forcing `u`.
    n_edges : int
        Number of known instants per period at which the forcing switches.
    edges : callable
        ``edges(frequency, p, times, half_widths, jumps)``: fills the instants [s] in
        [0, 1/frequency), in rising order; for each the distance in time of the forcing's nearest
        complex singularity [s]; and the change of the right-hand side across the edge.
    layers : callable
        ``layers(y, dy, c)``: a tuple of ``(value, rate, half_width, per_strength)``. Where `value`,
        which moves at `rate`, passes zero, the right-hand side changes quickly, and has its nearest
        complex singularity at an imaginary part `half_width` of `value`. `per_strength` is
        1/(half_width * jump), with the change of the right-hand side across the layer.
    jacobian : callable
        ``jacobian(y, u, c)``: derivatives of `rhs` by the states, as one flat tuple, row by row.
    escape : tuple of float
        Bound on the absolute value of each state at a section; beyond it a trajectory has diverged.
    n_controlled : int or None
        How many of the states, from the first, enter the error control; None for all.
    has_layers : bool
        False if there are none; then `layers` is never called.
    quantity_names : tuple of str
    quantities : callable or None
        ``quantities(t, y, dy, u, c)``: a tuple of the named quantities at time `t` [s] since the last
        section, from the states, their rates, the forcing and the constants.
    """

    name: str
    state_names: tuple[str, ...]
    is_angle: tuple[bool, ...]
    scales: tuple[float, ...]
    parameter_names: tuple[str, ...]
    n_constants: int
    constants: Callable[..., Any]
    forcing: Callable[..., Any]
    rhs: Callable[..., Any]
    n_edges: int
    edges: Callable[..., Any]
    layers: Callable[..., Any]
    jacobian: Callable[..., Any]
    escape: tuple[float, ...]
    n_controlled: int | None = None
    has_layers: bool = True
    quantity_names: tuple[str, ...] = ()
    quantities: Callable[..., Any] | None = None

    @property
    def functions(self) -> tuple[Callable[..., Any], ...]:
        """All compiled functions."""
        own = self.constants, self.forcing, self.rhs, self.edges, self.layers, self.jacobian
        return own if self.quantities is None else (*own, self.quantities)

    @property
    def label(self) -> str:
        """Name of the compiled code: `name`, and a digest of the data that goes into the code."""
        data = (
            self.state_names, self.is_angle, self.scales, self.parameter_names, self.n_constants,
            self.n_edges, self.has_layers, self.escape, self.controlled,
        )  # fmt: skip
        return f"{self.name}_{hashlib.sha256(repr(data).encode()).hexdigest()[:8]}"

    @property
    def controlled(self) -> int:
        """Number of states in the error control."""
        return self.n_states if self.n_controlled is None else self.n_controlled

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.state_names)
