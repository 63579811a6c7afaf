"""Measured points: columns in any spelling of the axes, converted to the unit of the cube, and their refusals."""

from __future__ import annotations

import numpy as np
import pytest

import magpend
from magpend_core.models import load_model
from pipeline.layout.own_words import in_own_words, spelling_of
from pipeline.results.points import level_name, read_points
from pipeline.rig.measured.branch import branch_table, read_branch
from pipeline.specification.problems import SpecError

TURN = 2.0 * np.pi


def written(folder, text):
    path = folder / "points.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("frequency_hz", [8.0, 16.0]),
        ("frequency", [8.0, 16.0]),
        ("omega", [8.0 * TURN, 16.0 * TURN]),
        ("period", [0.125, 0.0625]),
        ("drive_period", [0.125, 0.0625]),
    ],
)
def test_read_points__takes_the_drive_in_all_its_words(tmp_path, column, values):
    """A run over omega: the figure has the points where it has the curves, at 50.3 and 100.5 rad/s."""
    file = written(tmp_path, f"{column},amplitude,level\n{values[0]!r},1,3\n{values[1]!r},2,3\n")
    found = read_points(file, load_model("duffing"), "frequency", rate="omega")
    np.testing.assert_allclose(found["parameter"], [8.0, 16.0], rtol=1e-15)
    np.testing.assert_allclose(in_own_words(found)["parameter"], [8.0 * TURN, 16.0 * TURN], rtol=1e-14)
    assert found["amplitude"].values.tolist() == [1.0, 2.0]
    assert "level" not in found
    # a table of measured orbits takes the same words
    orbits = tmp_path / "orbits.csv"
    orbits.write_text(f"{column},amplitude\n{values[0]!r},1\n{values[1]!r},2\n")
    np.testing.assert_allclose(read_branch(orbits, load_model("duffing"))["value"], [8.0, 16.0], rtol=1e-15)


def test_read_points__levels_of_other_axes_are_read_in_any_spelling(tmp_path):
    file = written(tmp_path, "amplitude,omega,amp\n0.3,6.283185307179586,1\n0.4,,2\n")
    found = read_points(file, load_model("duffing"), "amplitude", others=["frequency"], needed=(), known=("amp",))
    np.testing.assert_allclose(found["parameter"], [0.3, 0.4])
    np.testing.assert_allclose(found["frequency"], [1.0, np.nan])
    assert found["amp"].values.tolist() == [1.0, 2.0]


def test_spelling_of__a_parameter_of_the_model_stands_before_a_word_of_the_drive():
    model = magpend.model("x' = -omega*x + phi", name="own", omega=1.0, phi=0.0)
    assert spelling_of("omega", model)[0] == "omega"
    assert spelling_of("omega", model)[1](3.0) == 3.0
    assert spelling_of("period", model)[0] == "frequency"
    assert spelling_of("x_deg", model)[0] == "x_deg"


def test_read_points__a_parameter_with_the_name_of_a_measured_column_has_a_prefix(tmp_path):
    """Duffing's force is called amplitude, and so is half of peak to peak."""
    file = written(tmp_path, "frequency_hz,amplitude,parameter_amplitude\n1,0.5,3\n2,0.6,4\n")
    found = read_points(file, load_model("duffing"), "frequency", others=["amplitude"])
    assert found["amplitude"].values.tolist() == [0.5, 0.6]
    assert found["parameter_amplitude"].values.tolist() == [3.0, 4.0]
    assert level_name(found, "amplitude") == "parameter_amplitude"
    # without such a column the measured one is no level
    plain = written(tmp_path, "omega,amplitude\n1,2\n")
    found = read_points(plain, load_model("duffing"), "frequency", others=["amplitude"])
    assert not level_name(found, "amplitude")
    with pytest.raises(SpecError, match="no column parameter_amplitude"):
        read_points(plain, load_model("duffing"), "amplitude", others=["frequency"])


def test_read_branch__a_table_along_a_parameter_with_the_name_of_a_column_is_read_back(tmp_path):
    orbits = written(tmp_path, "amplitude,amplitude,stable\n0.3,1.5,yes\n0.4,1.6,no\n")
    measured = read_branch(orbits, load_model("duffing"))
    again = read_branch(written(tmp_path, branch_table(measured).csv()), load_model("duffing"))
    assert again["value"].values.tolist() == [0.3, 0.4]
    assert again["amplitude"].values.tolist() == [1.5, 1.6]
    assert again["stability"].values.tolist() == measured["stability"].values.tolist()


def test_read_points__angles_may_be_in_degrees(tmp_path):
    """Of the axis, and of a measured column that is told to be an angle."""
    model = magpend.model("x' = -x*tilt", name="own", parameters={"tilt": {"value": 1.0, "unit": "rad"}})
    file = written(tmp_path, "tilt_deg,x_deg\n90,180\n45,\n")
    with pytest.raises(SpecError, match=r"row 3: has no x; give a value"):
        read_points(file, model, "tilt", needed=("x",), known=(), angles=("x",))
    file = written(tmp_path, "\n\ufefftilt_deg,x_deg\n\n90,180\n".lstrip("\n"))
    found = read_points(file, model, "tilt", needed=("x",), known=(), angles=("x",))
    np.testing.assert_allclose([float(found["parameter"][0]), float(found["x"][0])], [TURN / 4, TURN / 2], rtol=1e-15)
    with pytest.raises(SpecError, match=r"no column tilt \(or tilt_deg\), x \(or x_deg\); .* it has a, b"):
        read_points(written(tmp_path, "a,b\n1,2\n"), model, "tilt", needed=("x",), angles=("x",))


def test_read_points__all_problems_at_once_with_the_row_of_the_file(tmp_path):
    """Blank lines count as the editor counts them."""
    file = written(tmp_path, "period,amplitude\n\n0,1\n\n,2\n0.5,inf\n")
    with pytest.raises(SpecError) as refused:
        read_points(file, load_model("duffing"), "frequency")
    assert refused.value.problems == [
        f"{file}: row 3, period = '0': must be a finite number other than 0.",
        f"{file}: row 5, period: missing; give a value, or drop the row.",
        f"{file}: row 6, amplitude = 'inf': must be a finite number.",
    ]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("amplitude\n1\n", r"no column frequency_hz \(or omega, period\)"),
        ("omega,size\n1,2\n", "no column amplitude; .* it has omega, size"),
        ("omega,frequency_hz,amplitude\n1,2,3\n", "omega and frequency_hz are the same axis"),
        ("frequency_hz,amplitude\n1,x\n", "row 2, amplitude = 'x'"),
        ("frequency_hz,amplitude,amplitude\n1,2,3\n", "amplitude and amplitude are the same"),
        ("frequency_hz,amplitude\n1,2,3\n", "row 2: has 3 values for 2 columns"),
        ("frequency_hz,amplitude,phase\n1,,\n", "row 2: has no amplitude"),
        ("frequency_hz,amplitude\n", "no rows"),
        (None, "No such file"),
    ],
)
def test_read_points__are_refused_with_the_file_and_the_column(tmp_path, text, named):
    file = tmp_path / "points.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(SpecError, match=named) as refused:
        read_points(file, load_model("duffing"), "frequency")
    assert str(file) in str(refused.value)
