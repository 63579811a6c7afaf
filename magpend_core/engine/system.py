"""Describe a dynamical system for the engine."""

from __future__ import annotations

import hashlib
import math
from collections import namedtuple
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magpend_core.engine.tableau import Tableau


def positions(names: Iterable[str]) -> Any:
    """Return the index of each name, as a named tuple of the integers 0, 1, 2, ...

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


@dataclass(frozen=True, kw_only=True)
class System:
    """A periodically forced system of ordinary differential equations, as compiled functions.

    The functions of the hot path (`forcing`, `rhs`, `layers`, `jacobian`, `quantities`) are decorated with
    `jit.inline` and use arithmetic, `simd` and `vecmath` only: they are compiled for groups of lanes, so that
    a choice is `simd.where_less`, never an ``if``, and powers are products. They return tuples of fixed
    length, of which each entry is a number per lane: what does not depend on the state is ``0.0 * x + 1.0``,
    say. `constants` and `edges` run once per cell on plain numbers, where anything goes that numba compiles.

    Before its first run a system is checked on plain numbers (see `checks.check_system`), so that what is
    declared wrongly is an error by name and not a wrong number.

    Attributes
    ----------
    name : str
        One name, one set of functions: it names the compiled code.
    parameter_names : tuple of str
        Order of the packed parameter vector.
    n_constants : int
        Length of the vector that `constants` fills.
    constants : callable
        ``constants(frequency, p, out)``: from the drive frequency [Hz] and the packed parameters
        `p` to what `forcing`, `rhs` and `layers` use; fills all of `out` with finite numbers.
    has_poles : bool
        Whether constants need not be finite: cells that use one that is not end with a status.
    forcing : callable
        ``forcing(t, c)``: the explicit time dependence, a number, at time `t` [s] since the last
        section; `c` is the tuple of constants. It has the period 1/frequency. None for none: the system is
        autonomous, and the period is the time between two looks at it.
    forcing_is_time : bool
        Whether `forcing` returns `t` itself, because time enters `rhs` by more than one number; then `rhs`
        has the period 1/frequency in it.
    rhs : callable
        ``rhs(y, u, c)``: time derivatives as a tuple, from the states `y` and the forcing `u`.
    jacobian : callable
        ``jacobian(y, u, c)``: derivatives of `rhs` by the states, as one flat tuple, row by row. None if
        neither exponents nor multipliers nor orbits are asked for.
    jacobian_entries : tuple of int or None
        Places of the entries that `jacobian` returns, in the flat tuple of all and in rising order; the
        others are 0 everywhere. None if it returns all. Declare it for a large system with many zeros.
    is_angle : tuple of bool
        Which states live on a circle of 2 pi; empty for none. They are brought back to (-pi, pi] at every
        section, their full turns counted apart; `rhs` must not change under such a shift.
    scales : tuple of float
        Size of each state that counts as 1 when sections are compared; empty for 1.
    escape : tuple of float
        Bound on the absolute value of each state at a section; beyond it a trajectory has diverged. Empty
        for none.
    n_edges : int
        Number of known instants per period at which the forcing switches.
    edges : callable
        ``edges(frequency, p, times, half_widths, jumps)``: fills the instants [s] in
        [0, 1/frequency), in rising order; for each the distance in time of the forcing's nearest
        complex singularity [s], above 0; and the change of the right-hand side across the edge.
    layers : callable
        ``layers(y, dy, c)``: a tuple of ``(value, rate, half_width, per_strength)``. Where `value`,
        which moves at `rate`, passes zero, the right-hand side changes quickly, and has its nearest
        complex singularity at an imaginary part `half_width` of `value`, above 0. `per_strength` is
        1/(half_width * jump), with the change of the right-hand side across the layer. None for none.
    has_layers : bool
        False if there are none; then `layers` is never called.
    layers_fade : bool
        Whether every layer falls off exponentially, like tanh and unlike atan: exp(-pi m) of its change
        is left at m half-widths.
    timed_layers : bool
        Whether `layers` needs the time [s since the last section]; it then finds it behind the rates, as
        ``dy[n_states]``.
    n_controlled : int or None
        How many of the states, from the first, enter the error control; None for all.
    n_known : int or None
        How many of the states, from the first, the functions know and take; None for all. The states behind
        them are tangent vectors, which the engine carries along (see `tangents`).
    n_modes : int
        Numbers that `rhs`, `jacobian` and `quantities` find behind the constants, ``c[n_constants + k]``,
        and that change at events and edges alone: each stage of a step sees the same. First one for each
        switch, then one for each impact if any of them sticks, last the segment if `has_segments`.
    n_switches : int
        Number of surfaces at which the right-hand side jumps. Mode k is the side on which switch k is,
        -1.0 or +1.0; `rhs` uses it where it says ``sign(value)``. A step ends on the surface, and the mode
        changes.
    switches : callable
        ``switches(t, y, dy, c)``: a tuple of ``(value, rate)``, a function of time and state and its time
        derivative, which is linear in `dy`. While mode k is 0 (see `slides`), pair k is instead
        ``1 - sigma**2`` and its rate, where sigma in [-1, 1] is what stands for the mode in the equivalent
        control.
    slides : tuple of bool
        For which switches sliding is looked for; empty for none. Where the right-hand sides of both sides
        point to the surface, the mode becomes 0.0, and `rhs` is to give the motion along it (Filippov's
        equivalent control). It ends where sigma leaves [-1, 1].
    has_segments : bool
        Whether the last mode, ``c[n_constants + n_modes - 1]``, is the number of edges passed in this period:
        0.0 before the first, and so on. A forcing with true jumps is then on the right side of an edge at all
        stages; its half-width may be infinite.
    n_impacts : int
        Number of surfaces at which the state jumps.
    impacts : callable
        ``impacts(t, y, dy, c)``: a tuple of ``(value, rate)``, as for `switches`.
    impact_directions : tuple of int
        +1 where an impact happens as its value rises through zero, -1 as it falls.
    sticks : tuple of int
        For each impact, whether the state rests on its surface after infinitely many impacts in a finite
        time: 0 for no, 1 for yes, 2 for yes unless it rests on another; empty for none. There is then a mode
        for each impact, behind those of the switches: 1.0, and 0.0 at rest. At rest, `rhs` is to keep value
        and rate of the impact at 0, and its pair in `impacts` is the negative second derivative that the
        value would have without the contact, and its rate: where that changes its sign the state is pulled
        off.
    reset : callable
        ``reset(k, t, y, c)``: the states after impact number `k` as a tuple, from those before. Runs on plain
        numbers, so that ``if k == 0`` is allowed. For ``k = n_impacts + i`` the states at rest on the surface
        of impact `i`, from those nearby, if it sticks.
    section : (int, int) or None
        Number of the state at whose crossing of a level a period ends, and the direction, +1 rising or
        -1 falling; the level is the last parameter. See `crossing.with_section`.
    quantities : callable or None
        ``quantities(t, y, dy, u, c)``: a tuple of the named quantities at time `t` [s] since the last
        section, from the states, their rates, the forcing and the constants.
    method : str
        Of `tableau.METHODS`: ``"dopri5"`` of order 5, or ``"dop853"`` of order 8, which needs a half or a
        quarter of the time for smooth equations at tolerances below 1e-6. Where layers decide the steps it
        gains nothing. Quantities are watched, and trajectories sampled, with the first alone.
    tangents_of : System or None
        The system whose tangent vectors this one carries along (see `variational.with_tangents`).
    recorded_for : System or None
        The system of which this one follows a recorded drive (see `driven.with_recorded_drive`).

    Examples
    --------
    A damped oscillator, x'' + damping x' + x = cos(2 pi f t):

    >>> from magpend_core.engine.jit import inline
    >>> from magpend_core.engine.vecmath import TWO_PI, sincos
    >>> @inline
    ... def constants(frequency, p, out):
    ...     out[0] = p[0]
    ...     out[1] = TWO_PI * frequency
    >>> @inline
    ... def forcing(t, c):
    ...     return sincos(c[1] * t)[1]
    >>> @inline
    ... def rhs(y, u, c):
    ...     return y[1], u - c[0] * y[1] - y[0]
    >>> system = System(
    ...     name="oscillator", state_names=("x", "v"), parameter_names=("damping",),
    ...     n_constants=2, constants=constants, forcing=forcing, rhs=rhs,
    ... )
    >>> system.n_states
    2
    """

    name: str
    state_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    n_constants: int
    constants: Callable[..., Any]
    rhs: Callable[..., Any]
    # None stands for a function that does nothing, put in place below: what is read is never None
    forcing: Callable[..., Any] = None  # type: ignore[assignment]
    forcing_is_time: bool = False
    jacobian: Callable[..., Any] | None = None
    jacobian_entries: tuple[int, ...] | None = None
    is_angle: tuple[bool, ...] = ()
    scales: tuple[float, ...] = ()
    escape: tuple[float, ...] = ()
    n_edges: int = 0
    edges: Callable[..., Any] = None  # type: ignore[assignment]
    layers: Callable[..., Any] = None  # type: ignore[assignment]
    has_layers: bool = True
    timed_layers: bool = False
    layers_fade: bool = False
    has_poles: bool = False
    n_controlled: int | None = None
    n_known: int | None = None
    n_modes: int = 0
    n_switches: int = 0
    switches: Callable[..., Any] | None = None
    slides: tuple[bool, ...] = ()
    has_segments: bool = False
    n_impacts: int = 0
    impacts: Callable[..., Any] | None = None
    impact_directions: tuple[int, ...] = ()
    sticks: tuple[int, ...] = ()
    reset: Callable[..., Any] | None = None
    section: tuple[int, int] | None = None
    quantity_names: tuple[str, ...] = ()
    quantities: Callable[..., Any] | None = None
    method: str = "dopri5"
    tangents_of: System | None = field(default=None, compare=False, repr=False)
    recorded_for: System | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        from magpend_core.engine.placeholders import no_edges, no_forcing, no_layers  # brings the compiler

        n = self.n_states
        absent = {
            "is_angle": (False,) * n,
            "scales": (1.0,) * n,
            "escape": (math.inf,) * n,
            "forcing": no_forcing,
            "edges": no_edges,
            "layers": no_layers,
            "slides": (False,) * self.n_switches,
            "sticks": (0,) * self.n_impacts,
        }
        kinds = {
            "state_names": str,
            "parameter_names": str,
            "quantity_names": str,
            "is_angle": bool,
            "scales": float,
            "escape": float,
            "slides": bool,
            "impact_directions": int,
            "sticks": int,
        }
        for name, kind in kinds.items():  # lists cannot be hashed, integers among numbers not be looped over
            object.__setattr__(self, name, tuple(kind(value) for value in getattr(self, name)))
        object.__setattr__(self, "has_layers", self.has_layers and self.layers is not None)
        for name, value in absent.items():
            if not getattr(self, name):
                object.__setattr__(self, name, value)

    @property
    def functions(self) -> tuple[Callable[..., Any], ...]:
        """All compiled functions of the system, as a tuple."""
        always = self.constants, self.forcing, self.rhs, self.edges, self.layers
        others = self.jacobian, self.quantities, self.switches, self.impacts, self.reset
        return (*always, *(f for f in others if f is not None))

    @property
    def label(self) -> str:
        """Name of the compiled code: `name`, and a digest of the data that goes into the code."""
        data = (
            self.state_names,
            self.is_angle,
            self.scales,
            self.parameter_names,
            self.n_constants,
            self.n_edges,
            self.has_layers,
            self.layers_fade,
            self.escape,
            self.controlled,
        )
        if self.n_events or self.n_modes:
            data += (  # type: ignore[assignment]
                self.n_modes,
                self.n_switches,
                self.slides,
                self.has_segments,
                self.n_impacts,
                self.impact_directions,
                self.section,
            )
        if self.n_contacts:
            data += (self.sticks,)  # type: ignore[assignment]
        if self.method != "dopri5":
            data += (self.method,)  # type: ignore[assignment]
        if self.n_known is not None or self.jacobian_entries is not None:
            data += (self.n_known, self.jacobian_entries)  # type: ignore[assignment]
        return f"{self.name}_{hashlib.sha256(repr(data).encode()).hexdigest()[:8]}"

    @property
    def tableau(self) -> Tableau:
        """Runge-Kutta coefficients of the system's `method`."""
        from magpend_core.engine.tableau import METHODS

        if self.method not in METHODS:
            known = ", ".join(METHODS)
            raise ValueError(f"method = {self.method!r}: {self.name} can be integrated by {known}.")
        return METHODS[self.method]

    @property
    def n_events(self) -> int:
        """Number of event functions; steps end at their zeros."""
        return self.n_switches + self.n_impacts + (self.section is not None)

    @property
    def n_contacts(self) -> int:
        """Number of modes that say whether the state rests on an impact surface: one per impact, or 0."""
        return self.n_impacts if any(self.sticks) else 0

    @property
    def controlled(self) -> int:
        """Number of leading states that enter the error control of the steps."""
        return self.n_states if self.n_controlled is None else self.n_controlled

    @property
    def known(self) -> int:
        """Number of states that the system's own functions take, without tangent vectors that the engine integrates by
        itself.
        """
        return self.n_states if self.n_known is None else self.n_known

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.state_names)
