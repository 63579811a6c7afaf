"""The zoo: systems with known answers, and the judge that compares them with what the analysis lists.

A sample of the zoo, the systems marked `quick`, runs here; ``python -m tests.zoo`` runs it all.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
if str(ROOT) not in sys.path:  # tests are no package; the zoo's modules are found from the checkout
    sys.path.append(str(ROOT))

from pipeline.layout.own_words import with_plain_names  # noqa: E402
from pipeline.runs.derive import derive  # noqa: E402
from pipeline.runs.run import run  # noqa: E402
from tests.zoo import answers, variants  # noqa: E402
from tests.zoo.judge import judge_point  # noqa: E402
from tests.zoo.rescaling import UNITS, rescaled  # noqa: E402
from tests.zoo.running import outcome_of  # noqa: E402

ANSWERS = {name: answers.load(name) for name in answers.names()}


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, answer in ANSWERS.items() if answer.quick])
def test_zoo__quick(name):
    outcome = outcome_of(name, variants.OWN)
    assert not outcome.error, outcome.error
    assert not outcome.verdict.wrong, (outcome.verdict.wrong, outcome.found)


TWINS = [
    ("bautin", "small and slow"),
    ("bautin", "turned"),
    ("close-pair", "large and fast"),
    ("close-pair", "far from zero"),
    ("slow-focus", "of two sizes"),
    ("slow-focus", "hundreds, far from zero"),
    ("repeller", "far from zero"),
    ("repeller", "degrees"),
    ("belt-stick", "small and slow"),
    ("lorenz-pair", "hundreds, far from zero"),
    ("held-amplitude", "far from zero"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "setting"), TWINS)
def test_zoo__other_units_change_no_conclusion(name, setting):
    outcome = outcome_of(name, setting)
    assert not outcome.error, outcome.error
    assert not outcome.verdict.wrong, (outcome.verdict.wrong, outcome.found)
    assert outcome.word == outcome_of(name, variants.OWN).word


NOT_TURNED = {
    "may-leonard": "a plane that no motion crosses is crossed by rounding when it is at a tilt",
    "ball-on-shaken-table": "a state rests on a surface only if an impact sets its velocity alone",
}


@pytest.mark.long
@pytest.mark.parametrize("setting", UNITS)
@pytest.mark.parametrize("name", [name for name in ANSWERS if isinstance(variants.load(name)["model"], dict)])
def test_zoo__no_twin_is_wrong(name, setting):
    if setting == "turned" and name in NOT_TURNED:
        pytest.skip(NOT_TURNED[name])
    outcome = outcome_of(name, setting)
    assert not outcome.error, outcome.error
    assert not outcome.verdict.wrong, (outcome.verdict.wrong, outcome.found)


@pytest.mark.slow
def test_zoo__a_twin_has_the_same_bifurcations(tmp_path):
    found = []
    for setting in (variants.OWN, "hundreds, far from zero"):
        data = variants.load("brusselator")
        if setting in UNITS:
            data, _ = rescaled(data, UNITS[setting])
        run(data, tmp_path / setting, workers=0, echo=lambda _: None)
        ds = with_plain_names(derive(tmp_path / setting, "branches"))
        found.append((ds["kind"].values.tolist(), ds["value"].values, ds.sizes["branch"]))
    (kinds, values, n_branches), twin = found
    assert len(kinds) > 0
    assert (twin[0], twin[2]) == (kinds, n_branches)
    np.testing.assert_allclose(twin[1], values, rtol=1e-6)


@pytest.mark.slow
def test_zoo__systems_have_a_source_and_valid_specifications_that_vary_in_one_thing():
    from pipeline.specification.spec import Spec

    assert len(ANSWERS) >= 114
    for name, answer in ANSWERS.items():
        assert answer.source, name
        assert answer.sets, name
        own = variants.load(name)
        every = dict(variants.settings(own))
        assert len(every) >= 9, name
        for word, data in every.items():
            changed = [key for key in own if own[key] != data[key]]
            assert len(changed) == (word != variants.OWN), (name, word)
        Spec.parse(own)


# ---- the judge ---------------------------------------------------------------------------------


def row(kind, stability="attracts", **more):
    """Make a row of the table."""
    empty = dict.fromkeys(("multiplier_modulus", "eigenvalue_real", "eigenvalue_imag", "lyapunov_max"), np.nan)
    return {"kind": kind, "stability": stability, "orbit_period": 0, "n_cells": 20, **empty, **more}


def judge(sets, rows, n_cells=60, **more):
    """Judge rows against sets, given as plain data."""
    answer = answers.from_data("made up", {"source": "made up", "set": sets})
    return judge_point(answer, {}, rows, n_cells=n_cells, **more)


ORBIT = {"kind": "periodic_orbit", "period": 1, "multiplier": 0.5}
CHAOS = {"kind": "chaotic_set", "lyapunov": 0.16, "lyapunov_error": 0.01}
REST = {"kind": "equilibrium", "eigenvalue": [-0.1, 1.0]}
PAIR = [{**ORBIT, "at": [s, 0.0], "share": 0.5} for s in (1.0, -1.0)]


def orbit(**more):
    return row("periodic_orbit", **{"orbit_period": 1, "multiplier_modulus": 0.5, **more})


def chaos(**more):
    return row("chaotic_set", **{"lyapunov_max": 0.161, "lyapunov_low": 0.158, "lyapunov_high": 0.164, **more})


def at(x):
    return np.array([[x, 0.0]])


def test_judge__right():
    rest = row("equilibrium", eigenvalue_real=-0.1, eigenvalue_imag=1.0)
    assert judge([ORBIT, CHAOS, REST], [orbit(), chaos(), rest]).word == "right"
    halves = [orbit(points=at(s), fraction=0.45, low=0.32, high=0.58) for s in (-1.0, 1.0)]
    assert judge(PAIR, halves).word == "right"


def test_judge__open():
    assert judge([ORBIT], [row("bounded_set", "not_settled")]).word == "not settled"
    assert judge([ORBIT], [], n_left=3).word == "not settled"
    assert judge([CHAOS], [row("bounded_set")]).word == "kind undecided"


@pytest.mark.parametrize(
    ("sets", "rows"),
    [
        pytest.param([ORBIT], [orbit(), orbit(multiplier_modulus=1.2)], id="an unstable orbit as attractor"),
        pytest.param(PAIR, [orbit(points=at(1.0), fraction=1.0, low=0.94, high=1.0)], id="a merged pair"),
        pytest.param(PAIR, [orbit(points=at(1.0)), orbit(points=at(0.99))], id="one orbit twice"),
        pytest.param([CHAOS], [chaos(), chaos()], id="two ids for one chaotic set"),
        pytest.param([REST], [orbit(multiplier_modulus=0.53)], id="an equilibrium as periodic orbit"),
        pytest.param([REST], [row("equilibrium", "unstable", eigenvalue_real=-0.1)], id="rest said unstable"),
        pytest.param([ORBIT], [row("bounded_set")], id="an orbit as bounded set"),
        pytest.param([ORBIT], [orbit(orbit_period=2)], id="twice the period"),
        pytest.param([ORBIT], [orbit(multiplier_modulus=0.6)], id="a wrong multiplier"),
        pytest.param([ORBIT], [orbit(), row("chaotic_set", "transient")], id="a transient that is none"),
        pytest.param([ORBIT, {**ORBIT, "multiplier": 0.3, "share": 0.4}], [orbit()], id="one is missing"),
        pytest.param([CHAOS], [row("torus")], id="chaos as a torus"),
        pytest.param([CHAOS], [chaos(lyapunov_max=0.3, lyapunov_low=0.29, lyapunov_high=0.31)], id="exponent"),
        pytest.param([{"kind": "any", "stability": "neutral"}], [orbit()], id="an attractor without damping"),
        pytest.param([{**ORBIT, "stability": "semistable"}], [orbit()], id="half stable as attractor"),
        pytest.param(
            [{"kind": "any", "stability": "transient", "lifetime": [900.0, 1100.0]}],
            [row("chaotic_set", "transient", lifetime_low=10.0, lifetime_high=20.0)],
            id="a lifetime",
        ),
    ],
)
def test_judge__wrong(sets, rows):
    assert judge(sets, rows).word == "WRONG"


def test_judge__share_that_its_interval_excludes():
    sets = [{**ORBIT, "share": 0.5}, {**ORBIT, "multiplier": 0.3, "share": 0.5}]
    rows = [orbit(fraction=f, low=f - 0.05, high=f + 0.05, multiplier_modulus=m) for f, m in ((0.9, 0.5), (0.1, 0.3))]
    assert judge(sets, rows).word == "WRONG"
    assert judge(sets, [*rows, row("bounded_set", "not_settled")]).word == "not settled"
