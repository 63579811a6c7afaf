"""Coefficients of the integration methods.

Explicit Runge-Kutta methods are those of Dormand and Prince: of order 5, with its continuous extension, and of order 8.
For stiff systems there is Steinebach's Rosenbrock method of order 5.
"""

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


class Tableau(NamedTuple):
    """Coefficients of a method whose last stage is the new state (first same as last).

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
    dense : ndarray, (n_stages, 4)
        Of the continuous extension y(t + x h) = y + h sum_i k_i P_i(x) with the slopes k_i and
        P_i(x) = sum_j dense[i, j] x^(j + 1); zeros for none.
    implicit : Implicit or None
        What a Rosenbrock method has besides. Its slopes between the first and the last are solutions of linear systems.
    """

    nodes: np.ndarray
    stages: np.ndarray
    error: np.ndarray
    other_error: np.ndarray
    order: int
    dense: np.ndarray
    implicit: Implicit | None = None

    @property
    def n_stages(self) -> int:
        """Number of stages of the method; the last stage is the new state."""
        return len(self.nodes)

    @property
    def has_two_errors(self) -> bool:
        """Whether the method combines error estimates of two orders."""
        return bool(self.other_error.any())

    @property
    def is_continuous(self) -> bool:
        """Whether the method has a continuous extension."""
        return bool(self.dense.any())

    @property
    def middle(self) -> np.ndarray:
        """Weights of the slopes at the middle of a step, shape (n_stages,)."""
        return np.asarray(self.dense @ 0.5 ** np.arange(1.0, 5.0))


class Implicit(NamedTuple):
    """Coefficients of a Rosenbrock method, in the form without products of the Jacobian J and vectors.

    With the rates f(t, y) and their derivative T by time, slope k_i of stage i is the solution of

        (1/(gamma h) - J) h k_i = f(t + nodes_i h, y + h sum_j stages_ij k_j) + sum_j couplings_ij k_j + h shifts_i T.

    Attributes
    ----------
    gamma : float
    couplings : ndarray, (n_stages, n_stages)
    shifts : ndarray, (n_stages,)
    """

    gamma: float
    couplings: np.ndarray
    shifts: np.ndarray


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

# Steinebach's Rodas5P, of order 5, stiffly accurate and L-stable: G. Steinebach, BIT Numer. Math. 63 (2023) 27, with
# the coefficients of OrdinaryDiffEq.jl (MIT licence) to all digits. Stages there are numbered from 1; slope 0 here is
# the rate at the step's begin, and slope 9 that at its end.
_GAMMA = 0.21193756319429014
_NODES_P = [
    0.0,
    0.0,
    0.6358126895828704,
    0.4095798393397535,
    0.9769306725060716,
    0.4288403609558664,
    1.0,
    1.0,
    1.0,
    1.0,
]
_LAST_P = [-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946]
_STAGES_P = [
    [],
    [],
    [3.0],
    [2.849394379747939, 0.45842242204463923],
    [-6.954028509809101, 2.489845061869568, -10.358996098473584],
    [2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641],
    _LAST_P,
    [*_LAST_P, 1.0],
    [*_LAST_P, 1.0, 1.0],
    [*_LAST_P, 1.0, 1.0, 1.0],
]
_COUPLINGS_P = [
    [],
    [],
    [-14.155112264123755],
    [-17.97296035885952, -2.859693295451294],
    [147.12150275711716, -1.41221402718213, 71.68940251302358],
    [165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306],
    [24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471],
    [
        30.91273214028599,
        -3.1208243349937974,
        77.79954646070892,
        34.28646028294783,
        -19.097331116725623,
        -28.087943162872662,
    ],
    [
        37.80277123390563,
        -3.2571969029072276,
        112.26918849496327,
        66.9347231244047,
        -40.06618937091002,
        -54.66780262877968,
        -9.48861652309627,
    ],
    [],
]
_SHIFTS_P = [
    0.0,
    0.21193756319429014,
    -0.42387512638858027,
    -0.3384627126235924,
    1.8046452872882734,
    2.325825639765069,
    *[0.0] * 4,
]
# of x (1 - x) times 1, x and x^2 in the continuous extension, of order 4
_BENDS_P = [
    [
        25.948786856663858,
        -2.5579724845846235,
        10.433815404888879,
        -2.3679251022685204,
        0.524948541321073,
        1.1241088310450404,
        0.4272876194431874,
        -0.17202221070155493,
    ],
    [
        -9.91568850695171,
        -0.9689944594115154,
        3.0438037242978453,
        -24.495224566215796,
        20.176138334709044,
        15.98066361424651,
        -6.789040303419874,
        -6.710236069923372,
    ],
    [
        11.419903575922262,
        2.8879645146136994,
        72.92137995996029,
        80.12511834622643,
        -52.072871366152654,
        -59.78993625266729,
        -0.15582684282751913,
        4.883087185713722,
    ],
]


def _shifted(rows: Sequence[Sequence[float]], n: int) -> np.ndarray:
    """Return rows of coefficients of the slopes 1, 2, ... as a matrix with n columns."""
    return _filled([{1 + j: value for j, value in enumerate(row)} for row in rows], n)


def _rodas5p() -> Tableau:
    n = len(_NODES_P)
    stages = _shifted(_STAGES_P, n - 1)
    error = np.zeros(n)
    error[8] = 1.0
    a, b, c = _shifted(_BENDS_P, n)
    dense = np.stack([np.append(stages[-1], 0.0) + a, b - a, c - b, -c], axis=1)
    implicit = Implicit(_GAMMA, _shifted(_COUPLINGS_P, n), np.array(_SHIFTS_P))
    return Tableau(np.array(_NODES_P), stages, error, np.zeros(n), 5, dense, implicit)


METHODS = {
    "dopri5": Tableau(NODES, STAGES, ERROR, np.zeros(N_STAGES), 5, DENSE),
    "dop853": Tableau(np.array(_NODES_8), _filled(_STAGES_8, 12), _ERRORS_8[0], _ERRORS_8[1], 8, np.zeros((13, 4))),
    "rodas5p": _rodas5p(),
}
"""Methods by name, as given by their authors."""

ITERATION = Tableau(np.zeros(2), np.zeros((2, 1)), np.zeros(2), np.zeros(2), 1, np.zeros((2, 4)))
"""What stands for a method in a system that is a map: its one stage after the first evaluates the map at the state."""
