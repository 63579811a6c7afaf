"""Drive files, and what of a specification makes no sense beside one."""

from __future__ import annotations

import hashlib
import re
import tomllib

import numpy as np
import pytest

from pipeline.layout.identity import digest_of
from pipeline.layout.plan import make_plan
from pipeline.specification.problems import SpecError
from pipeline.specification.recorded_drive import load_drive, parse_drive, rising_edges
from pipeline.specification.spec import Spec

EDGES = "# measured\nrising_s,falling_s\n1.0,1.2\n1.5,1.7\n2.1,2.3\n2.5,\n"
TORQUE = "time_s,drive\n" + "".join(f"{0.1 * k!r},{1.0 if k % 4 in (1, 2) else -1.0}\n" for k in range(41))
SPEC = """
kind = "sweep"
[drive]
file = "drive.csv"
[initial_conditions]
kind = "grid"
psi1 = 0.1
[integration]
n_transient = 1
n_keep = 2
"""


def drive(text, **options):
    return parse_drive(text, "drive.csv", "", **options)


def test_parse_drive__edges():
    found = drive(EDGES)
    assert (found.kind, found.n_periods, found.n_intervals) == ("edges", 3, 3)
    assert found.sections_s.tolist() == [1.5, 2.1, 2.5]
    assert (found.start_s, found.end_s) == (1.0, 2.5)
    assert found.frequency_hz == pytest.approx(2.0)
    np.testing.assert_allclose(found.intervals.durations_s, [0.5, 0.6, 0.4])
    np.testing.assert_allclose(found.intervals.values[:, 0], [0.4, 1 / 3, 0.5])
    assert found.section_ends.tolist() == [0, 1, 2]
    for last in ("2.5", "2.5,2.6"):  # the last falling edge may be left out, or be of the next period
        assert len(drive(EDGES.replace("2.5,", last)).second) == 3


def test_parse_drive__torque_has_sections_at_its_rising_edges():
    """From -1 to 1 in 0.1 s: through the middle halfway; a drive that begins low, then every 0.4 s."""
    found = drive(TORQUE)
    np.testing.assert_allclose(found.sections_s, 0.05 + 0.4 * np.arange(10))
    assert found.frequency_hz == pytest.approx(2.5)
    assert found.n_intervals == 40 + 10
    ends = found.start_s + np.cumsum(found.intervals.durations_s)[found.section_ends]
    np.testing.assert_allclose(ends, found.sections_s, atol=1e-12)
    # where a line is cut, it stays the same line
    level = found.intervals.values
    np.testing.assert_allclose(level[:2], [[-1.0, 20.0], [0.0, 20.0]], atol=1e-12)


def test_parse_drive__torque_with_sections_at_instants():
    found = drive(TORQUE, section_hz=2.0)
    np.testing.assert_allclose(found.sections_s, 0.5 * np.arange(1, 9))
    assert found.n_intervals == 40  # all of them are samples already
    assert found.frequency_hz == pytest.approx(2.0)
    ends = np.cumsum(found.intervals.durations_s)[found.section_ends]
    np.testing.assert_allclose(ends, found.sections_s, atol=1e-9)


def test_rising_edges__noise_on_a_flank_is_one_edge():
    time = np.linspace(0, 10, 20_001)
    rng = np.random.default_rng(0)
    wave = np.tanh(20 * np.sin(2 * np.pi * time)) + 0.1 * rng.standard_normal(len(time))
    np.testing.assert_allclose(rising_edges(time, wave), np.arange(1, 10), atol=3e-3)
    assert rising_edges(time, np.ones_like(time)).size == 0


REFUSED = {
    "": "its columns are ''",
    "a,b\n1,2\n": "begins with the line 'rising_s,falling_s' or 'time_s,drive'",
    "rising_s,falling_s\n1,1.2\n": "1 rising edges; a period needs two",
    "rising_s,falling_s\n1,1.2\n0.5,\n": "rising edges must rise",
    "rising_s,falling_s\n1,1.8\n1.5,\n": "falling_s = 1.8 s must lie between",
    "rising_s,falling_s\n1,x\n1.5,\n": "line 2: '1,x' is not two numbers",
    "rising_s,falling_s\n1,nan\n1.5,\n": "line 2: '1,nan' is not finite",
    "time_s,drive\n0,1\n": "1 samples; a line needs two",
    "time_s,drive\n0,1\n0,2\n": "time must rise",
}


def test_parse_drive__refuses():
    for text, words in REFUSED.items():
        with pytest.raises(SpecError, match=re.escape(words)):
            drive(text)
    with pytest.raises(SpecError) as caught:
        drive("time_s,drive\n" + "0,x\n" * 100)
    assert len(caught.value.problems) == 6
    assert "95 more lines" in caught.value.problems[-1]


