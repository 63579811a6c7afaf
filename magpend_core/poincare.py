"""Use the Poincare section of a flow as a surface in state space: normals, nearest points, the map of tangent vectors.

The return map of a flow takes a point of the surface to its next crossing. With the flow's monodromy matrix Phi over
that time, its rates f at the image, and the normals n of the surface, its derivative is (1 - f n^T/(n^T f)) Phi on
vectors along the surface (Parker & Chua, Practical Numerical Algorithms for Chaotic Systems, 1989, Sect. D.2). Points
beside the surface are moved onto it along one state, so that the derivative by this state is 0. So is one multiplier,
which stands for the flow's own, 1 along the orbit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magpend_core.engine.system import System
from magpend_core.pointwise import surface_packed
from magpend_core.sizes import LEVEL

STEPS = 20
"""Most Newton steps onto a surface."""

ROUNDED = 1e-14
"""Distance from the surface that is rounding, in units of the terms of its function."""

NEAR = 1e-9
"""Largest distance from the surface after the last step, in units of `System.surface_unit`."""


@dataclass(frozen=True)
class Section:
    """Poincare section of a flow at the level of a state or of the system's `surface`.

    Parameters of many points have a row for each point; `states` have the shape (n, n_states).
    """

    system: System

    @property
    def state(self) -> int | None:
        """Index of the state that crosses the level; None if that is the `surface`."""
        assert self.system.section is not None
        return self.system.section[0]

    @property
    def sign(self) -> int:
        """Direction of the crossing: +1 rising, -1 falling."""
        assert self.system.section is not None
        return self.system.section[1]

    def values(self, states: np.ndarray, packed: np.ndarray) -> np.ndarray:
        """Return what crosses the level, shape (n,)."""
        if self.state is not None:
            return np.asarray(states[:, self.state])
        return surface_packed(self.system, states, packed)[:, 0]

    def levels(self, packed: np.ndarray) -> np.ndarray:
        """Return the level, shape (n,)."""
        return np.asarray(packed[..., self.system.parameter_names.index(LEVEL)])

    def normals(self, states: np.ndarray, packed: np.ndarray) -> np.ndarray:
        """Return the derivatives by the states of what crosses the level, shape (n, n_states)."""
        if self.state is not None:
            return np.tile(np.eye(self.system.n_states)[self.state], (len(states), 1))
        return surface_packed(self.system, states, packed)[:, 1:]

    def scaled_normals(self, states: np.ndarray, packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the normals in the scales of the states as unit vectors (n, n_states), and their former lengths."""
        normals = self.normals(states, packed) * np.asarray(self.system.scales)
        lengths = np.sqrt((normals**2).sum(axis=1))
        return normals / lengths[:, None], lengths

    def placed(self, points: np.ndarray, packed: np.ndarray) -> np.ndarray:
        """Move points (..., n_states) onto the section along one state; NaN where that leads to no point of it.

        It is the state that crosses, or the one by which the `surface` changes most.
        """
        moved = np.array(points, dtype=np.float64)
        if self.state is not None:
            moved[..., self.state] = self.levels(packed)
            return moved
        flat = moved.reshape(-1, moved.shape[-1])
        n = packed.shape[-1]
        rows = np.broadcast_to(packed, (*moved.shape[:-1], n)).reshape(len(flat), n)
        levels, column = self.levels(rows), None
        at = np.arange(len(flat))
        for _ in range(STEPS):
            found = surface_packed(self.system, flat, rows)
            away, normals = found[:, 0] - levels, found[:, 1:]
            column = self.moved_state(normals) if column is None else column
            terms = np.abs(normals * flat).sum(axis=1) + np.abs(levels) + self.system.surface_unit
            off = np.abs(away) > ROUNDED * terms
            if not off.any():
                break
            flat[at, column] -= np.where(off, away / normals[at, column], 0.0)
        flat[~(np.abs(away) <= NEAR * self.system.surface_unit + ROUNDED * terms)] = np.nan
        return flat.reshape(moved.shape)

    def of_map(
        self, monodromy: np.ndarray, slopes: np.ndarray, before: np.ndarray | None, after: np.ndarray | None
    ) -> np.ndarray:
        """Return the derivative of the return map, from the flow's derivative over the same time.

        Parameters
        ----------
        monodromy
            Derivative of the flow, shape (n, n_states, n_states).
        slopes
            Rates at the images, shape (n, n_states).
        before, after
            Normals at the points and at their images; not needed of a state.
        """
        if self.state is not None:
            share = monodromy[:, self.state, :] / slopes[:, self.state, None]
            found = monodromy - slopes[:, :, None] * share[:, None, :]
            found[:, self.state, :] = 0.0
            found[:, :, self.state] = 0.0
        else:
            assert before is not None
            assert after is not None
            speed = (after * slopes).sum(axis=1)
            share = np.einsum("ni,nij->nj", after, monodromy) / speed[:, None]
            found = monodromy - slopes[:, :, None] * share[:, None, :]
            at, column = np.arange(len(found)), self.moved_state(before)
            along = found[at, :, column]
            found = found - along[:, :, None] * (before / before[at, column][:, None])[:, None, :]
            found[at, :, column] = 0.0
        found[~np.isfinite(slopes).all(axis=1)] = np.nan
        return np.asarray(found)

    def moved_state(self, normals: np.ndarray) -> np.ndarray:
        """Return for each normal the state along which points are moved onto the surface: the one, in units of its
        scale, by which it changes most.
        """
        return np.asarray(np.argmax(np.abs(normals) * np.asarray(self.system.scales), axis=1))


def section_of(system: System) -> Section | None:
    """Return the Poincare section of a system at crossings of a level; None if it has none."""
    return None if system.section is None else Section(system)
