"""Convert Floquet multipliers of a periodic orbit to Lyapunov exponents."""

from __future__ import annotations

import numpy as np


def orbit_exponents(multipliers: np.ndarray, seconds: float, is_flow: bool = False) -> np.ndarray:
    """Return a periodic orbit's Lyapunov exponents [1/s], in falling order, from its multipliers.

    Parameters
    ----------
    multipliers
        Shape (n_states,), by falling modulus.
    seconds
        The orbit's period [s].
    is_flow
        Whether they are those of a return map: the least of them stands for the flow's own direction, whose
        exponent is 0.
    """
    rates = np.log(np.maximum(np.abs(multipliers), 1e-300)) / seconds
    return np.sort(np.append(rates[:-1], 0.0))[::-1] if is_flow else rates
