"""Runge-Kutta methods of Dormand and Prince: of order 5, with its continuous extension, and of order 8."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

# Dormand and Prince, J. Comput. Appl. Math. 6 (1980) 19-26, RK5(4)7M
NODES = np.array([0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
STAGES = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0],
        [44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0],
        [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
ERROR = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
N_STAGES = 7

# Continuous extension of order 4 of the Dormand-Prince pair: y(t + x h) = y + h sum_i k_i P_i(x),
# P_i(x) = sum_j DENSE[i, j] x^(j + 1). Shampine, Math. Comp. 46 (1986) 135-150.
DENSE = np.array(
    [
        [1.0, -8048581381 / 2820520608, 8663915743 / 2820520608, -12715105075 / 11282082432],
        [0.0, 0.0, 0.0, 0.0],
        [0.0, 131558114200 / 32700410799, -68118460800 / 10900136933, 87487479700 / 32700410799],
        [0.0, -1754552775 / 470086768, 14199869525 / 1410260304, -10690763975 / 1880347072],
        [0.0, 127303824393 / 49829197408, -318862633887 / 49829197408, 701980252875 / 199316789632],
        [0.0, -282668133 / 205662961, 2019193451 / 616988883, -1453857185 / 822651844],
        [0.0, 40617522 / 29380423, -110615467 / 29380423, 69997945 / 29380423],
    ]
)

MIDDLE = DENSE @ 0.5 ** np.arange(1.0, 5.0)
"""Weights of the slopes at the middle of a step."""


class Tableau(NamedTuple):
    """Coefficients of an explicit Runge-Kutta method whose last stage is the new state (first same as last).

    Attributes
    ----------
    nodes : ndarray, (n_stages,)
    stages : ndarray, (n_stages, n_stages - 1)
        Weights of the slopes in the state of each stage.
    error : ndarray, (n_stages,)
        Weights of the slopes in the estimate of the error.
    other_error : ndarray, (n_stages,)
        In a second estimate, of lower order; zeros for none.
    order : int
        Of the estimate that steps are chosen by.
    """

    nodes: np.ndarray
    stages: np.ndarray
    error: np.ndarray
    other_error: np.ndarray
    order: int

    @property
    def n_stages(self) -> int:
        """Number of stages of the method; the last stage is the new state."""
        return len(self.nodes)

    @property
    def has_two_errors(self) -> bool:
        """Whether the method combines error estimates of two orders."""
        return bool(self.other_error.any())


def _filled(rows: Sequence[Mapping[int, float]], n: int) -> np.ndarray:
    full = np.zeros((len(rows), n))
    for s, row in enumerate(rows):
        full[s, list(row)] = list(row.values())
    return full


# Dormand and Prince's method of order 8 with estimates of orders 5 and 3: Hairer, Norsett and Wanner, Solving
# Ordinary Differential Equations I, 2nd ed. (1993), section II.10; figures of their DOP853. Zeros left out.
_NODES_8 = [
    0.0,
    0.05260015195876773,
    0.0789002279381516,
    0.1183503419072274,
    0.2816496580927726,
    0.3333333333333333,
    0.25,
    0.3076923076923077,
    0.6512820512820513,
    0.6,
    0.8571428571428571,
    1.0,
    1.0,
]
_STAGES_8: list[dict[int, float]] = [
    {},
    {0: 0.05260015195876773},
    {0: 0.0197250569845379, 1: 0.0591751709536137},
    {0: 0.02958758547680685, 2: 0.08876275643042054},
    {0: 0.2413651341592667, 2: -0.8845494793282861, 3: 0.924834003261792},
    {0: 0.037037037037037035, 3: 0.17082860872947386, 4: 0.12546768756682242},
    {0: 0.037109375, 3: 0.17025221101954405, 4: 0.06021653898045596, 5: -0.017578125},
    {
        0: 0.03709200011850479,
        3: 0.17038392571223998,
        4: 0.10726203044637328,
        5: -0.015319437748624402,
        6: 0.008273789163814023,
    },
    {
        0: 0.6241109587160757,
        3: -3.3608926294469414,
        4: -0.868219346841726,
        5: 27.59209969944671,
        6: 20.154067550477894,
        7: -43.48988418106996,
    },
    {
        0: 0.47766253643826434,
        3: -2.4881146199716677,
        4: -0.590290826836843,
        5: 21.230051448181193,
        6: 15.279233632882423,
        7: -33.28821096898486,
        8: -0.020331201708508627,
    },
    {
        0: -0.9371424300859873,
        3: 5.186372428844064,
        4: 1.0914373489967295,
        5: -8.149787010746927,
        6: -18.52006565999696,
        7: 22.739487099350505,
        8: 2.4936055526796523,
        9: -3.0467644718982196,
    },
    {
        0: 2.273310147516538,
        3: -10.53449546673725,
        4: -2.0008720582248625,
        5: -17.9589318631188,
        6: 27.94888452941996,
        7: -2.8589982771350235,
        8: -8.87285693353063,
        9: 12.360567175794303,
        10: 0.6433927460157636,
    },
    {
        0: 0.054293734116568765,
        5: 4.450312892752409,
        6: 1.8915178993145003,
        7: -5.801203960010585,
        8: 0.3111643669578199,
        9: -0.1521609496625161,
        10: 0.20136540080403034,
        11: 0.04471061572777259,
    },
]
_ERROR_5: dict[int, float] = {
    0: 0.01312004499419488,
    5: -1.2251564463762044,
    6: -0.4957589496572502,
    7: 1.6643771824549864,
    8: -0.35032884874997366,
    9: 0.3341791187130175,
    10: 0.08192320648511571,
    11: -0.022355307863886294,
}
_ERROR_3: dict[int, float] = {
    0: -0.18980075407240762,
    5: 4.450312892752409,
    6: 1.8915178993145003,
    7: -5.801203960010585,
    8: -0.4226823213237919,
    9: -0.1521609496625161,
    10: 0.20136540080403034,
    11: 0.02265179219836082,
}

_ERRORS_8 = _filled([_ERROR_5, _ERROR_3], 13)

METHODS = {
    "dopri5": Tableau(NODES, STAGES, ERROR, np.zeros(N_STAGES), 5),
    "dop853": Tableau(np.array(_NODES_8), _filled(_STAGES_8, 12), _ERRORS_8[0], _ERRORS_8[1], 8),
}
"""Methods by name, as given by their authors."""

ITERATION = Tableau(np.zeros(2), np.zeros((2, 1)), np.zeros(2), np.zeros(2), 1)
"""What stands for a method in a system that is a map: its one stage after the first evaluates the map at the state."""
