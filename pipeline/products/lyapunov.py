"""Declare the product ``lyapunov``: Lyapunov exponents of each cell. The integration continues from the cell's last
section point.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import IntEnum
from typing import Any

from pipeline.products.product import CellProduct, Options, Variable, flag_attrs, option

TANGENT_COST, MORE_COST, FEW = 2.0, 1.8, 4
"""Cost of a period with up to `FEW` tangent vectors, and of each further vector, in plain periods.

Measured with the pendulum (1.6 for one vector, 2 for all four) and with Lorenz-96 (16 for 12, 73 for 40).
"""


class LyapunovOptions(Options):
    """Options of the product ``lyapunov`` in a specification's table ``[products]``."""

    n_exponents: int | None = option(
        None, "Number of exponents, from the largest on; by default one for each state.", ge=1
    )
    n_transient: int = option(
        200, "Time in which the tangent vectors align.", unit="drive periods or returns", ge=0, le=1_000_000
    )
    n_periods: int = option(
        400,
        "Time over which growth is averaged, rounded up to blocks of equal length.",
        unit="drive periods or returns",
        ge=2,
        le=100_000_000,
    )
    n_blocks: int = option(16, "Number of blocks of that time, for standard errors.", ge=2, le=1000)


class LyapunovFlag(IntEnum):
    """Flag for the reliability of a cell's Lyapunov exponents."""

    ABSENT = 0
    GOOD = 1
    AUDIT_FAILED = 2
    UNRESOLVED = 3
    FAILED = 4

    @property
    def sentence(self) -> str:
        """Meaning of the flag, as text."""
        return _FLAG_SENTENCES[self]


_FLAG_SENTENCES = {
    LyapunovFlag.ABSENT: "pending, or the cell has no attractor to go on from",
    LyapunovFlag.GOOD: "no objection",
    LyapunovFlag.AUDIT_FAILED: "the exponents do not add up to the divergence, or none of a flow's is "
    "near 0; use a smaller rtol",
    LyapunovFlag.UNRESOLVED: "tangent vectors became parallel; only the first exponent is resolved",
    LyapunovFlag.FAILED: "the integration failed",
}

LYAPUNOV_VARIABLES = (
    Variable(
        "lyapunov",
        ("exponent",),
        "float64",
        math.nan,
        "1/s",
        "Lyapunov exponents per unit time, in falling order",
        {
            "comment": "divided by the frequency: per drive period. Plain averages; weighted Birkhoff averages "
            "where the orbit is closed"
        },
    ),
    Variable("lyapunov_stderr", ("exponent",), "float64", math.nan, "1/s", "standard error over the blocks"),
    Variable(
        "lyapunov_blocks",
        ("block", "exponent"),
        "float64",
        math.nan,
        "1/s",
        "mean growth rate in each block of drive periods",
    ),
    Variable("divergence", (), "float64", math.nan, "1/s", "time average of the flow's divergence"),
    Variable(
        "lyapunov_flag", (), "int8", int(LyapunovFlag.ABSENT), "1", "trust in the exponents", flag_attrs(LyapunovFlag)
    ),
)
"""Variables of ``[products] lyapunov``."""


def _variables(options: LyapunovOptions, model: Any) -> tuple[Variable, ...]:
    if model.clock.is_continuous:
        return LYAPUNOV_VARIABLES
    words = {
        "lyapunov": "Lyapunov exponents per iteration, in falling order",
        "lyapunov_blocks": "mean growth rate in each block of iterations",
        "divergence": "mean logarithm of the change of volumes in an iteration",
    }
    return tuple(
        replace(v, units="1", long_name=words.get(v.name, v.long_name), attrs={}) if v.units == "1/s" else v
        for v in LYAPUNOV_VARIABLES
    )


def _sizes(options: LyapunovOptions, model: Any) -> dict[str, int]:
    return {"exponent": _settled(options, model).n_exponents or 0, "block": options.n_blocks}


def _settled(options: LyapunovOptions, model: Any) -> LyapunovOptions:
    from magpend_core.sizes import too_many_states

    n = len(model.states)
    problem = too_many_states(model.name, n)
    if problem is not None:
        raise ValueError(f"n_exponents: {problem}")
    if options.n_exponents is not None and options.n_exponents > n:
        raise ValueError(
            f"n_exponents = {options.n_exponents}: must be at most {n}, the number of states of {model.name}."
        )
    n_periods = -(-options.n_periods // options.n_blocks) * options.n_blocks
    return options.model_copy(update={"n_exponents": options.n_exponents or n, "n_periods": n_periods})


def _numbers(options: LyapunovOptions, model: Any) -> dict[str, Any]:
    return {"exponent": range(1, (_settled(options, model).n_exponents or 0) + 1)}


def _cost(options: LyapunovOptions) -> float:
    per_period = TANGENT_COST + MORE_COST * max(0, (options.n_exponents or 0) - FEW)
    return per_period * (options.n_transient + options.n_periods)


def _shortest(options: LyapunovOptions) -> LyapunovOptions:
    return options.model_copy(update={"n_transient": 0, "n_periods": 2, "n_blocks": 2})


LYAPUNOV = CellProduct(
    "lyapunov",
    "Lyapunov exponents along each cell's attractor, with errors, convergence and an audit.",
    LyapunovOptions,
    _variables,
    _sizes,
    _cost,
    "pipeline.compute.exponents:exponents",
    settle=_settled,
    coordinates=_numbers,
    shortest=_shortest,
)
