"""Stiff problems with known ends, as text: for tests and benchmarks of stiff methods.

Hairer and Wanner, Solving Ordinary Differential Equations II (2nd ed. 1996), IV.10; Mazzia and Magherini, Test Set
for Initial Value Problem Solvers, release 2.4 (Bari 2008), whose ends were computed by RADAU at 1e-18. heyoka at 1e-17
gives those of HIRES, OREGO and van der Pol's oscillator to 6e-14.

All begin at t = 0. The end is the state after one period of the clock, which models without a drive have, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi, sin

from magpend_core.models.model import Model
from magpend_core.models.text import read_model
from tests.core.flows import table


@dataclass(frozen=True)
class Stiff:
    """A stiff problem.

    Attributes
    ----------
    table : dict
        The model as text; the `size` of a state is the unit of its absolute tolerance, and of its errors where it is
        smaller.
    start : tuple of float
        State at t = 0.
    time : float
        When the end is taken [s].
    end : tuple of float
        State there, to ten digits or more.
    source : str
        Where problem and end come from.
    """

    table: Mapping[str, object]
    start: tuple[float, ...]
    time: float
    end: tuple[float, ...]
    source: str

    @property
    def model(self) -> Model:
        """The model."""
        return read_model(self.table)

    @property
    def sizes(self) -> tuple[float, ...]:
        """Sizes of the states."""
        return tuple(state.size for state in self.model.states)


def _sized(names: str, *sizes: float) -> dict[str, object]:
    return {name: {"size": size} for name, size in zip(names.split(), sizes, strict=True)}


HIRES = Stiff(
    table(
        "hires",
        {
            "y1": "-1.71*y1 + 0.43*y2 + 8.32*y3 + 0.0007",
            "y2": "1.71*y1 - 8.75*y2",
            "y3": "-10.03*y3 + 0.43*y4 + 0.035*y5",
            "y4": "8.32*y2 + 1.71*y3 - 1.12*y4",
            "y5": "-1.745*y5 + 0.43*y6 + 0.43*y7",
            "y6": "-280*y6*y8 + 0.69*y4 + 1.71*y5 - 0.43*y6 + 0.69*y7",
            "y7": "280*y6*y8 - 1.81*y7",
            "y8": "-280*y6*y8 + 1.81*y7",
        },
        states=_sized("y1 y2 y3 y4 y5 y6 y7 y8", *8 * [1e-3]),
    ),
    (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057),
    321.8122,
    (
        0.7371312573325668e-3,
        0.1442485726316185e-3,
        0.5888729740967575e-4,
        0.1175651343283149e-2,
        0.2386356198831331e-2,
        0.6238968252742796e-2,
        0.2849998395185769e-2,
        0.2850001604814231e-2,
    ),
    "Schaefer (1975): high irradiance responses of a plant; end of the test set",
)
"""y7 + y8 keeps its value, 0.0057."""

ROBER = Stiff(
    table(
        "rober",
        {"y1": "back - away", "y2": "away - back - pair", "y3": "pair"},
        {"k1": 0.04, "k2": 3e7, "k3": 1e4},
        define={"away": "k1*y1", "back": "k3*y2*y3", "pair": "k2*y2**2"},
        states=_sized("y1 y2 y3", 1e-7, 1e-13, 1.0),
    ),
    (1.0, 0.0, 0.0),
    1e11,
    (0.2083340149701255e-07, 0.8333360770334713e-13, 0.9999999791665050),
    "Robertson (1966): an autocatalytic reaction; end of the test set",
)
"""The sum of the states keeps its value, 1."""

OREGO = Stiff(
    table(
        "orego",
        {"y1": "s*(y2 + y1*(1 - q*y1 - y2))", "y2": "(y3 - (1 + y1)*y2)/s", "y3": "w*(y1 - y3)"},
        {"s": 77.27, "w": 0.161, "q": 8.375e-6},
    ),
    (1.0, 2.0, 3.0),
    360.0,
    (0.1000814870318523e1, 0.1228178521549917e4, 0.1320554942846706e3),
    "Field and Noyes (1974): the Oregonator; end of the test set",
)

VAN_DER_POL = Stiff(
    table("stiff_van_der_pol", {"y": "z", "z": "mu**2*((1 - y**2)*z - y)"}, {"mu": 1e3}),
    (2.0, 0.0),
    2.0,
    (0.1706167732170483e1, -0.8928097010247975),
    "van der Pol's oscillator at mu = 1000, in units of mu of time; end of the test set",
)

HODGKIN_HUXLEY = Stiff(
    table(
        "hodgkin_huxley",
        {
            "V": "(I - gNa*m**3*h*(V - ENa) - gK*n**4*(V - EK) - gL*(V - EL))/C",
            "m": "ratio((25 - V)/10)*(1 - m) - 4*exp(-V/18)*m",
            "h": "0.07*exp(-V/20)*(1 - h) - h/(exp((30 - V)/10) + 1)",
            "n": "0.1*ratio((10 - V)/10)*(1 - n) - 0.125*exp(-V/80)*n",
        },
        {"I": 10.0, "C": 1.0, "gNa": 120.0, "gK": 36.0, "gL": 0.3, "ENa": 115.0, "EK": -12.0, "EL": 10.613},
        # x/(exp(x) - 1), and 1 at x = 0
        define={"ratio(x)": "(x + 1e-30)/(exp(x + 1e-30) - 1)"},
    ),
    (0.0, 0.05, 0.6, 0.32),
    50.0,
    (-8.806096953613, 0.01751138718736, 0.2269691456858, 0.5961428781016),
    "Hodgkin and Huxley, J. Physiol. 117 (1952) 500-544, with V [mV] from rest, upwards in a spike, and time in ms; "
    "end by heyoka at 1e-17, from which scipy's Radau at 1e-12 differs by 2e-12",
)

PROTHERO_ROBINSON = Stiff(
    table(
        "prothero_robinson",
        {"y": "-lamda*(y - sin(turn)) + 2*pi*f*cos(turn)"},
        {"lamda": 1e6},
        define={"turn": "2*pi*f*t + 1"},
    ),
    (sin(1.0),),
    2.0 * pi,
    (sin(1.0),),
    "Prothero and Robinson, Math. Comp. 28 (1974) 145: y = sin(t + 1)",
)

CONTACT = Stiff(
    table(
        "stiff_contact",
        {"x": "v", "v": "-d*v - x - x**3 + A*cos(2*pi*f*t - 2) - where(x > gap, k*(x - gap) + 2*sqrt(k)*v, 0)"},
        {"d": 0.1, "A": 5.0, "gap": 1.0, "k": 1e7},
    ),
    (0.0, 1.0),
    2.0 * pi,
    (0.1616066051357, 2.117256744402),
    "a driven Duffing oscillator that rests on a critically damped spring of 1e7 from t = 1.32 to 3.16; end by heyoka "
    "at 1e-17 with events, from which this engine's method of order 5 at 1e-13 differs by 1e-12",
)

PROBLEMS = {
    "hires": HIRES,
    "rober": ROBER,
    "orego": OREGO,
    "van der pol": VAN_DER_POL,
    "hodgkin-huxley": HODGKIN_HUXLEY,
    "prothero-robinson": PROTHERO_ROBINSON,
    "contact": CONTACT,
}
"""All by name."""
