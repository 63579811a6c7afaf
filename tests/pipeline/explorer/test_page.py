"""What the page's scripts say of a set: run by node, where there is one."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import pipeline.explorer
from pipeline.layout.vocabulary import EVIDENCE

pytestmark = pytest.mark.slow  # needs node

SOURCES = Path(pipeline.explorer.__file__).parent / "page" / "src"


def evaluated(module, expression):
    """Value of an expression in the exports of a module of the page."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("there is no node on this machine")
    code = f"import * as m from {json.dumps((SOURCES / module).as_uri())};"
    code += f"console.log(JSON.stringify({expression}));"
    command = [node, "--input-type=module", "--eval", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    return json.loads(done.stdout)


def test_stability_of__what_was_shown_and_by_what():
    cases = [
        ({"stability": "attracts", "evidence": "multipliers"}, True, "attracts, shown by its multipliers"),
        ({"stability": "attracts", "evidence": "stayed"}, True, "attracts, all extended cells stayed"),
        ({"stability": "transient", "evidence": "left"}, None, "transient, extended cells left it"),
        ({"stability": "not settled", "evidence": None}, None, "not settled"),
        # an orbit that the analysis does not know
        ({}, False, "unstable"),
        ({"stability": None}, True, "stable"),
        ({}, None, None),
    ]
    orbits = json.dumps([{"attrs": attrs, "stable": stable} for attrs, stable, _ in cases])
    assert evaluated("facts.js", f"{orbits}.map((o) => m.stabilityOf(o))") == [said for *_, said in cases]


def test_stability_of__has_a_text_for_each_evidence():
    orbits = json.dumps([{"attrs": {"stability": "it", "evidence": word}} for word in EVIDENCE])
    said = evaluated("facts.js", f"{orbits}.map((o) => m.stabilityOf(o))")
    assert [text == "it" for text in said] == [word == "none" for word in EVIDENCE]


def test_colour_of__a_set_that_does_not_attract_has_none():
    view = {"colours": [{"name": "attractor", "categories": [{"id": 3, "colour": "#ff0000"}]}]}
    colours = {"card": "#ffffff", "ink": "#101010", "accent": "#0000ff"}
    stabilities = ("attracts", "transient", "not settled")
    orbits = [{"attrs": {"attractor": 3, "stability": stability}, "stable": None} for stability in stabilities]
    given = f"{json.dumps(view)}, {json.dumps(colours)}"
    found = evaluated("orbit.js", f"{json.dumps(orbits)}.map((o) => m.colourOf(o, {given}))")
    assert found == ["#ff0000", "#101010", "#101010"]


def test_broken_lines__draw_nothing_across_the_circle():
    lines = evaluated(
        "wrapping.js",
        """(() => {
            const angle = Float64Array.from({ length: 200 }, (_, i) => 0.1 * i), rate = angle.map(Math.cos);
            const swing = angle.map((a) => 7 + Math.sin(a));
            const drawn = (x) => m.brokenLines(x, rate, m.wrappingOf(x, true), { shift: 0, cut: false });
            return [drawn(angle), drawn(swing)].map((lines) => lines.map((line) => Array.from(line)));
        })()""",
    )
    for line in lines[0]:
        x = np.array(line[::2])
        assert np.abs(x).max() <= np.pi + 1e-12
        assert np.abs(np.diff(x)).max() <= 0.1 + 1e-12
    assert len(lines[0]) == 4  # 19.9 rad go through half a turn three times
    assert len(lines[1]) == 1
    assert max(map(abs, lines[1][0][::2])) < np.pi  # brought next to 0 by a full turn


def test_holding__a_diagram_shows_all_of_its_branches_and_marks():
    """Points in [0, 1] x [-1, 1]; a branch up to y = 3, x = 1.2; a mark at x = -1. A null is a gap."""
    segments = json.dumps([{"x": [0.2, 1.5], "y": [0, None]}, {"x": [0.5, 1.2], "y": [3, 0.5]}])
    found = f"{{ branches: [{{ segments: {segments} }}], points: [{{ x: -1, y: [0.2] }}] }}"
    low, high, bottom, top = evaluated("branches.js", f"m.holding([0, 1, -1, 1], {found})")
    assert -1.1 < low < -1.0
    assert 1.2 < high < 1.3
    assert bottom == -1
    assert 3.0 < top < 3.2
    assert evaluated("branches.js", "m.holding([0, 1, -1, 1], null)") == [0, 1, -1, 1]
