"""Define the drawings of the pendulum: joints, links and magnets in the plane, from the upper joint [m]."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from magpend_core.models.model import Drawing


def _place(length: float, angle: np.ndarray) -> np.ndarray:
    return length * np.stack([np.sin(angle), -np.cos(angle)], axis=-1)


def _with_magnet(states: np.ndarray, parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
    joint = _place(parameters["l1"], states[..., 0])
    return {"joint": joint, "magnet": joint + _place(parameters["l2"], states[..., 1])}


def _magnet_and_joint(parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
    return {"pivot": np.zeros(2), "fixed magnet": np.array([0.0, -parameters["h"]])}


def _without_magnet(states: np.ndarray, parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
    joint = _place(parameters["l1"], states[..., 0])
    return {"joint": joint, "centre of mass": joint + _place(parameters["e2"], states[..., 1])}


def _joint(parameters: Mapping[str, float]) -> dict[str, np.ndarray]:
    return {"pivot": np.zeros(2)}


MAGNETS = Drawing(_with_magnet, _magnet_and_joint, (("pivot", "joint", "magnet"),), "magnet")
FREE = Drawing(_without_magnet, _joint, (("pivot", "joint", "centre of mass"),), "centre of mass")
