"""The synthetic measurement that ships: its field against other computations, its file against its script."""

from __future__ import annotations

import csv
import importlib.util
import tomllib
from pathlib import Path

import numpy as np
import pytest

from magpend_core import load_model
from pipeline.rig.magnet.fitting import fit_measurement
from pipeline.rig.magnet.measurement import read_measurement

ROOM = Path(__file__).parents[4] / "workflows" / "magnet"
HEADER = tomllib.loads((ROOM / "discs.toml").read_text("utf-8"))
DISC = HEADER["synthesis"]
pytestmark = pytest.mark.slow  # needs magpylib


@pytest.fixture(scope="module")
def make_discs():
    spec = importlib.util.spec_from_file_location("make_discs", ROOM / "make_discs.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def geometry(distance=None):
    """Lengths with the discs' centres so far apart when all hangs straight."""
    p = load_model("pendulum").load("wojna2018", **HEADER["parameters"])
    return p if distance is None else p.replace(h=p["l1"] + p["l2"] + distance)


def hanging(n=1):
    return np.zeros(n), np.zeros(n)


def test_discs_csv__is_what_the_script_makes(make_discs):
    with (ROOM / "discs.csv").open(encoding="utf-8") as file:
        assert file.readline().startswith("# SYNTHETIC")
        stored = list(csv.reader(file))[1:]
    made = make_discs.read(HEADER)
    assert len(stored) == len(made) == 17 * 2 * 19
    for (a, b, side, torque), row in zip(made, stored, strict=True):
        assert (float(row[0]), float(row[1]), row[2]) == (pytest.approx(a), pytest.approx(b), side)
        # printed to 1e-4 N m
        assert float(row[3]) == pytest.approx(torque, abs=5.1e-5)


@pytest.mark.parametrize("distance", [0.020, 0.040, 0.100])
def test_loads__on_one_axis_are_those_of_current_sheets(make_discs, distance):
    """The second discretisation: Amperian currents around the moving disc instead of charges on its faces.

    The azimuthal sheet current M [A/m] in the fixed disc's radial field pulls along the axis.
    """
    import magpylib

    fixed = magpylib.magnet.Cylinder(
        dimension=(DISC["diameter_m"], DISC["thickness_m"]), polarization=(0, 0, DISC["remanence_T"])
    )
    nodes, weights = np.polynomial.legendre.leggauss(24)
    half, radius = 0.5 * DISC["thickness_m"], 0.5 * DISC["diameter_m"]
    places = np.stack([np.full(24, radius), np.zeros(24), distance + half * nodes], axis=-1)
    radial = fixed.getB(places)[:, 0]
    current = DISC["remanence_T"] / (4e-7 * np.pi)
    # opposed to the fixed disc's magnetisation, so that the force is upwards
    expected = 2.0 * np.pi * radius * current * half * (weights @ radial)
    force, moment = make_discs.loads(*hanging(), geometry(distance), DISC)
    assert force[0, 1] == pytest.approx(expected, rel=1e-6)
    assert expected > 0.0
    np.testing.assert_allclose([force[0, 0], moment[0]], 0.0, atol=1e-12)


def test_loads__bent_are_those_of_magpylib(make_discs):
    """The library's own force and torque, by cells of the moving disc's volume."""
    import magpylib
    from scipy.spatial.transform import Rotation

    p, psi1, psi2 = geometry(), np.radians([4.0, -10.0]), np.radians([9.0, 5.0])
    force, moment = make_discs.loads(psi1, psi2, p, DISC)
    size = DISC["diameter_m"], DISC["thickness_m"]
    for i in range(2):
        fixed = magpylib.magnet.Cylinder(
            dimension=size, polarization=(0, 0, DISC["remanence_T"]), position=(0, 0, -p["h"])
        )
        x = p["l1"] * np.sin(psi1[i]) + p["l2"] * np.sin(psi2[i])
        z = -p["l1"] * np.cos(psi1[i]) - p["l2"] * np.cos(psi2[i])
        # turning a link by psi in the plane of x and z is a turn by -psi about y
        moving = magpylib.magnet.Cylinder(
            dimension=size,
            polarization=(0, 0, -DISC["remanence_T"]),
            position=(x, 0, z),
            orientation=Rotation.from_euler("y", -psi2[i]),
        )
        f, t = magpylib.getFT(fixed, moving, pivot=(0, 0, 0), meshing=4000)
        # 4000 cells: some 0.2 %
        np.testing.assert_allclose(force[i], f[[0, 2]], rtol=5e-3, atol=5e-3)
        assert moment[i] == pytest.approx(-t[1], rel=5e-3)


def test_discs__readings_are_corrected_to_the_field_and_noise(make_discs):
    m = read_measurement(ROOM / "discs.toml")
    torque = make_discs.loads(m.angle, m.angle + m.locked, m.parameters, DISC)[1]
    left = m.torque - torque
    # 646 readings: 2.8 % of a standard deviation
    assert left.std() == pytest.approx(DISC["noise_Nm"], rel=0.1)
    assert abs(left.mean()) < 4 * DISC["noise_Nm"] / np.sqrt(646)


def test_discs__the_fitted_law_holds_and_dipoles_fail():
    found = fit_measurement(read_measurement(ROOM / "discs.toml"))
    r2 = [fit.quality.r2 for fit in found.curves]
    assert min(r2) > 0.945
    assert max(r2) > 0.995
    assert found.joint.quality.r2 == pytest.approx(0.9947, abs=1e-3)
    assert found.dipoles.quality.r2 == pytest.approx(0.788, abs=5e-3)
    assert found.placed_dipoles.quality.r2 == pytest.approx(0.953, abs=5e-3)
    # what is left over is the law's, five times the noise
    assert found.joint.quality.rms > 4 * DISC["noise_Nm"]
    assert found.joint.neighbours > 0.7
    # the mirrored halves of the field agree within their errors
    p = found.joint.values
    for first, second, sign in (("alpha1", "alpha2", -1), ("r1", "r2", -1), ("c1", "c2", 1), ("p1", "p2", 1)):
        error = np.hypot(found.joint.errors_by_curve[first], found.joint.errors_by_curve[second])
        assert abs(p[first] - sign * p[second]) < 3 * error


def test_discs__the_force_along_the_magnets_line_shares_the_torque_among_the_joints(make_discs):
    """Eq. 20 makes joint torques of M_M by a force along the line between the magnets; discs have more."""
    m = read_measurement(ROOM / "discs.toml")
    p, psi1, psi2 = m.parameters, m.angle, m.angle + m.locked
    force, moment = make_discs.loads(psi1, psi2, p, DISC)
    lower_joint = p["l1"] * np.stack([np.sin(psi1), -np.cos(psi1)], axis=-1)
    second = moment - (lower_joint[:, 0] * force[:, 1] - lower_joint[:, 1] * force[:, 0])
    dx = p["l1"] * np.sin(psi1) + p["l2"] * np.sin(psi2)
    dy = p["h"] - p["l1"] * np.cos(psi1) - p["l2"] * np.cos(psi2)
    along = moment / p["h"]
    upwards = along * dy * dx / (dx**2 + p["delta"] ** 2)
    computed = p["l2"] * (along * np.cos(psi2) + upwards * np.sin(psi2))
    left = computed - second
    assert 1.0 - left.var() / second.var() > 0.97
    straight = m.locked == 0.0
    assert 1.0 - left[straight].var() / second[straight].var() > 0.998
