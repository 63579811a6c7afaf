"""Check numerical arguments: each error names the argument, the value and the bound."""

from __future__ import annotations

from typing import Any

import numpy as np


def check_array(name: str, values: Any, ndim: int | tuple[int, ...]) -> np.ndarray:
    """Return `values` as a contiguous float64 array of finite numbers with `ndim` dimensions.

    Raises
    ------
    ValueError
        If the shape does not fit, a number is not finite or an entry is masked.
    """
    _refuse_masks(name, values)
    array = np.asarray(values, dtype=np.float64, order="C")
    allowed = (ndim,) if isinstance(ndim, int) else ndim
    if array.ndim not in allowed:
        wanted = " or ".join(str(n) for n in allowed)
        raise ValueError(f"{name} has {array.ndim} dimensions (shape {array.shape}); it must have {wanted}.")
    finite = np.isfinite(array)
    if not finite.all():
        where = tuple(int(i) for i in np.argwhere(~finite)[0])
        entry = name + (str(list(where)) if where else "")
        raise ValueError(f"{entry} = {array[where]} is not finite; give finite numbers.")
    return array


def _refuse_masks(name: str, values: Any) -> None:
    parts = values if isinstance(values, (list, tuple)) else [values]
    n_masked = sum(int(np.ma.getmaskarray(p).sum()) for p in parts if isinstance(p, np.ma.MaskedArray))
    if n_masked:
        raise ValueError(
            f"{name} has {n_masked} masked entries; leave these out, or fill them with numbers (.filled())."
        )


def check_times(values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return finite times as an array of a given shape; a single time is broadcast.

    Raises
    ------
    ValueError
        See `check_array`; or if the shapes do not go together.
    """
    array = check_array("t", values, tuple(range(len(shape) + 1)))
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise ValueError(f"t has shape {array.shape}; it must be one number, or one per state: {shape}.") from None


def check_states(values: Any, ndim: int | tuple[int, ...], n_states: int, name: str = "state") -> np.ndarray:
    """Return states as an array whose last dimension has `n_states` entries.

    Raises
    ------
    ValueError
        See `check_array`.
    """
    array = check_array(name, values, ndim)
    if array.shape[-1] != n_states:
        raise ValueError(
            f"{name} has {array.shape[-1]} numbers per state (shape {array.shape}); it must have {n_states}."
        )
    return array


def check_frequency(values: Any, ndim: int | tuple[int, ...]) -> np.ndarray:
    """Return drive frequencies [Hz] as an array; raise if one is not positive.

    Raises
    ------
    ValueError
        See `check_array`; or if a frequency is not positive.
    """
    array = check_array("frequency_hz", values, ndim)
    if (array <= 0.0).any():
        bad = array[array <= 0.0].flat[0]
        raise ValueError(f"frequency_hz = {bad} is out of bounds: it must be greater than 0.")
    return array


def check_count(name: str, value: Any, least: int) -> int:
    """Return a whole number; raise if it is below `least`.

    Raises
    ------
    ValueError
        If it is not a whole number or too small.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise ValueError(f"{name} = {value!r} is not a whole number; give an integer of {least} or more.")
    if value < least:
        raise ValueError(f"{name} = {value} is out of bounds: it must be {least} or more.")
    return int(value)


def check_flag(name: str, value: Any) -> bool:
    """Return a truth value; raise for anything but True and False, such as the text ``"no"``.

    Raises
    ------
    ValueError
        If it is neither True nor False.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name} = {value!r} is neither True nor False; give one of them.")
    return bool(value)


def check_tolerance(name: str, value: Any, least: float = 0.0) -> float:
    """Return a tolerance as a number; raise if it is not positive, at least `least` and below 1.

    Raises
    ------
    ValueError
        If it is not a number in these bounds.
    """
    number = float(check_array(name, value, 0))
    if not max(least, 0.0) <= number < 1.0 or number == 0.0:
        bound = f"at least {least:g} and less than 1" if least else "greater than 0 and less than 1"
        raise ValueError(f"{name} = {number:g} is out of bounds: it must be {bound}.")
    return number
