"""Orbits of the Henon map x' = 1 - 1.4 x^2 + y, y' = .3 x, whose numbers are known."""

from __future__ import annotations

import numpy as np


def henon(n_cells, n, seed=0, n_transient=200):
    """Sections (cell, n, 2) after a transient."""
    x, y = np.random.default_rng(seed).uniform(-0.1, 0.1, (2, n_cells))
    section = np.empty((n_cells, n, 2))
    for i in range(-n_transient, n):
        x, y = 1.0 - 1.4 * x * x + y, 0.3 * x
        if i >= 0:
            section[:, i] = np.stack([x, y], axis=-1)
    return section


def slopes_of(section):
    """Derivatives (cell, n, 2, 2) of the map at the sections."""
    slopes = np.zeros((*section.shape, 2))
    slopes[..., 0, 1], slopes[..., 1, 0] = 1.0, 0.3
    slopes[..., 0, 0] = -2.8 * section[..., 0]
    return slopes
