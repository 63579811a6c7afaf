"""Specifications of identifications: what is filled in, and all that is wrong at once."""

from __future__ import annotations

import json
import math
import tomllib

import pytest

from pipeline.rig.identify.specification import parse_identification
from pipeline.specification.problems import SpecError

GOOD = """
kind = "identification"
title = "a ring-down"
model = "duffing"
preset = "hardening"
[parameters]
amplitude = 0.0
[identify.damping]
start = 0.2
bounds = [0.0, 1.0]
[identify.linear]
prior = { mean = 1.0, sd = 0.1 }
[tied]
cubic = "-0.5*linear"
[sensors]
zero = ["x"]
[[recordings]]
file = "a.csv"
mapping = "a.toml"
hold_out = [1]
"""


@pytest.fixture
def parse(tmp_path):
    for name in ("a.csv", "a.toml"):
        (tmp_path / name).write_text("")

    def call(text: str):
        return parse_identification(tomllib.loads(text), tmp_path)

    return call


def test_parse_identification__fills_in_starts_and_bounds(parse):
    spec = parse(GOOD)
    damping, linear = spec.unknowns
    assert (damping.start, damping.lower, damping.upper) == (0.2, 0.0, 1.0)
    assert (linear.start, linear.lower, linear.upper) == (1.0, -math.inf, math.inf)
    assert linear.prior is not None
    assert (linear.prior.mean, linear.prior.sd) == (1.0, 0.1)
    assert spec.tied == {"cubic": (-0.5, "linear")}
    assert spec.values["amplitude"] == 0.0
    assert spec.fit.continuity == "free"
    assert spec.recordings[0].hold_out == (1,)


def test_parse_identification__plain_data_are_json(parse):
    assert json.loads(json.dumps(parse(GOOD).as_dict()))["identify"]["linear"]["bounds"] == ["-inf", "inf"]


@pytest.mark.parametrize(
    ("text", "tie"),
    [
        ("linear", (1.0, "linear")),
        ("-linear", (-1.0, "linear")),
        ("2e-1 * linear", (0.2, "linear")),
        ("+3*linear", (3.0, "linear")),
    ],
)
def test_tied__is_a_number_times_a_name(parse, text, tie):
    assert parse(GOOD.replace("-0.5*linear", text)).tied["cubic"] == tie


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[identify.damping]", "[identify.dampin]", ("identify.dampin", "did you mean damping")),
        ("bounds = [0.0, 1.0]", "bounds = [0.3, 1.0]", ("identify.damping.bounds", "exclude the start 0.2")),
        ("bounds = [0.0, 1.0]", "bounds = [1.0, 0.0]", ("identify.damping.bounds", "must rise")),
        ("bounds = [0.0, 1.0]", "bounds = [-1.0, 1.0]", ("identify.damping.bounds", "0 or greater")),
        ("start = 0.2", "start = -0.2", ("identify.damping.start", "0 or greater")),
        ('cubic = "-0.5*linear"', 'cubic = "cubic"', ("tied.cubic", "tied to itself")),
        ('cubic = "-0.5*linear"', 'linear = "damping"', ("tied.linear", "also in identify")),
        ('cubic = "-0.5*linear"', 'cubic = "amplitude"', ("tied.cubic", "not identified")),
        ('cubic = "-0.5*linear"', 'cubic = "linear+1"', ("tied.cubic", "a number times one")),
        ('cubic = "-0.5*linear"', 'cubic = "liner"', ("tied.cubic", "did you mean linear")),
        ("mean = 1.0, sd = 0.1", "mean = 1.0", ("identify.linear.prior.sd", "missing")),
        ("mean = 1.0, sd = 0.1", "mean = 1.0, sd = 0", ("identify.linear.prior.sd", "greater than 0")),
        ('zero = ["x"]', 'zero = ["y"]', ("sensors.zero", "'y' is not a state")),
        ('zero = ["x"]', 'drift = ["x"]', ("sensors.drift: 'x' is not among sensors.zero",)),
        ("hold_out = [1]", "hold_out = [1, 1]", ("hold_out", "twice")),
        ("hold_out = [1]", "window_s = [3.0, 1.0]", ("window_s", "empty")),
        ('file = "a.csv"', 'file = "b.csv"', ("recordings[0].file", "no such file")),
        ('preset = "hardening"', 'preset = "hardning"', ("preset", "did you mean hardening")),
        ("amplitude = 0.0", "amplitude = 0.0\ndamping = 0.1", ("parameters.damping", "also in identify")),
        ('kind = "identification"', 'kind = "identfication"', ("kind", "Did you mean 'identification'")),
        ('kind = "identification"', 'kind = "sweep"', ("magpend run",)),
        ("[sensors]", '[fit]\nslopes = "variation"\n[sensors]', ("fit.slopes",)),
    ],
)
def test_parse_identification__names_the_problem(parse, old, new, words):
    assert old in GOOD
    with pytest.raises(SpecError) as caught:
        parse(GOOD.replace(old, new))
    (found,) = caught.value.problems
    assert all(word in found for word in words), found


def test_parse_identification__names_all_problems_at_once(parse):
    text = GOOD.replace("start = 0.2", "start = 2.0").replace('zero = ["x"]', 'zero = ["q"]')
    with pytest.raises(SpecError) as caught:
        parse(text.replace("sd = 0.1", "sd = -1.0"))
    assert len(caught.value.problems) == 3
