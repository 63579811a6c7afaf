"""List the entries that a system's Jacobian function returns, and expand them to the whole matrix."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from magpend_core.engine.system import System


def places_of(system: System) -> Sequence[int]:
    """Return the flat indices, row by row, of the Jacobian entries that `system.jacobian` returns."""
    return range(system.n_states**2) if system.jacobian_entries is None else system.jacobian_entries


def rows_of_entries(system: System) -> list[dict[int, int]]:
    """Return one dict per row of the Jacobian. It maps the column of an entry to the entry's index in the tuple from
    `system.jacobian`.
    """
    n = system.n_states
    rows: list[dict[int, int]] = [{} for _ in range(n)]
    for k, place in enumerate(places_of(system)):
        rows[place // n][place % n] = k
    return rows


def whole_jacobian(system: System, entries: np.ndarray) -> np.ndarray:
    """Expand the returned Jacobian entries, shape (..., n_entries), to full matrices, shape (..., n_states,
    n_states).
    """
    n, leading = system.n_states, entries.shape[:-1]
    whole = np.zeros((*leading, n * n))
    whole[..., list(places_of(system))] = entries
    return whole.reshape((*leading, n, n))


def declaration_problems(system: System) -> Iterator[str]:
    """Yield a problem if a system's `jacobian_entries` are not valid indices in rising order."""
    most, entries = system.n_states**2 - 1, system.jacobian_entries
    good = sorted({i for i in entries or () if 0 <= i <= most})
    if entries is not None and (not entries or list(entries) != good):
        yield f"jacobian_entries must be whole numbers from 0 to {most} in rising order, one at least."
