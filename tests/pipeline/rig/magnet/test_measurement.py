"""Readings in, torque of the magnets out; and what is said about a bad measurement."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.rig.magnet.measurement import read_measurement
from pipeline.specification.problems import SpecError

from .conftest import write_table


def problems_of(path):
    with pytest.raises(SpecError) as caught:
        read_measurement(path)
    return caught.value.problems


def change(path, *pairs):
    text = path.read_text()
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)


def test_read_measurement__leaves_the_torque_of_the_magnets(rig):
    found = read_measurement(rig.path)
    np.testing.assert_allclose(found.torque, rig.magnets, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.angle, rig.angle, rtol=0, atol=1e-15)
    assert [(c.side, len(c.rows)) for c in found.curves] == [(0, 21)] * 9 + [(1, 21)] * 9
    assert found.label == "SYNTHETIC: a known torque"


def test_read_measurement__correction_is_that_of_statics_written_by_forces(rig):
    """Each weight by its place in the plane: the moment of a force (0, -F) at (x, y) is -F x."""
    p, found = rig.parameters, read_measurement(rig.path)
    joint = p["l1"] * np.sin(found.angle)
    second = joint + p["e2"] * np.sin(found.angle + found.locked)
    forces = [
        (p["m1"] * p["g"], p["e1"] * np.sin(found.angle)),
        (p["m2"] * p["g"], second),
        (0.05 * p["g"], 0.12 * np.sin(found.angle)),
    ]
    expected = found.reading + sum(force * x for force, x in forces)
    np.testing.assert_allclose(found.torque, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("unit", ["N m", "mN m", "N"])
def test_read_measurement__units_signs_and_levers(rig, unit):
    scale = {"N m": 1.0, "mN m": 1e3, "N": 1.0 / 0.2}[unit]
    raw = read_measurement(rig.path).reading
    write_table(rig.table, rig.angle, rig.locked, rig.side, -scale * raw)
    arm = ", arm_m = 0.2" if unit == "N" else ""
    change(rig.path, ('unit = "N m"', f'unit = "{unit}", sign = -1{arm}'))
    np.testing.assert_allclose(read_measurement(rig.path).torque, rig.magnets, rtol=0, atol=1e-13)


def test_read_measurement__takes_off_readings_without_the_magnets(rig):
    raw = read_measurement(rig.path).reading
    lines = rig.table.read_text().splitlines()
    blank = raw - rig.magnets
    more = [lines[0] + ",blank", *(f"{line},{b!r}" for line, b in zip(lines[1:], blank.tolist(), strict=True))]
    rig.table.write_text("\n".join(more))
    tie = "tie = { mass_kg = 0.05, lever_m = 0.12 }"
    change(rig.path, ("weights = true", 'weights = false\nwithout = "blank"'), (tie, ""))
    np.testing.assert_allclose(read_measurement(rig.path).torque, rig.magnets, rtol=0, atol=1e-14)
    change(rig.path, ("weights = false", "weights = true"))
    assert "set weights = false and drop tie" in problems_of(rig.path)[0]


def with_units(rig, *names):
    """Give columns of the table a unit in brackets."""
    head, rest = rig.table.read_text().split("\n", 1)
    for name, unit in names:
        assert name in head
        head = head.replace(name, f"{name} [{unit}]")
    rig.table.write_text(f"{head}\n{rest}")


def test_read_measurement__a_unit_in_a_columns_name_may_be_left_out(rig):
    """As in the mapping of a recording: the header gives the unit, and a warning says what was taken."""
    assert read_measurement(rig.path).warnings == ()
    names = rig.table.read_text().split("\n", 1)[0].split(",")
    with_units(rig, (names[0], "deg"), (names[3], "kN m"))
    found = read_measurement(rig.path)
    np.testing.assert_allclose(found.torque, rig.magnets, rtol=0, atol=1e-14)
    assert len(found.warnings) == 2
    assert f"has '{names[0]} [deg]'; it is taken for the same." in found.warnings[0]
    assert "as the header says" in found.warnings[1]


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_read_measurement__decimal_commas_and_other_delimiters(rig, delimiter):
    text = rig.table.read_text().replace(",", delimiter).replace(".", ",")
    rig.table.write_text("\ufeff" + text, encoding="utf-8")
    sign = "\\t" if delimiter == "\t" else delimiter
    change(rig.path, ("[columns]", f'delimiter = "{sign}"\ndecimal = ","\n[columns]'))
    np.testing.assert_allclose(read_measurement(rig.path).torque, rig.magnets, rtol=0, atol=1e-14)
    change(rig.path, (f'delimiter = "{sign}"\n', ""))
    assert 'delimiter and decimal are both ","' in problems_of(rig.path)[0]


def test_read_measurement__angles_in_radians_and_words_for_sides(rig):
    table = rig.table.read_text().replace("right", "R").replace("left", "L")
    lines = [line.split(",") for line in table.splitlines()]
    rows = [[repr(float(np.radians(float(a)))), b, w, t] for a, b, w, t in lines[1:]]
    rig.table.write_text("# a remark\n\n" + "\n".join(map(",".join, [lines[0], *rows])))
    change(
        rig.path,
        ('psi1 = { column = "angle", unit = "deg" }', 'psi1 = { column = "angle", unit = "rad" }'),
        ('side = { column = "where" }', 'side = { column = "where", right = "R", left = "L" }'),
    )
    np.testing.assert_allclose(read_measurement(rig.path).torque, rig.magnets, rtol=0, atol=1e-13)


def test_read_measurement__says_all_that_is_wrong_with_the_readings_at_once(rig):
    lines = rig.table.read_text().splitlines()
    lines[3] = lines[3].replace("right", "above")
    lines[4] = "nan," + lines[4].split(",", 1)[1]
    lines[5] = "50.0," + lines[5].split(",", 1)[1]
    lines[6] = lines[6].rsplit(",", 1)[0] + ",1;5"
    rig.table.write_text("\n".join(lines))
    change(rig.path, ('"angle", unit = "deg"', '"angle", unit = "deg", range = [-45, 45]'))
    problems = problems_of(rig.path)
    expected = [
        ("psi1: row 4: no finite number",),
        ("torque: row 6: no finite number",),
        ("psi1: row 5: outside of -45 to 45 deg", "columns.psi1.range"),
        ("side: row 3: must be 'right' or 'left'",),
    ]
    assert len(problems) == len(expected)
    for words, problem in zip(expected, problems, strict=True):
        assert all(word in problem for word in words), problem


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"angle"', '"angel"', "columns.psi1 = 'angel': readings.csv has no such column; it has: angle"),
        ("readings.csv", "absent.csv", "file = 'absent.csv': cannot be read"),
        ('unit = "N m"', 'unit = "Nm"', "columns.torque.unit = 'Nm': must be 'N m' or"),
        ('unit = "N m"', 'unit = "N"', "arm_m goes with"),
        ('l2 = "ruler"', "", "parameters.l2: has no provenance"),
        ("l2 = 0.18\n", "l2 = 0.18\nalpha1 = 1.0\n", "parameters.alpha1: is fitted; drop it, or name it in hold"),
        ("[columns]", 'hold = ["eps"]\n[columns]', "hold = 'eps': must be"),
        ("[columns]", 'model = "duffing"\n[columns]', "model = 'duffing': has no alpha1"),
        ("[columns]", 'model = "pendulim"\n[columns]', "did you mean pendulum"),
        ("wojna2018", "wojna2019", "did you mean wojna2018"),
        ("[columns]", "titel = 'x'\n[columns]", "titel: unknown key; did you mean title"),
        ("lever_m = 0.12", "lever_m = -0.12", "correction.tie.lever_m = -0.12: must be at least 0"),
    ],
)
def test_read_measurement__says_what_is_wrong_with_a_header(rig, old, new, words):
    change(rig.path, (old, new))
    assert any(words in problem for problem in problems_of(rig.path))


def test_read_measurement__names_short_curves_and_lacking_sides(rig):
    keep = (rig.side == 0) & (rig.locked > -0.4)
    first = rig.angle[keep & (rig.locked > 0.5)].min()
    keep &= (rig.locked < 0.5) | (rig.angle < first + 0.02)
    raw = read_measurement(rig.path).reading
    write_table(rig.table, rig.angle[keep], rig.locked[keep], rig.side[keep], raw[keep])
    problems = problems_of(rig.path)
    assert any("curve psi_rel = 32 deg, right: has" in p and "at least 5" in p for p in problems)
    assert any("side 'left': has 0 curves" in p and "at least 4" in p for p in problems)


def test_read_measurement__says_that_a_table_is_empty_or_ragged(rig):
    text = rig.table.read_text()
    rig.table.write_text("angle,locked,where,torque\n")
    assert "has no readings" in problems_of(rig.path)[0]
    rig.table.write_text(text + "1.0,2.0\n")
    assert "row 379: not 4 fields" in problems_of(rig.path)[0]
