"""``magpend analyse``: what it prints and stores, and what it refuses."""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest

from pipeline.analysis.ragged import dense
from pipeline.cli.exits import Exit
from pipeline.runs.derive import derive

pytestmark = pytest.mark.slow

SPIRALS = """
kind = "sweep"
axes = { frequency_hz = { values = [2.2, 2.25] } }
initial_conditions.kind = "grid"
initial_conditions.psi1_deg = { start = -20, stop = 20, num = 4 }
initial_conditions.psi2_deg = { start = -20, stop = 20, num = 4 }
integration = { rtol = 1e-7, atol = 1e-7, n_transient = 300, n_keep = 32 }
execution = { trajectories_per_task = 16 }
"""


@pytest.fixture(scope="module")
def spirals(computed):
    """A run at 2.2 and 2.25 Hz that finds the left and the right orbit."""
    return computed(SPIRALS)


def test_attractors__table_per_point(main, spirals, tmp_path):
    code, out, err = main("analyse", "attractors", spirals, "--csv", tmp_path / "a.csv")
    assert code == 0, err
    lines = out.splitlines()
    assert "attractors at 2 parameter points" in out
    at = lines.index("frequency 2.2 Hz:")
    left, right = (next(line for line in lines[at:] if f" {side} " in line) for side in ("left", "right"))
    assert re.search(r"periodic orbit +attracts +1 +left +0\.000 0\.000 +0\.9[67]\d\d ", left)
    assert re.search(r"0\.\d{4} \(0\.\d{4} to 0\.\d{4}\) .*multipliers$", right)
    assert lines[-1] == "all 32 cells end on attractors"
    ds = dense(derive(spirals, "attractors"), points=True)
    assert f"stored: {ds.encoding['source']}" in err
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        i, at = int(row["attractor_id"]), {"frequency": float(row["frequency"])}
        one = ds.sel(at).isel(attractor=i)
        assert int(row["n_cells"]) == int(one["n_cells"])
        assert (row["kind"], row["stability"], row["evidence"]) == ("periodic_orbit", "attracts", "multipliers")
        assert float(row["low"]) < float(row["fraction"]) < float(row["high"])
        decided = sum(int(count) for name, count in row.items() if name.startswith("by_"))
        assert decided == int(row["n_cells"])
        modulus = abs(complex(one["multiplier_real"][0], one["multiplier_imag"][0]))
        assert row["multiplier_modulus"] == ("" if np.isnan(modulus) else repr(modulus))
    by_side = {row["side"]: row for row in rows if row["frequency"] == "2.2"}
    assert by_side["left"]["mirror_partner"] == by_side["right"]["attractor_id"]

    code, _, err = main("analyse", "attractors", spirals)
    assert "attractors: taken from" in err


def test_json__is_printed_or_goes_to_a_file(main, walk, tmp_path):
    printed = main("status", "run", "--json")[1]
    assert json.loads(printed)[0]["complete"]
    assert main("status", "--json", "run")[1] == printed
    lines = main("status", "run")[1]
    for words in (("run", "--json", "found.json"), ("--json=found.json", "run")):
        assert main("status", *words)[:2] == (0, lines)
        assert (tmp_path / "found.json").read_text().strip() == printed.strip()
    (tmp_path / "other.json").write_text('{"mine": 1}')
    for file in ("other.json", "run/found.json", "none/found.json"):
        code, _, err = main("status", "run", "--json", file)
        assert code == Exit.REFUSED
        assert file in err
    assert (tmp_path / "other.json").read_text() == '{"mine": 1}'
    rows = main("analyse", "attractors", "run", "--no-polish", "--csv", "-", "--json", "rows.json")[1]
    assert len(json.loads((tmp_path / "rows.json").read_text())) == len(rows.splitlines()) - 1


def test_hysteresis__loops_and_jumps(main, walk, tmp_path):
    # a continuation's branches are no sample of initial conditions
    code, out, _ = main("analyse", "attractors", "run", "--no-polish")
    assert code == 0
    assert "share" not in out
    code, out, err = main("analyse", "hysteresis", "run", "--csv", "h.csv")
    assert code == 0, err
    ds = derive(walk, "hysteresis")
    assert f"jumps of the branches: {int(ds['jump_count'].sum()) or 'none'}" in out
    assert re.search(rf"^{ds.sizes['loop'] or 'no'} loop", out, re.MULTILINE)
    with (tmp_path / "h.csv").open() as file:
        assert sum(int(row["count"]) for row in csv.DictReader(file)) == int(ds["jump_count"].sum())
    code, _, err = main("analyse", "basins", "run")
    assert code == Exit.REFUSED
    assert "independent initial conditions" in err


def test_analyse__incomplete_run_and_prune(main, made):
    directory = made.info.directory
    made.commit(0)
    code, out, err = main("analyse", "attractors", directory, "--no-polish")
    assert code == 0, err
    assert f"{made.plan.n_cells - made.plan.cells_in(0)} pending" in out
    assert main("analyse", "prune", directory)[1] == "nothing to remove\n"
    made.commit(1)
    _, out, _ = main("analyse", "prune", directory, "--dry-run")
    assert len(re.findall("stale: .*(attractors|identified)-", out)) == 2
    assert main("analyse", "prune", directory, "--dry-run")[1] == out
    assert main("analyse", "prune", directory)[1] == out.replace("stale", "removed")
    assert [path.name for path in (directory / "derived").iterdir()] == ["attractors.json"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["attractors", "--tolerance", "-1"], "tolerance = -1.0: must be at least 0."),
        (["attractors", "--threshold", "0"], "threshold = 0.0: must be greater than 0."),
        (["basins", "--confidence", "nan"], "confidence = nan: must be a finite number."),
        (["basins", "--interval", "wilsen"], "Did you mean 'wilson'?"),
        (["dimension", "--at", "freqency_hz=2.2"], "unknown axis 'freqency_hz'; did you mean frequency?"),
        (["branches", "--parameter", "frequency_h"], "did you mean frequency_hz?"),
        (["hysteresis"], 'hysteresis needs a continuation with direction = "both".'),
        (["attractors", "--csv", "no/where.csv"], "--csv no/where.csv: must be a file in a folder"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_analyse__refused_before_computing(main, made, arguments, message):
    made.commit(0)
    code, out, err = main("analyse", arguments[0], made.info.directory, *arguments[1:])
    assert code == Exit.REFUSED
    assert message in err
    assert out == ""
    assert not (made.info.directory / "derived").exists()


def test_analyse__run_without_attractors(main, sweep_text, copied):
    """Every cell diverged at once: tables and figures say so, none fails."""
    text = sweep_text.replace("psi1_dot = 0.1", "psi1_dot = 1e9").replace("q = { values = [1.5, 1.6] }", "")
    copied(text.replace("n_transient = 2\nn_keep = 3", "n_transient = 8\nn_keep = 16").replace("num = 5", "num = 2"))
    for name, words in (
        ("attractors", "0 of 24 cells end on attractors; 24 diverged"),
        ("basins", r"diverged +12 +1\.0000 \(0\.7575 to 1\.0000\)"),
        ("settling", "sets that do not close: none"),
    ):
        code, out, err = main("analyse", name, "run")
        assert code == 0, err
        assert re.search(words, out), out
    at = ("--at", "frequency=2.0")
    for figure in (("fractions",), ("attractors",), ("basins", *at)):
        code, _, err = main("plot", figure[0], "run", *figure[1:])
        assert code == 0, err
    code, _, err = main("plot", "gallery", "run", *at)
    assert code == Exit.REFUSED
    assert "there is no attractor" in err
