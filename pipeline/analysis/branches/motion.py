"""Classify the motion of whole orbits, and compute their rotation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from magpend_core.models.model import Classifier, Parameters
from magpend_core.models.sectioned import of_flow
from magpend_core.orbits import on_section
from magpend_core.sampling import Drive, sample
from magpend_core.sections import run_branches
from pipeline.analysis.branches.following import Branch
from pipeline.analysis.branches.problems import FREQUENCY
from pipeline.analysis.tolerances import BRANCH_RTOL
from pipeline.products.reporting import track

SAMPLES = 64
"""Instants per drive period or return at which the side of an orbit is judged."""


def sides_of(branches: Sequence[Branch], base: Parameters) -> list[np.ndarray]:
    """Classify the orbits of each branch by the model's classifier, from the whole orbit.

    Parameters
    ----------
    branches
        Branches of a model with a classifier.
    base
        Parameters of the run; each branch replaces those in which it differs.
    """
    classifier = base.model.classifier
    assert classifier is not None
    return [_sides(branch, base, classifier) for branch in track(branches, "telling sides")]


def _sides(branch: Branch, base: Parameters, classifier: Classifier) -> np.ndarray:
    family = branch.family
    if not family.period:
        return _rest_sides(branch, base, classifier)
    own = base.replace(**dict(zip(base.names, map(float, family.parameters), strict=True)))
    name, flow = family.free[0], of_flow(own).model.system
    angles = np.flatnonzero(family.system.is_angle)
    n_samples = family.period * SAMPLES
    parameters, times, drives = [], [], []
    for point in branch.points:
        value = float(family.values(point.u)[0])
        frequency = value if name == FREQUENCY else family.frequency_hz
        parameters.append(own if name == FREQUENCY else own.replace(**{name: value}))
        if base.model.crossing is not None:
            frequency = family.period / point.value.seconds
        times.append(np.arange(n_samples + 1) / (SAMPLES * frequency))
        drives.append(Drive(np.full(family.period, 1.0 / frequency)))
    packed = np.array([of_flow(one).pack() for one in parameters])
    starts = np.array([family.state(point.u) for point in branch.points])
    found = sample(flow, packed, starts, times, drives=drives, limits_first_step=False).states
    turns = np.round((found[:, -1, angles] - found[:, 0, angles]) / (2.0 * np.pi)).astype(np.int64)
    codes = [
        classifier.classify(states, n, _SEEN_WHOLE, _values(one))
        for states, n, one in zip(found, turns, parameters, strict=True)
    ]
    return np.array(codes, np.int8)


def _rest_sides(branch: Branch, base: Parameters, classifier: Classifier) -> np.ndarray:
    """Return the class of motion (a code) at each equilibrium of a branch, from the state at rest."""
    name, n_angles = branch.family.free[0], sum(branch.family.system.is_angle)
    own = base.replace(**dict(zip(base.names, map(float, branch.family.parameters), strict=True)))
    codes = []
    for point in branch.points:
        values = own.replace(**{name: float(branch.family.values(point.u)[0])})
        states = np.repeat(branch.family.state(point.u)[None], 2, axis=0)
        codes.append(classifier.classify(states, np.zeros(n_angles, np.int64), _SEEN_WHOLE, _values(values)))
    return np.array(codes, np.int8)


_SEEN_WHOLE = np.array(np.inf)
"""Frequency given to the classifier: infinite, since samples of the whole orbit leave no gap."""


def _values(parameters: Parameters) -> Mapping[str, Any]:
    return parameters.as_dict()


def rotation_of(branch: Branch) -> np.ndarray:
    """Compute the mean turns of each angle per drive period or return, on the branch's first orbit."""
    family = branch.family
    if not any(family.system.is_angle) or not family.period:
        return np.zeros(sum(family.system.is_angle))
    rows = family.rows(branch.points[0].u[None])
    result = run_branches(
        rows.parameters[:, None],
        rows.frequency_hz[:, None],
        on_section(rows.states, rows.parameters, family.system),
        n_transient=0,
        n_keep=family.period + 1,
        rtol=BRANCH_RTOL,
        atol=BRANCH_RTOL,
        system=family.system,
    )
    return np.asarray(result.turns[0, 0] / family.period, np.float64)
