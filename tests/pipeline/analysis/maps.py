"""Maps whose numbers are known: that of Henon, x' = 1 - 1.4 x^2 + y, y' = .3 x; any map as a parameter point."""

from __future__ import annotations

import numpy as np

from magpend_core.status import Status
from pipeline.analysis.attractors.extension.extending import Outcome, extend
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.analysis.attractors.finding.closed_orbits import Orbit
from pipeline.analysis.attractors.finding.requests import (
    _ANSWERS,
    LEG,
    Decide,
    Effort,
    Leg,
    Polish,
    Recur,
    Settings,
    Slopes,
)
from pipeline.results.sets import Geometry

N_KEEP = 20


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


class MapPoint:
    """Cells of a map in place of a parameter point."""

    can_rest, is_flow, n_neutral = False, False, 0
    at_rest = on_cycle = parameters = None

    def __init__(self, step, slope, starts, seen=N_KEEP):
        self.step, self.slope = step, slope
        self.section = np.empty((len(starts), N_KEEP, starts.shape[1]))
        state = starts.copy()
        for i in range(N_KEEP):
            state = step(state)
            self.section[:, i] = state
        self.n_cells, self.n_periods, self.n_states = len(starts), seen * len(starts), starts.shape[1]
        self.rtols, self.n_legs, self.is_elsewhere = [], [], np.zeros(len(starts), bool)

    def blocks(self):
        n = self.n_cells
        yield Block(slice(0, n), self.section, np.full(n, Status.BOUNDED), np.zeros(n, int), np.zeros((n, 0)))

    def volumes(self, derivatives, before, after):
        return np.linalg.slogdet(derivatives)[1]


def settle(point, orbits=(), *, budget=1e6, seen=N_KEEP, scale=1.0, n_sample=32, effort=Effort()) -> Outcome:
    """Drive the extension of a point by its own map."""
    n_states = point.section.shape[2]
    geometry = Geometry((False,) * n_states, (scale,) * n_states)
    settings = Settings(1e-8, 1e-8, 100, 1e-5, 4, 1e-10, seen, None, "", geometry, effort=effort)
    return drive(extend(point, list(orbits), np.full(point.n_cells, -1), settings, budget, n_sample), point, settings)


def drive(work, point, settings=None):
    """Answer the requests of a work by the map of its point; return its result."""
    n_states, answer = point.section.shape[2], None
    while True:
        try:
            asked = work.send(answer)
        except StopIteration as stop:
            return stop.value
        if isinstance(asked, Leg):
            point.n_legs.append(asked.n_legs)
            section, state = np.empty((len(asked.state), asked.n_legs * LEG, n_states)), asked.state.copy()
            for i in range(section.shape[1]):
                state = point.step(state)
                section[:, i] = state
            section = section.reshape(-1, LEG, n_states)
            n = len(section)
            status = np.where(np.isfinite(section).all(axis=(1, 2)), Status.BOUNDED, Status.DIVERGED)
            none = np.zeros(n, int)
            answer = Block(
                slice(0, n), section, status, none, np.zeros((n, 0), int), seconds=np.ones((n, LEG)), step=np.zeros(n)
            )
        elif isinstance(asked, Slopes):
            point.rtols.append(asked.rtol)
            answer = point.step(asked.point), point.slope(asked.point)
        elif isinstance(asked, Decide | Recur):
            answer = _ANSWERS[type(asked)]({(): asked}, {}, settings)[()]
        else:
            assert isinstance(asked, Polish)
            answer = [None] * len(asked.guesses.key)


def tent(slope):
    """Tent map on [0, 1]; what leaves through the top is drawn to 2."""

    def step(x):
        inside = slope * np.minimum(x, 1.0 - x)
        return np.where(x <= 1.0, inside, 2.0 + 0.5 * (x - 2.0))

    def derivative(x):
        return np.where(x < 0.5, slope, -slope)[:, :, None]

    return step, derivative


FIXED = Orbit(np.array([[2.0]]), np.array([0.5 + 0j]), 1e-12, np.array([[0.5]]))
"""Where what leaves a tent map ends."""