def test_load_drive__file_that_is_not_there(tmp_path):
    with pytest.raises(SpecError, match="magpend recordings drive"):
        load_drive(tmp_path / "none.csv")
    (tmp_path / "large.csv").write_bytes(b"#" * 20_000_001)
    with pytest.raises(SpecError, match="at most 20000000"):
        load_drive(tmp_path / "large.csv")


def write(folder, text=EDGES, name="drive.csv"):
    (folder / name).write_text(text, "utf-8")


def parsed(folder, spec=SPEC, text=EDGES):
    """A specification, which finds the drive's file beside it."""
    write(folder, text)
    write(folder, spec, "spec.toml")
    return Spec.read(folder / "spec.toml")


def test_parse_spec__keeps_the_drive_and_reads_back_without_its_file(tmp_path):
    spec = parsed(tmp_path)
    plain = spec.as_dict()
    assert plain["drive"]["sha256"] == hashlib.sha256(EDGES.encode()).hexdigest()
    (tmp_path / "drive.csv").unlink()
    assert Spec.parse(plain) == spec
    plain["drive"]["text"] = EDGES.replace("2.3", "2.31")
    with pytest.raises(SpecError, match=r"drive\.sha256 = .* is not the digest of drive\.csv"):
        Spec.parse(plain)


def test_identity__is_of_the_values_and_not_of_the_name(tmp_path):
    def digest(spec):
        return digest_of(make_plan(spec).identity)

    first = parsed(tmp_path)
    write(tmp_path, EDGES, "other.csv")
    renamed = Spec.parse(tomllib.loads(SPEC.replace("drive.csv", "other.csv")), tmp_path)
    changed = parsed(tmp_path, text=EDGES.replace("2.3", "2.31"))
    assert digest(renamed) == digest(first) != digest(changed)


def test_parse_spec__all_that_makes_no_sense_at_once(tmp_path):
    text = """
    kind = "continuation"
    [drive]
    file = "drive.csv"
    [axes]
    frequency_hz = { start = 2.0, stop = 2.5, num = 6 }
    duty_cycle = { values = [0.4, 0.5] }
    [initial_conditions]
    kind = "grid"
    psi1 = { start = 0.0, stop = 1.0, num = 8 }
    refine = 2
    [integration]
    n_transient = 300
    n_keep = 60
    stop_when_closed = true
    [products]
    lyapunov = {}
    """
    with pytest.raises(SpecError) as caught:
        parsed(tmp_path, text)
    for words in (
        "drive: a continuation",
        "axes.frequency_hz: the recorded drive drive.csv",
        "axes.duty_cycle: the recorded drive",
        "n_transient = 300 and n_keep = 60 are 360 drive periods, and drive.csv has 3",
        "integration.stop_when_closed",
        "initial_conditions.refine",
        "products.lyapunov",
    ):
        assert any(words in p for p in caught.value.problems), words
    assert "frequency_hz: missing" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('file = "drive.csv"', 'file = "none.csv"', "drive.file = 'none.csv'"),
        ('file = "drive.csv"', "", "drive.file: missing"),
        ('file = "drive.csv"', 'file = "drive.csv"\nsection_hz = 2.0', "sections under measured edges"),
        ("[initial", "[parameters]\nfrequency_hz = 2.2\n[initial", "parameters.frequency_hz: the recorded drive"),
        ("[initial", "[parameters]\noverrides = { duty_cycle = 0.5 }\n[initial", "overrides.duty_cycle"),
        ("[drive]", 'model = "duffing"\n[drive]', "need a model with a parameter duty_cycle"),
    ],
)
def test_parse_spec__refuses(tmp_path, old, new, words):
    with pytest.raises(SpecError) as caught:
        parsed(tmp_path, SPEC.replace(old, new).replace("psi1", "x" if "duffing" in new else "psi1"))
    assert words in str(caught.value)
    assert len(caught.value.problems) == 1


def test_parse_spec__refuses_extremes_and_no_section_of_a_torque(tmp_path):
    spec = SPEC + '[products]\nextremes = { quantities = ["psi1"] }\n'
    with pytest.raises(SpecError, match=r"products\.extremes: extremes are taken over drive periods"):
        parsed(tmp_path, spec, TORQUE)
    with pytest.raises(SpecError, match=r"no rising edge after its start, so no section; set drive\.section_hz"):
        parsed(tmp_path, SPEC, "time_s,drive\n0,1\n5,1\n")


def test_parse_spec__refuses_an_axis_along_which_nothing_changes(tmp_path):
    """The amplitude of the model's own drive does nothing where a torque takes its place."""
    spec = SPEC.replace("[initial", "[axes]\n{} = {{ values = [1.0, 2.0] }}\n[initial")
    with pytest.raises(SpecError, match=r"axes\.q: changes only the model's own drive") as caught:
        parsed(tmp_path, spec.format("q"), TORQUE)
    assert len(caught.value.problems) == 1
    assert parsed(tmp_path, spec.format("q")).axes
    assert parsed(tmp_path, spec.format("T1"), TORQUE).axes
