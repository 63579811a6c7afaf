"""Measured branches: cycles of a signal, tables and recordings of orbits, distances from computed branches."""

from __future__ import annotations

import numpy as np
import pytest

from magpend_core.models import load_model
from pipeline.layout.vocabulary import parameters_of
from pipeline.rig.measured.branch import CyclesError, branch_table, compare, cycles_of, read_branch, rms_of
from pipeline.rig.measured.branch_computed import amplitudes
from pipeline.rig.measured.branch_figure import plot_branch
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.files import shipped_workflows
from pipeline.specification.problems import SpecError
from tests.pipeline.factories import duffing

LINEAR = duffing(
    "frequency_hz = { start = 0.1, stop = 0.3, num = 5 }",
    'kind = "list"\npoints = [[0.1, 0.0]]',
    n_transient=300,
    n_keep=4,
    tolerance=1e-10,
    more="[parameters]\noverrides = { damping = 0.3, linear = 1.0, cubic = 0.0, amplitude = 0.2 }",
)
FLUTTER = shipped_workflows()["flutter"]

PUBLISHED = {
    "stable 14.9": (18.97, 2.449),
    "stable 15.6": (25.50, 2.455),
    "stable 16.5": (32.07, 2.448),
    "stable 17.3": (43.53, 2.440),
    "unstable 14.9": (14.11, 2.455),
    "unstable 15.7": (14.29, 2.458),
    "unstable 16.5": (9.68, 2.494),
    "unstable 17.2": (7.35, 2.543),
}
"""Half the peak-to-peak heave [mm] and frequency [Hz] of the recorded cycles, by another program."""


def test_cycles__of_a_known_signal():
    """Amplitude, mean, frequency and harmonics of a noisy signal; the scatter is that of the noise."""
    time = np.arange(0.0, 40.0, 1e-3)
    phase = 2.0 * np.pi * 1.37 * time
    signal = 0.7 + 2.0 * np.cos(phase) + 0.3 * np.cos(2.0 * phase + 0.4)
    noise = np.random.default_rng(3).normal(0.0, 0.01, len(time))
    found = cycles_of(time, signal + noise)
    assert found.n == pytest.approx(1.37 * 40.0, abs=1.0)
    assert found.frequency == pytest.approx(1.37, abs=1e-3)
    assert found.mean == pytest.approx(0.7, abs=1e-3)
    assert found.harmonics[:2] == pytest.approx([2.0, 0.3], abs=3e-3)
    assert found.amplitude == pytest.approx(0.5 * np.ptp(signal), abs=0.04)
    assert 0.001 < found.amplitude_sd < 0.02
    assert found.frequency_sd == pytest.approx(np.sqrt(2.0) * 1.37**2 * 0.01 / (2.0 * np.pi * 1.37 * 2.0), rel=1.0)


def test_cycles__noise_at_a_crossing():
    """Noise that crosses the mean several times makes no further cycles."""
    time = np.arange(0.0, 20.0, 1e-3)
    noise = np.random.default_rng(4).normal(0.0, 0.05, len(time))
    assert cycles_of(time, np.sin(2.0 * np.pi * time) + noise).n in (18, 19)


def test_cycles__too_few():
    time = np.arange(0.0, 2.5, 1e-2)
    with pytest.raises(CyclesError, match="at least 3"):
        cycles_of(time, np.sin(2.0 * np.pi * time))


def test_read_branch__recordings_of_the_flutter_rig():
    """The numbers of the eight recordings, as another program has them."""
    found = read_branch(FLUTTER)
    assert found["name"].values.tolist() == list(PUBLISHED)
    assert found["stability"].values.tolist() == [1, 1, 1, 1, 2, 2, 2, 2]
    for k, (amplitude, frequency) in enumerate(PUBLISHED.values()):
        assert 1e3 * float(found["amplitude"][k]) == pytest.approx(amplitude, abs=0.04)
        assert float(found["frequency"][k]) == pytest.approx(frequency, abs=2e-3)
    assert (found["harmonic"].values[:, 0] > 10.0 * found["harmonic"].values[:, 1]).all()


@pytest.fixture(scope="module")
def linear(computed):
    return AnalysedRun.of(computed(LINEAR))


def response(frequency):
    """Return the amplitude of the linear oscillator."""
    w = 2.0 * np.pi * frequency
    return 0.2 / np.hypot(1.0 - w * w, 0.3 * w)


