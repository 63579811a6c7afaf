"""The shipped examples as a user runs them: their pages, and their numbers.

Each in a bounded form with fewer cells, and as it ships, which takes minutes together, marked `long`.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from magpend_core.models import LIBRARY, load_model
from pipeline.layout.vocabulary import EQUILIBRIUM
from pipeline.results.ragged import dense
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.files import shipped_workflows

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "examples"
REFERENCE = json.loads((ROOT / "tests" / "core" / "data" / "library.json").read_text("utf-8"))
NAMES = sorted(path.stem for path in LIBRARY.glob("*.toml"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("examples")


@pytest.fixture
def magpend(command, folder):
    """Call a command in the folder; returns what it prints."""
    return lambda *words: command(folder, *words)[0]


BOUNDED = {
    "three-magnets": {"num = 200": "num = 50"},
    "duffing5": {"num = 200": "num = 50"},
    "driven-pendulum": {"num = 201": "num = 51"},
    "belt": {"step = 0.05": "step = 0.15", "num = 21": "num = 15"},
    "rossler": {"stop = 6.0, num = 281": "stop = 4.3, num = 19", "n_periods = 400": "n_periods = 64"},
    "impact": {"num = 251": "num = 26"},
}
"""What is changed in a workflow so that its run takes a second or two; the others run as they ship."""


@pytest.fixture(params=["bounded", pytest.param("full", marks=pytest.mark.long)])
def size(request):
    return request.param


@pytest.fixture
def example(magpend, folder, size):
    """The run of an example, made once: its folder's name."""

    def run(name):
        whole = size == "full" or name not in BOUNDED
        out = name if whole else f"{name}-bounded"
        if not (folder / out).exists():
            if whole:
                magpend("run", name, "--out", out, "--workers", "0")
            else:
                text = shipped_workflows()[name].read_text("utf-8")
                for old, new in BOUNDED[name].items():
                    assert old in text
                    text = text.replace(old, new)
                (folder / f"{out}.toml").write_text(text, "utf-8")
                magpend("run", f"{out}.toml", "--out", out, "--workers", "0")
        return out

    return run


@pytest.fixture
def analysed(example, folder):
    return lambda name: AnalysedRun.of(folder / example(name))


@pytest.mark.parametrize("name", NAMES)
def test_page__tells_of_each_text(name):
    """Its lines, its page with picture and file, and a workflow with a small size."""
    rows = re.findall(r"^\| \[([\w-]+)\]\(([\w-]+)\.md\) \| (\d+) \|", (PAGES / "README.md").read_text("utf-8"), re.M)
    (row,) = (row for row in rows if row[0] == name)
    text = (LIBRARY / f"{name}.toml").read_text("utf-8")
    assert int(row[2]) == len(text.splitlines())
    page = (PAGES / f"{row[1]}.md").read_text("utf-8")
    assert f"({row[1]}.png)" in page
    assert f"library/{name}.toml" in page
    assert "[smoke]" in shipped_workflows()[row[1]].read_text("utf-8")
    # what it shows stands in the model or its workflow; entries may be cut short
    if row[1] == name:
        files = [LIBRARY / f"{name}.toml", shipped_workflows()[name]]
        whole = re.sub(r"\s+", " ", " ".join(path.read_text("utf-8") for path in files))
        for block in re.findall(r"```toml\n(.*?)```", page, re.DOTALL):
            for line in block.splitlines():
                shown = re.sub(r"\s+", " ", line.partition(" #")[0]).strip()
                assert shown.removesuffix(" }").removesuffix(", on_circle = true") in whole


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "expected", "full", "bounded"),
    [
        # 13309, 13309, 13382 of 40000, as in a comment of Attractors.jl's tests and by RK4; a cell on a boundary may
        # turn with the last bits of the integration; bounded forms within two standard errors of 2500 cells
        ("three-magnets", REFERENCE["three-magnets"][0]["counts"], 4, 800),
        # RK4 at 128 and 96 steps a period differ in 24 cells
        ("duffing5", REFERENCE["duffing5"]["counts"], 40, 800),
        ("driven-pendulum", REFERENCE["driven-pendulum"]["counts"], 400, 1000),
    ],
)
def test_shares__of_all_attractors(analysed, size, name, expected, full, bounded):
    ids, counts = np.unique(analysed(name).derive("attractors").attractor_id.values, return_counts=True)
    assert ids.tolist() == list(range(len(expected)))
    scaled = sorted(counts * (40000 / counts.sum()))
    assert scaled == pytest.approx(sorted(expected), abs=full if size == "full" else bounded)
    if name == "duffing5":
        # bSTAB's sample of 4000 states, three standard errors
        theirs = [(0.1955, 0.0063), (0.4945, 0.0079), (0.0275, 0.0026), (0.02625, 0.0025), (0.25625, 0.0069)]
        for share, (known, error) in zip(sorted(counts / counts.sum()), sorted(theirs), strict=True):
            assert share == pytest.approx(known, abs=(3.0 if size == "full" else 4.0) * error)


