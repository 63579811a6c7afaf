"""``magpend analyse``: what it prints and stores, and what it refuses."""

from __future__ import annotations

import csv
import re

import numpy as np
import pytest
import xarray as xr

from pipeline.analysis.attractors.table import attractors_table
from pipeline.analysis.basins.basins import basins as basins_of
from pipeline.analysis.basins.table import basins_table
from pipeline.analysis.tabular import FEW_POINTS
from pipeline.cli.exits import Exit
from pipeline.layout.vocabulary import APERIODIC, EVIDENCE, KINDS, NOT_SETTLED, STABILITIES
from pipeline.runs.derive import derive
from tests.pipeline.plots.made_up import make_attractors

NUMBERS = (
    "multiplier_error",
    "lyapunov_max",
    "lyapunov_low",
    "lyapunov_high",
    "mean_lifetime",
    "lifetime_low",
    "lifetime_high",
)
COUNTS = ("n_sampled", "n_left", "closes_above")

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
    assert lines[at + 1].split()[:5] == ["id", "kind", "stability", "period", "side"]
    left, right = (next(line for line in lines[at:] if f" {side} " in line) for side in ("left", "right"))
    assert re.search(r"periodic orbit +attracts +1 +left +0\.000 0\.000 +0\.9[67]\d\d ", left)
    assert re.search(r"0\.\d{4} \(0\.\d{4} to 0\.\d{4}\)", right)
    assert left.endswith("multipliers")
    assert lines[at + 1].endswith("shown by")
    assert lines[-1] == "all 32 cells end on attractors"
    ds = derive(spirals, "attractors")
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


def test_basins__fractions_and_boundaries(main, spirals, tmp_path):
    arguments = ["analyse", "basins", spirals, "--box", "2", "--interval", "clopper-pearson"]
    code, out, err = main(*arguments, "--csv", tmp_path / "b.csv")
    assert code == 0, err
    assert "clopper-pearson, 95 %" in out
    # four boxes are too few for an error
    assert re.search(r"basin entropy: 0\.\d+ \(error not known\)", out)
    assert "not computed: uncertainty exponent" in out
    assert "an attractor that no cell shows: at most 0.171 of the region" in out
    with (tmp_path / "b.csv").open() as file:
        rows = list(csv.DictReader(file))
    for frequency in ("2.2", "2.25"):
        counts = [int(row["n_cells"]) for row in rows if row["frequency"] == frequency]
        assert sum(counts) == 16
    code, _, err = main(*arguments, "--box", "3")
    assert "attractors: taken from" in err
    assert "basins: computed" in err


CHAOTIC = """
kind = "sweep"
model = "duffing"
parameters = { preset = "twin-well", frequency_hz = 0.15915494309189535 }
axes = { amplitude = { values = [0.25, 0.3] } }
initial_conditions = { kind = "random", n = 8, seed = 1, x = [-1.0, 1.0], v = [-1.0, 1.0] }
integration = { rtol = 1e-7, atol = 1e-7, n_transient = 100, n_keep = 64 }
"""


@pytest.fixture
def chaotic(copied):
    """Two orbits of period 1 at the first amplitude, a chaotic attractor at the second."""
    return copied(CHAOTIC)


