"""``magpend recordings``: what it prints, writes and refuses."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pipeline.rig.recordings.mapping import parse_mapping
from pipeline.rig.virtual import parse_rig, simulated

FOLDER = Path(__file__).parents[4] / "workflows" / "recordings" / "multiarm"

RIG = """
model = "pendulum"
initial_state = { psi1_deg = 40.0, psi2_dot = 25.0 }
sampling_rate_hz = 500.0
seed = 1
[drive]
steps = [{ frequency_hz = 2.0, n_periods = 4 }]
[sensors.psi1]
kind = "potentiometer"
noise = 1e-3
bits = 12
dead_band = 0.2
[sensors.psi2]
kind = "potentiometer"
noise = 1e-3
bits = 12
dead_band = 0.2
"""


@pytest.fixture
def swing(main, tmp_path):
    """Recording of a virtual rig, and its mapping."""
    (tmp_path / "rig.toml").write_text(RIG)
    code, out, err = main("recordings", "simulate", "rig.toml", "--out", "swing.csv")
    assert (code, out) == (0, "recording: swing.csv\nmapping: swing.toml\n"), err
    return tmp_path / "swing.csv"


def test_recordings_show__lists_the_channels_of_a_file(main, swing):
    code, out, _ = main("recordings", "show", swing.name)
    assert code == 0
    assert "4 channels, simulated" in out
    assert [line.split()[:3] for line in out.splitlines()[2:]] == [
        ["time", "1000", "-"],
        ["rig/psi1", "1000", "-"],
        ["rig/psi2", "1000", "-"],
        ["rig/drive", "1000", "-"],
    ]
    code, out, _ = main("recordings", "show", swing.name, "--json")
    assert [row["channel"] for row in json.loads(out)] == ["time", "rig/psi1", "rig/psi2", "rig/drive"]


@pytest.mark.slow
def test_recordings_show__with_a_mapping_says_what_was_found(main, swing, tmp_path):
    code, out, err = main("recordings", "show", swing.name, "--mapping", "swing.toml", "--out", "swing.png")
    assert code == 0, err
    assert "1000 samples at 500 Hz" in out
    assert "warning: dead-band of psi2" in out
    assert "note: wrap of psi2" in out
    assert (tmp_path / "swing.png").stat().st_size > 10_000
    code, out, _ = main("recordings", "show", swing.name, "--mapping", "swing.toml", "--json")
    told = json.loads(out)
    assert told["simulated"] == 1
    assert told["sampling_rate_hz"] == 500.0
    assert {row["quantity"] for row in told["quantities"]} == {"psi1", "psi2", "drive"}
    assert {row["kind"] for row in told["findings"]} == {"dead-band", "wrap"}
    # a grain of 1.65 mrad: 1 mrad and 0.48 mrad together
    assert told["quantities"][0]["noise"] == pytest.approx(1.1e-3, rel=0.1)


def test_recordings_convert__is_read_with_its_mapping(main, swing):
    words = ("--mapping", "swing.toml", "--window", 0.5, 1.5, "--out", "x.csv")
    code, out, err = main("recordings", "convert", swing.name, *words)
    assert (code, out) == (0, "recording: x.csv\nmapping: x.toml\n"), err
    code, out, _ = main("recordings", "show", "x.csv", "--mapping", "x.toml")
    assert "501 samples at 500 Hz" in out
    assert "simulated" in out
    code, out, _ = main("recordings", "convert", swing.name, "--mapping", "swing.toml", "--out", "x.nc", "--smooth")
    assert out == "recording: x.nc\n"


def test_docs__rig_and_mapping_belong_together():
    """The tutorial's files are valid, and its mapping is the one that the virtual rig writes."""
    page = (FOLDER.parents[2] / "docs" / "rig.md").read_text("utf-8")
    rig, mapping = (tomllib.loads(text) for text in re.findall(r"```toml\n(.*?)```", page, re.DOTALL)[:2])
    raw, own = simulated(parse_rig(rig))
    assert parse_mapping(mapping) == own
    assert {name: len(channel) for name, channel in raw.stretches[0].items()} == dict.fromkeys(
        ("rig/psi1", "rig/psi2", "rig/drive"), 11818
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("none.csv",), "there is no such file"),
        (("swing.csv", "--mapping", "none.toml"), "cannot be read"),
        (("swing.csv", "--out", "x.png"), "--mapping: missing"),
        (("swing.csv", "--mapping", "swing.toml", "--out", "x.gif"), "suffix"),
        (("swing.csv", "--mapping", "swing.toml", "--window", "90", "99"), "holds 0 samples"),
        (("swing.csv", "--mapping", "rig.toml"), "channels: missing"),
    ],
)
def test_recordings_show__refuses(main, swing, words, sentence):
    code, out, err = main("recordings", "show", *words)
    assert (code, out) == (2, "")
    assert sentence in err