@pytest.mark.slow
def test_belt__where_rest_and_stick_slip_are_found(analysed, size):
    """Rest from the Hopf point on, stick-slip until the unstable cycle meets it, shares in between."""
    attractors = dense(analysed("belt").derive("attractors"), points=True)
    reference = REFERENCE["belt"]
    share = attractors.share
    rests = attractors.attractor.values[(attractors["kind"] == EQUILIBRIUM).any("belt")]
    at_rest = share.sel(attractor=rests).fillna(0.0).sum("attractor")
    belts = attractors.belt.values
    assert (at_rest.values[belts < reference["hopf"]] == 0.0).all()
    assert (at_rest.values[belts > reference["hopf"]] > 0.0).all()
    assert (at_rest.values[belts < reference["cycle_ends"]] < 1.0).all()
    assert (at_rest.values[belts > reference["cycle_ends"]] == 1.0).all()
    for known in reference["rest"]:
        if np.abs(belts - known["belt"]).min() < 1e-9:
            found = float(at_rest.sel(belt=known["belt"], method="nearest"))
            # of 21 x 21 states, or 15 x 15
            assert found == pytest.approx(known["rest_share"], abs=0.03 if size == "full" else 0.05)


@pytest.mark.slow
def test_rossler__first_doublings(example, magpend):
    """Located along c, each to seven digits."""
    run = example("rossler")
    rows = json.loads(magpend("analyse", "branches", run, "--period", "4", "--json"))
    found = {row["period"]: row["c"] for row in rows if row["type"] == "period_doubling" and row["period"] != 3}
    for known in REFERENCE["rossler"]["doublings"]:
        assert found[known["returns"]] == pytest.approx(known["c"], abs=2e-7)


@pytest.mark.slow
def test_impact__doublings_and_touches(example, magpend, folder, size):
    """Against closed forms: where periods 1, 2 and 3 double, and where branches end at a touch."""
    run = example("impact")
    # towards the first touch, at 0.2617, branches take thousands of ever shorter steps
    part = {} if size == "full" else {"parameter": "A", "low": 0.262}
    words = [] if size == "full" else ["--parameter", "A", "--from", "0.262"]
    rows = json.loads(magpend("analyse", "branches", run, "--period", "3", *words, "--json"))
    found = {row["period"]: row["A"] for row in rows if row["type"] == "period_doubling"}
    for period, known in zip((1, 2, 3), REFERENCE["impact"]["doublings"], strict=True):
        assert found[period] == pytest.approx(known, abs=2e-7)
    ends = _stuck(AnalysedRun.of(folder / run).derive("branches", max_period=3, **part), period=2)
    # steps that get ever shorter end 6e-7 short of it
    assert np.abs(ends - REFERENCE["impact"]["second_touch"]).min() < 2e-6


def _stuck(branches, period):
    """Values at which branches of a period end where the map has no derivative."""
    stuck = branches["last_end"].attrs["flag_meanings"].split().index("stuck")
    mine, n_points = branches["orbit_period"].values == period, branches["n_points"].values
    return np.array(
        [
            branches["parameter"].values[k, point[k]]
            for point, name in ((0 * n_points, "first_end"), (n_points - 1, "last_end"))
            for k in np.flatnonzero(mine & (branches[name].values == stuck))
        ]
    )


@pytest.mark.slow
def test_lorenz__exponents(analysed):
    """.9056, 0, -14.5723 (Sprott 2003) within three standard errors of 16 x 4000 returns; their exact sum."""
    cube = analysed("lorenz").cube()
    mean = cube.lyapunov.mean([d for d in cube.lyapunov.dims if d != "exponent"]).values
    assert mean == pytest.approx([0.9056, 0.0, -14.5723], abs=0.003)
    assert mean.sum() == pytest.approx(-41.0 / 3.0, abs=1e-4)


def test_model_show__finds_what_is_steep(magpend):
    """A layer in the belt's friction, a switch where it is a sign, an impact at the stop."""
    assert "layer: tanh where belt - v passes 0" in magpend("model", "show", "belt")
    assert load_model("belt-stick").system.n_switches == 1
    assert load_model("impact").system.n_impacts == 1
    assert load_model("pendulum-text").system.n_edges == 2
