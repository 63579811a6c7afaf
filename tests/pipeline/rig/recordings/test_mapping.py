"""The mapping file: what it says, what it refuses, and that its own text is read back as itself."""

from __future__ import annotations

import math

import pytest

from pipeline.rig.recordings.mapping import load_mapping, parse_mapping
from pipeline.specification.problems import SpecError

FULL = """
model = "pendulum"
format = "tdms"
time = { channel = "rig/time", unit = "ms" }
window_s = [0.5, 20.0]
[channels.psi1]
channel = "rig/angle 1"
unit = "V"
scale = 1.2566
zero = 2.5
offset = 0.01
sign = -1
range = [0.0, 5.0]
wraps = true
dead_band = [4.95, 5.0]
[channels.psi2]
channel = 3
unit = "deg"
relative_to = "psi1"
[drive]
channel = "rig/motor"
kind = "signal"
[csv]
delimiter = ";"
decimal = ","
"""


def problems_of(data):
    with pytest.raises(SpecError) as caught:
        parse_mapping(data)
    return caught.value.problems


def test_load_mapping__reads_all_keys(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(FULL)
    mapping = load_mapping(path)
    assert mapping.channels["psi1"].dead_band == (4.95, 5.0)
    assert mapping.drive_map.kind == "signal"
    assert mapping.factor_of("psi1") == pytest.approx(-1.2566)
    assert mapping.factor_of("psi2") == pytest.approx(math.pi / 180)


def test_mapping__its_text_is_read_back_as_itself():
    mapping = parse_mapping(FULL)
    assert parse_mapping(mapping.toml()) == mapping


def test_parse_mapping__names_all_problems_at_once():
    found = problems_of(
        {
            "model": "pendulum",
            "fromat": "tdms",
            "sampling_rate_hz": -1.0,
            "channels": {
                "psi_1": {"channel": "a"},
                "psi2": {"channel": "b", "unit": "V"},
                "psi2_dot": {"channel": "c", "wraps": True},
            },
            "drive": {"channel": "d"},
        }
    )
    text = "\n".join(found)
    assert "fromat: unknown key; did you mean format?" in text
    assert "sampling_rate_hz = -1.0: must be greater than 0" in text
    assert "channels.psi_1: unknown key; did you mean psi1" in text
    assert "channels.psi2.scale: missing; the unit 'V' needs one, in rad per V." in text
    assert "channels.psi2_dot.wraps: only an angle has one" in text
    assert "drive.kind: missing" in text
    assert len(found) == 6


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"unit": "deg", "scale": 0.0174533}, "is converted already; drop scale, or unit"),
        ({"unit": "rpm"}, "is not one of rad"),
        ({"unit": "V", "scale": 0.0}, "must not be 0"),
        ({"range": [5.0, 0.0]}, "the second number must be the greater one"),
        ({"relative_to": "psi2"}, "must be another channel of this mapping"),
    ],
)
def test_parse_mapping__refuses(entry, sentence):
    (found,) = problems_of({"model": "pendulum", "channels": {"psi1": {"channel": "a", **entry}}})
    assert found.startswith("channels.psi1")
    assert sentence in found


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"model": None}, "model: missing"),
        ({"model": "pendulm"}, "did you mean pendulum"),
        ({"channels": None}, "channels: missing"),
        ({"drive": "off"}, 'must be "none"'),
        ({"time": {"channel": "t"}, "sampling_rate_hz": 1.0}, "keep time or sampling_rate_hz"),
        ({"time": {"channel": "t", "unit": "V"}}, "time.unit"),
        ({"window_s": [3.0, 1.0]}, "the second number must be the greater one"),
        ({"resample": 50.0}, "resample: needs time stamps"),
        (
            {"resample": 50.0, "time": {"channel": "t"}, "channels": {"psi1": {"channel": "a", "wraps": True}}},
            "channels.psi1.wraps",
        ),
    ],
)
def test_parse_mapping__refuses_a_whole_that_does_not_fit(changed, sentence):
    data = {"model": "pendulum", "channels": {"psi1": {"channel": "a"}}, **changed}
    found = problems_of({key: value for key, value in data.items() if value is not None})
    assert any(sentence in p for p in found)