def test_recordings__never_replace_what_they_read(main, swing, tmp_path):
    """A specification, a mapping or a recording of the same name stays."""
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    for words in (
        ("simulate", "rig.toml", "--out", "rig.csv"),
        ("convert", "swing.csv", "--mapping", "swing.toml", "--out", "swing.csv"),
        ("convert", "swing.csv", "--mapping", "swing.toml", "--out", "swing.tdms"),
    ):
        code, out, err = main("recordings", *words)
        assert (code, out) == (2, "")
        assert "give another name" in err
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
    assert main("recordings", "simulate", "rig.toml", "--out", "swing.csv")[0] == 0  # the same again
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


SINES = """
model = "pendulum"
format = "csv"
[time]
channel = "time"
[channels.psi1]
channel = "a"
[channels.psi2]
channel = "b"
[drive]
channel = "coil"
kind = "signal"
"""


@pytest.mark.slow
def test_recordings_spectrum__finds_lines_and_counts_orders_from_the_drive(main, tmp_path):
    """Sines of known amplitudes, and a drive that switches at 2 Hz: orders 1.5 and 4."""
    t = np.arange(8000) / 400.0
    columns = [t, 0.3 * np.sin(2 * np.pi * 3.0 * t), 0.02 * np.cos(2 * np.pi * 8.0 * t), ((t + 0.1) % 0.5 < 0.2) * 5.0]
    table = pd.DataFrame(dict(zip(("time", "a", "b", "coil"), columns, strict=True)))
    table.to_csv(tmp_path / "sines.csv", index=False)
    (tmp_path / "sines.toml").write_text(SINES)
    words = ("recordings", "spectrum", "sines.csv", "--mapping", "sines.toml")
    words += ("--nperseg", "800", "--scaling", "spectrum")
    code, out, err = main(*words, "--out", "spectrum.png", "--csv", "lines.csv")
    assert code == 0, err
    assert (tmp_path / "spectrum.png").stat().st_size > 5_000
    lines = pd.read_csv(tmp_path / "lines.csv")
    top = lines.loc[lines["power"].idxmax()]
    assert top["frequency_hz"] == pytest.approx(3.0, rel=1e-9)
    assert top["order"] == pytest.approx(1.5, rel=1e-4)
    assert top["power"] == pytest.approx(0.3**2 / 2, rel=1e-6)
    assert "19" in out  # averages
    code, out, err = main(*words, "--channel", "psi2")
    assert code == 0, err
    assert f"{0.02**2 / 2:.4g} at 4" in out
    code, _, err = main(*words, "--channel", "psi3")
    assert (code, "'psi3'" in err, "psi2" in err) == (2, True, True)


@pytest.mark.slow
def test_recordings_analyse__tells_the_period_and_draws(main, tmp_path):
    rng = np.random.default_rng(3)
    t = np.arange(2000) / 50.0
    columns = [
        t,
        *(np.sin(2 * np.pi * 1.25 * t + p) + 0.02 * rng.normal(size=len(t)) for p in (0.3, 1.0)),
        5.0 * (t % 0.8 < 0.4),
    ]
    table = pd.DataFrame(dict(zip(("time", "a", "b", "coil"), columns, strict=True)))
    table.to_csv(tmp_path / "sines.csv", index=False)
    (tmp_path / "sines.toml").write_text(SINES)
    words = ("recordings", "analyse", "sines.csv", "--mapping", "sines.toml")
    code, out, err = main(*words, "--channel", "psi2", "--out", "sines.png", "--csv", "rows.csv")
    assert code == 0, err
    assert "psi2: periodic" in out
    assert (tmp_path / "sines.png").stat().st_size > 20_000
    rows = pd.read_csv(tmp_path / "rows.csv").set_index("quantity")
    assert rows.loc["period", "low"] <= 0.8 <= rows.loc["period", "high"]
    code, _, err = main(*words, "--channel", "psi3")
    assert (code, "'psi3'" in err) == (2, True)