@pytest.mark.slow
def test_amplitudes__of_a_linear_oscillator(linear):
    """A / sqrt((1 - w^2)^2 + (d w)^2) on the whole branch."""
    branches = linear.derive("branches", parameter="frequency_hz")
    found = amplitudes(branches, parameters_of(linear.cube()), "x")
    n = int(branches["n_points"][0])
    np.testing.assert_allclose(found[0, :n], response(branches["parameter"].values[0, :n]), rtol=1e-4)


@pytest.mark.slow
def test_compare__with_a_table(linear, tmp_path):
    """Errors in per cent and in scatters of a table of orbits; none is unstable."""
    table = tmp_path / "orbits.csv"
    values = [0.12, 0.16, 0.25]
    lines = ["frequency_hz,amplitude,amplitude_sd,frequency,stable,name"]
    lines += [f"{f},{float(1.1 * response(f))!r},0.01,{f},yes,a{i}" for i, f in enumerate(values)]
    lines += ["0.2,0.3,0.01,0.2,no,b", "0.2,0.3,,,unknown,c"]
    table.write_text("\n".join(lines))
    measured = read_branch(table, linear.model)
    branches = linear.derive("branches", parameter="frequency_hz")
    found = compare(measured, branches, amplitudes(branches, parameters_of(linear.cube()), "x"))
    assert found["relative_error"].values[:3] == pytest.approx(1.0 / 1.1 - 1.0, abs=2e-4)
    assert found["distance"].values[:3] == pytest.approx(-0.1 * response(np.array(values)) / 0.01, rel=2e-3)
    assert found["frequency_error"].values[:3] == pytest.approx(0.0, abs=1e-9)
    assert found["branch"].values.tolist() == [0, 0, 0, -1, 0]
    assert rms_of(found, "stable") == pytest.approx(1.0 - 1.0 / 1.1, abs=2e-4)
    text = "\n".join(branch_table(found).lines)
    assert "stable orbits: root mean square of the amplitudes' relative errors 9.1 %" in text
    assert "no computed orbit of that stability: b" in text
    figure = plot_branch(found, branches, amplitudes(branches, parameters_of(linear.cube()), "x"))
    assert {"amplitude", "branch_amplitude"} <= set(figure.data)


def test_compare__another_parameter(linear, tmp_path):
    (tmp_path / "orbits.csv").write_text("damping,amplitude\n0.3,0.1\n")
    branches = linear.derive("branches", parameter="frequency_hz")
    with pytest.raises(SpecError, match="measured along damping"):
        compare(read_branch(tmp_path / "orbits.csv", linear.model), branches, np.zeros((1, 1)))


def test_read_branch__all_mistakes_at_once(tmp_path):
    """Each has its row and column."""
    path = tmp_path / "orbits.csv"
    path.write_text("frequncy_hz,amplitud,stable\n0.1,0.2,maybe\n,x,yes\n")
    with pytest.raises(SpecError) as raised:
        read_branch(path, load_model("duffing"))
    text = str(raised.value)
    for part in ("'frequncy_hz'", "column 'amplitud'", "column 'amplitude': missing", "row 2, stable = 'maybe'"):
        assert part in text


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('parameter = "U"', 'parameter = "V"', "unknown parameter 'V'"),
        ('state = "h"', 'state = "z"', "unknown state 'z'"),
        ('stable = "yes"', 'stable = "perhaps"', "stable = 'perhaps'"),
        ('channel = "stable_U14_9[0]"', 'channel = "nothing"', "nothing"),
        ("measured.branch", "measured.sweep", "no table [measured.branch]"),
    ],
)
def test_read_branch__specification(tmp_path, old, new, message):
    text = FLUTTER.read_text("utf-8").replace(old, new, -1 if old == "measured.branch" else 1)
    (tmp_path / "branch.toml").write_text(text.replace('file = "', f'file = "{FLUTTER.parent}/'))
    with pytest.raises(SpecError) as raised:
        read_branch(tmp_path / "branch.toml")
    assert message in str(raised.value)


@pytest.mark.slow
def test_flutter__errors_of_the_published_parameters(tmp_path, command):
    """15.7 % on the stable cycles and 8.4 % on the unstable ones, as own shooting by DOP853 has them."""
    command(tmp_path, "run", "flutter", "--out", "computed", "--workers", "0")
    out = command(tmp_path, "measured", "branch", "flutter", "--over", "computed", "--out", "fl.png")[0]
    assert "stable orbits: root mean square of the amplitudes' relative errors 15.7 %" in out
    assert "unstable orbits: root mean square of the amplitudes' relative errors 8.5 %" in out
    assert (tmp_path / "fl.png").is_file()