def test_settling__says_what_stays(main, chaotic, tmp_path):
    """The cells of the chaotic attractor are extended, and none leaves."""
    code, out, err = main("analyse", "settling", chaotic, "--n-sample", "4", "--csv", tmp_path / "s.csv")
    assert code == 0, err
    ds = derive(chaotic, "settling", {"n_sample": 4})
    (place,) = np.argwhere(np.isin(ds["kind"].values, APERIODIC))
    one = ds.isel(amplitude=place[0], attractor=place[1])
    assert out.startswith("sets that do not close: 1; lifetimes are in drive periods\n")
    with (tmp_path / "s.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (float(row["amplitude"]), int(row["attractor_id"])) == (0.3, place[1])
    assert (row["kind"], row["stability"]) == ("chaotic_set", "attracts")
    assert int(row["n_cells"]) == 8
    assert 4 <= int(row["n_sampled"]) == int(one["n_sampled"])
    assert int(row["n_left"]) == 0
    assert float(row["lifetime_low"]) == float(one["lifetime_low"]) > 100
    names = "id +kind +stability +cells +extended +near an orbit +left later +mean lifetime +to"
    assert re.search(rf"amplitude m/s2 +{names}\n", out)
    assert f"above {float(row['lifetime_low']):.0f}" in out
    # the same is said of it in the table of attractors
    _, out, _ = main("analyse", "attractors", chaotic, "--n-sample", "4")
    assert f"{row['n_sampled']} stayed, lifetime above {float(row['lifetime_low']):.0f}" in out


def test_settling__without_extending_nothing_is_shown(main, chaotic):
    """More than that is known once it was asked for, and no analysis contradicts it later."""
    code, out, err = main("analyse", "attractors", chaotic, "--no-extend")
    assert code == 0, err
    assert re.search(r"bounded set +not settled .* - +- +", out)
    assert "8 of 16 cells end on attractors; 8 not settled" in out
    assert "2 attractors at 2 parameter points, and 1 other set on which cells end" in out
    assert "nothing was extended (--no-extend)" in out
    code, out, err = main("analyse", "attractors", chaotic)
    assert code == 0, err
    assert "all 16 cells end on attractors" in out
    code, out, err = main("analyse", "settling", chaotic, "--no-extend")
    assert code == 0, err
    assert "attractors: taken from" in err
    assert re.search(r"chaotic set +attracts ", out)


def test_hysteresis__loops_and_jumps(main, walk, tmp_path):
    code, out, err = main("analyse", "hysteresis", "run", "--no-polish", "--csv", "h.csv")
    assert code == 0, err
    ds = derive(walk, "hysteresis", {"polish": False})
    assert f"jumps of the branches: {int(ds['jump_count'].sum()) or 'none'}" in out
    assert re.search(rf"^{ds.sizes['loop'] or 'no'} loop", out, re.MULTILINE)
    with (tmp_path / "h.csv").open() as file:
        assert sum(int(row["count"]) for row in csv.DictReader(file)) == int(ds["jump_count"].sum())
    # a continuation's branches are no sample of initial conditions
    code, out, _ = main("analyse", "attractors", "run", "--no-polish")
    assert code == 0
    assert "share" not in out
    code, _, err = main("analyse", "basins", "run")
    assert code == Exit.REFUSED
    assert "independent initial conditions" in err
    # the figure of attractors shows the loops
    code, _, err = main("plot", "attractors", "run", "--degrees", "--format", "svg")
    assert code == 0, err
    assert "hysteresis: computed" in err
    with xr.open_dataset(walk / "figures" / "attractors_psi1_degrees.nc", engine="scipy") as stored:
        assert {"value", "share", "present"} <= set(stored.data_vars)
        assert stored["value"].attrs["units"] == "deg"


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
    assert not any((directory / "derived").iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["attractors", "--tolerance", "-1"], "tolerance = -1.0: must be at least 0."),
        (["attractors", "--threshold", "0"], "threshold = 0.0: must be greater than 0."),
        (["settling", "--n-sample", "0"], "n_sample = 0: must be at least 1."),
        (["settling", "--lifetime-confidence", "1"], "lifetime_confidence = 1.0: must be less than 1."),
        (["attractors", "--look-back", "0"], "look_back = 0: must be at least 1."),
        (["basins", "--budget", "-1"], "budget = -1.0: must be at least 0."),
        (["basins", "--confidence", "nan"], "confidence = nan: must be a finite number."),
        (["basins", "--box", "1"], "box = 1: must be at least 2."),
        (["basins", "--interval", "wilsen"], "Did you mean 'wilson'?"),
        (["attractors", "--treshold", "1"], "did you mean"),
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


def test_report__a_line_per_attractor_if_there_are_many_points():
    n = FEW_POINTS + 1
    cells = np.zeros((n, 10), np.int32)
    cells[4:, :3] = 1
    cells[5, :8] = 1
    frequency, per = 2.0 + 0.5 * np.arange(n), ("frequency", "attractor")
    cells_of = ("frequency", "initial_condition")
    ds = make_attractors(cells, cells_of, {"frequency": ("frequency", frequency, {"units": "Hz"})})
    flags = {"flag_values": [0, 1, 2], "flag_meanings": "pending periodic bounded"}
    meanings = {"decision": "undecided closed extended", "side": "unknown left right", "kind": " ".join(KINDS)}
    for name, text in {**meanings, "stability": " ".join(STABILITIES)}.items():
        ds[name].attrs["flag_meanings"] = text
    ds["status"].attrs, kind = flags, (ds["kind"] > 0).values
    nan = np.full((n, 2), np.nan)
    ds = ds.assign(
        ran_out=("frequency", np.zeros(n, np.int8)),
        evidence=(per, np.zeros((n, 2), np.int8), {"flag_meanings": " ".join(EVIDENCE)}),
        orbit_period=(per, kind * np.array([1, 2])),
        period_s=(per, kind * np.array([1, 2]) / frequency[:, None]),
        side=ds["side"] * 0,
        multiplier_real=((*per, "multiplier"), nan[..., None]),
        multiplier_imag=((*per, "multiplier"), nan[..., None]),
        mirror_partner=(per, -kind.astype(int)),
        mirror_distance=(per, nan),
        **{name: (per, nan) for name in NUMBERS},
        **{name: (per, np.zeros((n, 2), int)) for name in COUNTS},
    )
    ds["side"].attrs["flag_meanings"] = meanings["side"]
    lines = attractors_table(ds).lines
    assert lines[0] == f"2 attractors at {n} parameter points"
    assert lines[1].split()[:4] == ["id", "kind", "stability", "periods"]
    assert re.search(r"^  0 +periodic orbit +attracts +1 +unknown +2 to 5 +7 +56 .*1\.0000 at 2 Hz", lines[2])
    assert re.search(r"^  1 +periodic orbit +attracts +2 +unknown +4 to 5 +3 +14 .*0\.8000 at 4\.5 Hz", lines[3])
    assert lines[4] == "all 70 cells end on attractors"
    other = ds.copy(deep=True)
    other["stability"][5, 1] = NOT_SETTLED
    lines = attractors_table(other).lines
    assert re.search(r"^  1 +periodic orbit +attracts, not settled +2 .*0\.3000 at 4 Hz", lines[3])
    assert lines[4] == "62 of 70 cells end on attractors; 8 not settled"
    cube = ds[["status"]].assign(n_periods=ds["status"])
    measured = basins_of(cube, ds)
    lines = basins_table(measured).lines
    assert re.search(r"^  1 +4 to 5 +3 +14 .*0\.8000 at 4\.5 Hz", lines[3])
    assert lines[4] == "not computed: boundaries: the starts are no grid"
    assert not any("inferred" in line for line in lines)
    refined = ds["status"].where(cells == 0, 7).astype(np.int8).assign_attrs(flags)
    measured = basins_of(cube, ds.assign(status=refined))
    rows = basins_table(measured).rows
    assert [row["n_inferred"] for row in rows] == [row["n_cells"] * (row["label"] == 1) for row in rows]
    lines = basins_table(measured).lines
    assert lines[1].endswith("inferred cells")
    assert re.search(r"^  1 +4 to 5 +3 +14 +0\.8000 at 4\.5 Hz.* 14$", lines[3])


def test_analyse__run_without_attractors(main, write_spec, tmp_path):
    """Every cell diverged at once: tables and figures say so, none fails."""
    write_spec("""
kind = "sweep"
[axes]
frequency_hz = { values = [2.6, 2.8] }
[initial_conditions]
kind = "grid"
psi1_deg = { start = -10, stop = 10, num = 3 }
psi2_deg = { start = -10, stop = 10, num = 2 }
psi1_dot = 1e9
[integration]
n_transient = 8
n_keep = 16
""")
    assert main("run", "spec.toml", "--out", "run", "--workers", "0")[0] == 0
    code, out, err = main("analyse", "attractors", "run", "--csv", "a.csv")
    assert code == 0, err
    assert "0 attractors at 2 parameter points" in out
    assert "0 of 12 cells end on attractors; 12 diverged" in out
    code, out, err = main("analyse", "basins", "run")
    assert code == 0, err
    assert re.search(r"diverged +6 +1\.0000 \(0\.6097 to 1\.0000\)", out)
    code, out, err = main("analyse", "settling", "run")
    assert code == 0, err
    assert "sets that do not close: none" in out
    for figure in ("fractions", "attractors"):
        code, _, err = main("plot", figure, "run")
        assert code == 0, err
    assert main("plot", "basins", "run", "--at", "frequency=2.6")[0] == 0
    code, _, err = main("plot", "gallery", "run", "--at", "frequency=2.6")
    assert code == Exit.REFUSED
    assert "there is no attractor" in err
