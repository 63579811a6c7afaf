"""Measurements with known parameters, as files and as readings in memory."""

from __future__ import annotations

import csv
from types import SimpleNamespace

import numpy as np
import pytest

from magpend_core import load_model
from magpend_core.models.pendulum import magnet_torque as laws
from pipeline.rig.magnet.fitting import fit_measurement
from pipeline.rig.magnet.measurement import read_measurement
from pipeline.rig.magnet.results import write_results

HEADER = """
title = "a known torque"
synthetic = true
file = "readings.csv"
preset = "wojna2018"
[columns]
psi1 = { column = "angle", unit = "deg" }
psi_rel = { column = "locked", unit = "deg" }
torque = { column = "torque", unit = "N m" }
side = { column = "where" }
[parameters]
l2 = 0.18
h = 0.39
[provenance]
l2 = "ruler"
h = "ruler"
[correction]
weights = true
tie = { mass_kg = 0.05, lever_m = 0.12 }
"""

TRUE = {
    "alpha1": 1.2,
    "alpha2": -1.3,
    "beta1": 0.03,
    "beta2": -0.02,
    "gamma1": 0.5,
    "gamma2": 0.55,
    "p1": 0.58,
    "p2": 0.56,
    "r1": -0.06,
    "r2": 0.058,
    "c1": 0.055,
    "c2": 0.06,
    "eps_mag": 80.0,
}


def grid(n_locked=9, n=21):
    """Angles [rad] and sides of readings on both sides of the transition of `TRUE`."""
    line = laws.transition(TRUE)
    locked = np.repeat(np.radians(np.linspace(-32.0, 32.0, n_locked)), 2 * n)
    sign = np.tile(np.repeat([1.0, -1.0], n), n_locked)
    beyond = np.tile(np.linspace(0.006, 0.25, n), 2 * n_locked)
    angle = line.slope * locked + line.offset + sign * beyond
    return angle, locked, np.where(sign > 0, 0, 1)


def write_table(path, angle, locked, side, torque):
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["angle", "locked", "where", "torque"])
        names = [laws.SIDES[s] for s in side]
        writer.writerows(zip(np.degrees(angle), np.degrees(locked), names, torque, strict=True))


def write_rig(folder):
    """A header and readings without noise, and what they were made from."""
    p = load_model("pendulum").load("wojna2018", **TRUE, l2=0.18, h=0.39)
    angle, locked, side = grid()
    magnets = laws.magnet_moment(angle, locked, p)
    besides = laws.weight_torque(angle, locked, p) - 0.05 * p["g"] * 0.12 * np.sin(angle)
    write_table(folder / "readings.csv", angle, locked, side, magnets + besides)
    header = folder / "rig.toml"
    header.write_text(HEADER)
    return SimpleNamespace(
        path=header, table=folder / "readings.csv", angle=angle, locked=locked, side=side, magnets=magnets, parameters=p
    )


@pytest.fixture
def rig(tmp_path):
    """A folder with a measurement."""
    return write_rig(tmp_path)


@pytest.fixture(scope="session")
def fitted(tmp_path_factory):
    """The same, its readings and their fit, and a folder with what is written of it."""
    folder = tmp_path_factory.mktemp("measurement")
    rig = write_rig(folder)
    measured = read_measurement(rig.path)
    outcome = fit_measurement(measured)
    write_results(outcome, folder)
    return SimpleNamespace(rig=rig, measured=measured, outcome=outcome, folder=folder)
