"""An expression of time that has not the drive's period is refused in words, and nothing is created."""

from __future__ import annotations

import pytest

from magpend_core.engine.checks import SystemCheckError
from tests.pipeline.factories import quietly

OWN = """
kind = "sweep"
[axes]
frequency_hz = {{ start = 0.5, stop = 1.0, num = 3 }}
[initial_conditions]
kind = "list"
points = [[0.1, 0.2]]
[integration]
n_transient = 1
n_keep = 1
[model]
name = "driven"
[model.states]
x = {{}}
v = {{}}
[model.parameters]
A = 0.5
omega = 3.141592653589793
[model.equations]
x = "v"
v = "-x - v + {drive}"
"""

ODD = [
    "A*cos(omega*t)",  # periodic at the first frequency alone
    "A*sin(pi*f*t)",  # 0 at both ends of the period
    "A*t",
    "x*cos(omega*t)",
    "A*cos(2*pi*f*t) + 0.1*exp(-t)",
]


@pytest.mark.parametrize("drive", ODD)
def test_commands__refuse_other_periods_before_anything_is_created(main, write_spec, tmp_path, drive):
    spec = write_spec(OWN.format(drive=drive))
    for command in (["run", spec, "--workers", "0"], ["run", spec, "--dry-run"], ["model", "show", spec]):
        code, _, err = main(*command)
        assert code == 2, err
        assert "does not repeat after a period of the drive" in err
        assert "frequency_hz" in err
        assert list(tmp_path.iterdir()) == [spec]


@pytest.mark.parametrize(
    "drive",
    ["A*cos(2*pi*f*t)", "A*cos(2*pi*phase)", "A*square(phase, 0.3)", "A*cos(2*pi*f*t)**3*x", "A*sign(sin(4*pi*f*t))"],
)
def test_commands__the_drives_period_and_its_fractions(main, write_spec, drive):
    code, _, err = main("model", "show", write_spec(OWN.format(drive=drive)))
    assert code == 0, err


def test_run__a_model_that_fails_its_checks_leaves_no_directory(own, write_spec, tmp_path, monkeypatch):
    """A model given as a Python object is checked only when it is compiled."""
    own.write_module(tmp_path / "models", "slow_drive")
    module = tmp_path / "models/slow_drive.py"
    module.write_text(module.read_text().replace("sincos(c[1] * t)", "sincos(0.3 * c[1] * t)"))
    monkeypatch.syspath_prepend(str(tmp_path / "models"))
    spec = write_spec(own.spec('model = "slow_drive:MINE"'))
    with pytest.raises(SystemCheckError, match="must have the period of the drive"):
        quietly(spec, tmp_path / "out")
    assert not (tmp_path / "out").exists()
