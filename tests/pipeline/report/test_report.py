"""``magpend report``: what it says of a run is what the run says, and its commands give it."""

from __future__ import annotations

import html as markup
import math
import re
import shlex
import shutil

import pytest

from pipeline.analysis.atlas.sentences import sentences
from pipeline.layout.own_words import in_own_words
from pipeline.layout.vocabulary import ATTRACTS
from pipeline.report.report import stored_options
from pipeline.results.outcomes import sentence
from pipeline.results.ragged import dense
from pipeline.runs.derive import derive
from pipeline.store.run import RunDirectory
from tests.pipeline.factories import finished

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("long_steps_of_a_file")]

HOSTILE = "<script>alert(1)</script> & friends"
SWEEP = f"""
kind = "sweep"
title = "{HOSTILE}"
model = "duffing"
parameters = {{ preset = "twin-well", frequency_hz = 0.15915494309189535 }}
axes = {{ amplitude = {{ values = [0.1, 0.15] }} }}
initial_conditions.kind = "grid"
initial_conditions.x = {{ start = -1.0, stop = 1.0, num = 3 }}
initial_conditions.v = {{ start = -0.2, stop = 0.2, num = 2 }}
integration.rtol = 1e-7
integration.atol = 1e-7
integration.n_transient = 200
integration.n_keep = 16
integration.stop_when_closed = true
integration.closure_tolerance = 1e-2
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("report"), SWEEP).parent


def written(command, folder, *words):
    command(folder, "report", *words, "--out", "report.html", "--force")
    return (folder / "report.html").read_text("utf-8")


def bare(folder, target):
    """A copy of the sweep's run without the analyses that other tests have made of it."""
    return shutil.copytree(folder / "run", target, ignore=shutil.ignore_patterns("derived"))


def wilson(count, n, z=1.959964):
    """Share and score interval (Wilson, 1927), as the page spells them."""
    share = count / n
    middle = (share + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return f"{share:.3f} ({middle - half:.3f} to {middle + half:.3f})"


def test_report__only_stored_computes_nothing(folder, command, tmp_path):
    bare(folder, tmp_path / "run")
    html = written(command, tmp_path, "run", "--only-stored")
    assert not (tmp_path / "run" / "derived").exists()
    assert "magpend analyse attractors run" in html
    assert html.count("<img") == 1


def test_report__of_a_sweep(folder, command):
    html = written(command, folder, "run")
    assert "<script" not in html
    assert "&lt;script&gt;alert(1)&lt;/script&gt; &amp; friends" in html
    run = RunDirectory.open(folder / "run")
    assert run.digest in html
    found = dense(derive(run, "attractors"), points=True)
    rows = re.findall(r"<tr><td>([A-Z])</td>(.*?)</tr>", html)
    assert [row[0] for row in rows] == [chr(65 + int(i)) for i in found["attractor"].values]
    ids = found["attractor_id"].values.reshape(2, 6)
    shares = [re.findall(r"<td>(.*?)</td>", row[1])[-1] for row in rows]
    for i, share in zip(found["attractor"].values, shares, strict=True):
        assert share.partition(" at")[0] == wilson(max((ids == i).sum(1)), 6)
    assert html == written(command, folder, "run")


CHAOTIC = """
kind = "sweep"
model = "duffing"
parameters = { preset = "twin-well", frequency_hz = 0.15915494309189535 }
axes = { amplitude = { values = [0.25, 0.3] } }
initial_conditions = { kind = "random", n = 8, seed = 1, x = [-1.0, 1.0], v = [-1.0, 1.0] }
integration = { rtol = 1e-7, atol = 1e-7, n_transient = 100, n_keep = 64 }
"""


def test_report__sets_that_do_not_attract_have_no_share(command, tmp_path):
    """Without extension it is not shown that the chaotic set of the larger amplitude attracts."""
    found = dense(derive(finished(tmp_path, CHAOTIC), "attractors", {"extend": False}), points=True)
    attract = (found["stability"] == ATTRACTS).any("amplitude").values
    assert 0 < attract.sum() < attract.size
    html = written(command, tmp_path, "run", "--only-stored")
    rows = [re.findall(r"<td>(.*?)</td>", row) for row in re.findall(r"<tr>(<td>[A-Z]</td>.*?)</tr>", html)]
    assert [row[2] == "attracts" for row in rows] == attract.tolist()
    assert [row[-1] == "-" for row in rows] == (~attract).tolist()
    assert f"{attract.sum()} attractors, {(~attract).sum()} other set; {sentence(found)}" in html
    assert "Nothing was extended (--no-extend)" in html


def test_report__its_commands_work(folder, command):
    html = written(command, folder, "run", "--with", "branches", "--with", "spectrum")
    assert html == written(command, folder, "run", "--with", "branches", "--with", "spectrum")  # now of what is stored
    commands = [markup.unescape(c) for c in re.findall(r'<p class="command"><code>(.*?)</code>', html)]
    mine = [c for c in commands if re.match(r"magpend (analyse|plot) ", c) and not re.search("chaos|events", c)]
    assert {
        "magpend plot basins",
        "magpend analyse branches",
        "magpend plot gallery",
        "magpend plot spectrum",
        "magpend plot waterfall",
    } <= {" ".join(c.split()[:3]) for c in mine}
    for c in mine:
        _, notes = command(folder, *shlex.split(c)[1:])
        assert not re.search(r": computed", notes), c


PLANE = """
kind = "sweep"
model = "henon"
axes.a = { values = [1.0, 1.1, 1.2] }
axes.b = { values = [0.2, 0.3] }
initial_conditions = { kind = "random", n = 6, seed = 1, x = [-0.5, 0.5], y = [-0.2, 0.2] }
integration = { n_transient = 1000, n_keep = 64, stop_when_closed = true, closure_tolerance = 1e-8 }
"""


def test_report__of_an_atlas(command, tmp_path):
    run = finished(tmp_path, PLANE)
    assert "magpend analyse atlas run" in written(command, tmp_path, "run", "--only-stored")
    found = derive(run, "atlas", {"windows": 0, "curve_period": 2})
    html = markup.unescape(written(command, tmp_path, "run", "--only-stored"))
    told = sentences(in_own_words(found))
    assert any(text.startswith("Not explained: ") for text in told)
    for text in told:
        assert f"<p>{text}</p>" in html
    assert re.search(r"magpend plot atlas run .*--windows 0", html)
    assert re.search(r"magpend analyse atlas run .*--windows 0", html)


def test_stored_options__of_these_cells(folder, tmp_path):
    run = RunDirectory.open(folder / "run")
    derive(run, "attractors")
    derive(run, "attractors", {"n_points": 8})
    assert stored_options(run, "attractors") == [{}, {"n_points": 8}]
    assert stored_options(run, "curves") == []
    # what was found of other cells is not shown
    other = finished(tmp_path, SWEEP.replace("n_transient = 200", "n_transient = 210"))
    shutil.copytree(folder / "run" / "derived", other / "derived")
    assert stored_options(RunDirectory.open(other), "attractors") == []
