"""Define `System`, the description of a dynamical system that the engine integrates."""

from __future__ import annotations

import hashlib
import math
from collections import namedtuple
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magpend_core.engine.tableau import Tableau


def positions(names: Iterable[str]) -> Any:
    """Return the index of each name, as a named tuple of the integers 0, 1, 2, ...

    Compiled functions can then write ``p[AT.q]`` instead of ``p[16]``, where ``AT`` is a global variable; the index is
    a constant in the machine code.

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

    The functions called at every step (`forcing`, `rhs`, `layers`, `jacobian`, `quantities`) are decorated with
    `jit.inline` and use only arithmetic, `simd` and `vecmath`. They are compiled for groups of lanes: write
    `simd.where_less` for a choice, never ``if``, and products for powers. They return tuples of fixed length; each
    entry must be one number per lane, so write a constant 1 as ``0.0 * x + 1.0``. `constants` and `edges` run once per
    cell (parameter point) on plain numbers and may use anything that numba compiles.

    Before its first run a system is checked on plain numbers (see `checks.check_system`), so that a wrong declaration
    gives an error message and not a wrong result.

    Attributes
    ----------
    name : str
        Name of the compiled code; equal names must mean equal functions.
    parameter_names : tuple of str
        Order of the packed parameter vector.
    n_constants : int
        Length of the vector that `constants` fills.
    constants : callable
        ``constants(frequency, p, out)``: computes, from the drive frequency [Hz] and the packed parameters `p`, the
        constants that `forcing`, `rhs` and `layers` use; fills all of `out` with finite numbers.
    has_poles : bool
        Whether constants may be infinite or NaN; trajectories that use such a constant end with a failure status.
    forcing : callable
        ``forcing(t, c)``: the explicit time dependence, a number, at time `t` [s] since the last section; `c` is
        the tuple of constants. It has the period 1/frequency. None for an autonomous system; 1/frequency is then
        the time between two recorded states.
    forcing_is_time : bool
        Whether `forcing` returns `t` itself, because `rhs` depends on time by more than one number; `rhs` must then
        have the period 1/frequency in `t`.
    rhs : callable
        ``rhs(y, u, c)``: time derivatives as a tuple, from the states `y` and the forcing `u`.
    jacobian : callable
        ``jacobian(y, u, c)``: derivatives of `rhs` by the states, as one flat tuple, row by row. Only Lyapunov
        exponents, multipliers and periodic orbits need it; may be None.
    jacobian_entries : tuple of int or None
        Flat indices (row by row) of the entries that `jacobian` returns, in rising order; all other entries are
        always 0. None if it returns all entries. Declare it for a large system with many zeros.
    is_angle : tuple of bool
        Which states are angles modulo 2 pi; empty for none. They are wrapped to (-pi, pi] at every section, and
        their full turns are counted; `rhs` must not change when 2 pi is added.
    units : tuple of float
        Typical size of each state, the unit in which the engine compares sections; empty for
        `scales`, or 1.
    scales : tuple of float
        Unit in which analyses compare states: the extent of the motion, where it is known; empty for `units`. No
        compiled code depends on it.
    farthest : float
        Largest absolute value of a state in the motion, in units of its scale: far above 1 if states are measured from
        a distant zero.
    sizes : tuple of float
        Unit of each state's absolute tolerance; empty for 1. It is not 1 where the scale was found from the motion.
    escape : tuple of float
        Bound on the absolute value of each state at a section; beyond it a trajectory has diverged. Empty
        for none.
    n_edges : int
        Number of known instants per period at which the forcing switches.
    edges : callable
        ``edges(frequency, p, times, half_widths, jumps)`` fills three arrays: the instants [s] in [0, 1/frequency) in
        rising order; for each instant the distance in time to the forcing's nearest complex singularity [s], above
        0; and the change of the right-hand side across the edge.
    layers : callable
        ``layers(y, dy, c)``: a tuple of ``(value, rate, half_width, per_strength)`` for each layer. The right-hand side
        changes quickly where `value`, with the time derivative `rate`, passes zero. As a function of `value` it has
        its nearest complex singularity at the imaginary part `half_width`, above 0. `per_strength` is
        1/(half_width * jump), where jump is the change of the right-hand side across the layer. None for none.
    has_layers : bool
        False if there are none; `layers` is then never called.
    layers_fade : bool
        Whether every layer has exponential tails, like tanh and unlike atan: at m half-widths, exp(-pi m) of its
        change remains.
    timed_layers : bool
        Whether `layers` needs the time [s since the last section]; it is then appended to the rates, as
        ``dy[n_states]``.
    n_controlled : int or None
        Number of leading states that enter the error control; None for all.
    n_known : int or None
        Number of leading states that the functions take; None for all. The remaining states are tangent vectors, which
        the engine integrates by itself (see `tangents`).
    n_modes : int
        Number of modes. Modes are numbers that `rhs`, `jacobian` and `quantities` find after the constants, as
        ``c[n_constants + k]``. They change only at events and edges and are equal at all stages of a step. First comes
        one for each switch, then one for each impact if any impact sticks, last the segment if `has_segments`.
    n_switches : int
        Number of surfaces at which the right-hand side jumps. Mode k is the sign of switch k, -1.0 or +1.0; `rhs` must
        use it in place of ``sign(value)``. A step ends on the surface, then the mode changes.
    switches : callable
        ``switches(t, y, dy, c)``: a tuple of ``(value, rate)`` for each switch, where `value` is a function of time and
        state, and `rate` its time derivative, linear in `dy`. While mode k is 0 (see `slides`), pair k must be
        ``1 - sigma**2`` and its rate instead, where sigma in [-1, 1] is the equivalent control.
    slides : tuple of bool
        On which switches the state may slide; empty for none. If the rates on both sides point to the surface, the mode
        becomes 0.0, and `rhs` must return the motion along the surface (Filippov's equivalent control). Sliding ends
        where sigma leaves [-1, 1].
    has_segments : bool
        Whether the last mode, ``c[n_constants + n_modes - 1]``, is the number of edges passed in this period: 0.0
        before the first, and so on. A forcing with true jumps can then use the same side of an edge at all stages; its
        half-width may be infinite.
    n_impacts : int
        Number of surfaces at which the state jumps.
    impacts : callable
        ``impacts(t, y, dy, c)``: a tuple of ``(value, rate)``, as for `switches`.
    impact_directions : tuple of int
        +1 if an impact happens where its value rises through zero, -1 where it falls.
    sticks : tuple of int
        For each impact, whether the state rests on its surface after infinitely many impacts in a finite time: 0 no,
        1 yes, 2 yes unless it rests on another surface; empty for none. Each impact then has a mode, after those of
        the switches: 0.0 at rest, else 1.0. At rest, `rhs` must keep value and rate of the impact at 0. Its pair in
        `impacts` is then the negative second derivative that the value would have without the contact, and the rate
        of this number; where it changes its sign, the state lifts off.
    reset : callable
        ``reset(k, t, y, c)``: the states after impact number `k` as a tuple, from the states before. Runs on plain
        numbers, so that ``if k == 0`` is allowed. If impact `i` sticks, ``k = n_impacts + i`` must return the states
        moved to rest on its surface.
    section : (int or None, int) or None
        Index of the state that defines the Poincare section, None if that is `surface`, and the direction of its
        crossing, +1 rising or -1 falling; a period ends there. The level is the last parameter. See
        `crossing.with_section`.
    surface : callable or None
        ``surface(t, y, dy, c)``: a tuple of one pair ``(value, rate)``, as for `switches`: the function of the states
        that crosses the level of the Poincare section, where that is no state. It has the period 2 pi in each angle.
    surface_unit : float
        Typical change of this function as the states change by their `units`.
    quantities : callable or None
        ``quantities(t, y, dy, u, c)``: a tuple of the named quantities at time `t` [s] since the last
        section, from the states, their rates, the forcing and the constants.
    is_map : bool
        Whether this is a map: ``rhs`` then returns the next states in place of rates, and `jacobian` their derivatives.
        A drive period is one iteration, without steps, tolerances and method; nothing depends on time.
    method : str
        Key of `tableau.METHODS`: ``"dopri5"`` of order 5, or ``"dop853"`` of order 8, which needs a half or a quarter
        of the time for smooth equations at tolerances below 1e-6, but gains nothing if layers limit the steps, and
        can neither track quantities nor sample trajectories; ``"rodas5p"``, implicit of order 5, is for stiff systems.
    tangents_of : System or None
        The original system, if this one has tangent vectors added (see `variational.with_tangents`).
    recorded_for : System or None
        The original system, if this one has a recorded drive instead of its forcing (see `driven.with_recorded_drive`).

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
    # `__post_init__` replaces None by a function that does nothing, so that these fields are never None
    forcing: Callable[..., Any] = None  # type: ignore[assignment]
    forcing_is_time: bool = False
    jacobian: Callable[..., Any] | None = None
    jacobian_entries: tuple[int, ...] | None = None
    is_angle: tuple[bool, ...] = ()
    units: tuple[float, ...] = ()
    scales: tuple[float, ...] = ()
    farthest: float = 1.0
    sizes: tuple[float, ...] = ()
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
    section: tuple[int | None, int] | None = None
    surface: Callable[..., Any] | None = None
    surface_unit: float = 1.0
    quantity_names: tuple[str, ...] = ()
    quantities: Callable[..., Any] | None = None
    is_map: bool = False
    method: str = "dopri5"
    tangents_of: System | None = field(default=None, compare=False, repr=False)
    recorded_for: System | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        from magpend_core.engine.placeholders import no_edges, no_forcing, no_layers  # brings the compiler

        n = self.n_states
        absent = {
            "is_angle": (False,) * n,
            "units": tuple(self.scales) or (1.0,) * n,
            "sizes": (1.0,) * n,
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
            "units": float,
            "scales": float,
            "sizes": float,
            "escape": float,
            "slides": bool,
            "impact_directions": int,
            "sticks": int,
        }
        for name, kind in kinds.items():  # tuples of one type: lists have no hash, numba needs equal types in loops
            object.__setattr__(self, name, tuple(kind(value) for value in getattr(self, name)))
        object.__setattr__(self, "has_layers", self.has_layers and self.layers is not None)
        for name, value in absent.items():
            if not getattr(self, name):
                object.__setattr__(self, name, value)
        if not self.scales:
            object.__setattr__(self, "scales", self.units)

    @cached_property
    def plain(self) -> System:
        """The system as the cells of a run are integrated, with its `units` in place of the extent of the motion."""
        return replace(self, scales=self.units, farthest=1.0)

    @property
    def functions(self) -> tuple[Callable[..., Any], ...]:
        """The compiled functions that the system has, in a fixed order."""
        always = self.constants, self.forcing, self.rhs, self.edges, self.layers
        others = self.jacobian, self.quantities, self.switches, self.impacts, self.reset, self.surface
        return (*always, *(f for f in others if f is not None))

    @property
    def label(self) -> str:
        """Name of the compiled code: `name`, and a digest of the data that goes into the code."""
        data = (
            self.state_names,
            self.is_angle,
            self.units,
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
        if any(size != 1.0 for size in self.sizes):
            data += (self.sizes,)  # type: ignore[assignment]
        if self.is_map:
            data += ("map",)  # type: ignore[assignment]
        elif self.method != "dopri5":
            data += (self.method,)  # type: ignore[assignment]
        if self.n_known is not None or self.jacobian_entries is not None:
            data += (self.n_known, self.jacobian_entries)  # type: ignore[assignment]
        return f"{self.name}_{hashlib.sha256(repr(data).encode()).hexdigest()[:8]}"

    @property
    def tableau(self) -> Tableau:
        """Runge-Kutta coefficients of the system's `method`; of a map `ITERATION`."""
        from magpend_core.engine.tableau import ITERATION, METHODS

        if self.is_map:
            return ITERATION
        if self.method not in METHODS:
            known = ", ".join(METHODS)
            raise ValueError(f"method = {self.method!r}: {self.name} can be integrated by {known}.")
        return METHODS[self.method]

    @property
    def is_stiff(self) -> bool:
        """Whether the system is integrated by an implicit method, which solves linear systems with the Jacobian."""
        return self.tableau.implicit is not None

    @property
    def n_events(self) -> int:
        """Number of event functions; steps end at their zeros."""
        return self.n_switches + self.n_impacts + (self.section is not None)

    @property
    def n_surfaces(self) -> int:
        """Number of event functions that do not follow the cubics of the states: those of switches, impacts, and a
        section at a level of the `surface`.
        """
        is_expression = self.section is not None and self.section[0] is None
        return self.n_switches + self.n_impacts + is_expression

    @property
    def n_contacts(self) -> int:
        """Number of contact modes, which say whether the state rests on an impact surface: one per impact, or 0."""
        return self.n_impacts if any(self.sticks) else 0

    @property
    def controlled(self) -> int:
        """Number of leading states that enter the error control of the steps."""
        return self.n_states if self.n_controlled is None else self.n_controlled

    @property
    def known(self) -> int:
        """Number of states passed to `rhs` and the other functions. The tangent vectors of a large system are not
        passed.
        """
        return self.n_states if self.n_known is None else self.n_known

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.state_names)
