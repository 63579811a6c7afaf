"""The command line: what it prints, what it creates, how it exits."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import xarray as xr

import magpend
from pipeline.cli.console import Exit
from pipeline.plots import bifurcation
from pipeline.products.registry import ANALYSES, FIGURES
from pipeline.results.ragged import dense
from pipeline.runs.derive import derive
from pipeline.runs.preview import figure_command
from pipeline.specification import files
from pipeline.specification.problems import SpecError
from pipeline.store.run import RunDirectory
from tests.pipeline.conftest import WALK

LARGE = ("numpy", "pydantic", "xarray", "zarr", "pandas", "dask", "distributed", "scipy", "numba", "matplotlib")
"""Packages that take long to import."""


def loaded(code):
    """Run code in a fresh process; return the large packages among the modules that it has imported."""
    told = f"import sys\n{code}\nprint(*sorted(set({LARGE}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


def test_start__loads_nothing_large():
    """Each command imports what it needs when it is called, also those of plug-ins."""
    assert loaded("import pipeline.cli.main") == set()


def loaded_by(*words):
    return loaded(f"import pipeline.cli.main as command\nsys.argv = ['magpend', *{words}]\ncommand.main()")


@pytest.mark.slow
def test_commands__load_what_they_need_alone(walk, write_spec):
    assert loaded_by("status", str(walk)) == {"numpy", "pydantic"}
    # cells are integrated, and tasks written, to tell how long that takes; numba imports scipy
    dry = loaded_by("run", str(write_spec(WALK)), "--dry-run")
    assert dry == {"numpy", "pydantic", "numba", "scipy", "zarr"}
    derive(walk, "attractors")
    # xarray imports pandas, and dask's arrays, which import scipy
    assert loaded_by("analyse", "attractors", str(walk)) == {"numpy", "pydantic", "xarray", "pandas", "dask", "scipy"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "guide", "names"),
    [("analyse", ANALYSES.groups, ANALYSES.listed), ("plot", FIGURES.groups, tuple(FIGURES))],
)
def test_help__groups_products_by_what_they_need(main, verb, guide, names):
    needs = {name: words for group in guide.values() for name, words in group.items()}
    assert sorted(needs) == sorted(names)
    text = " ".join(main(verb, "--help")[1].split())
    for name, words in needs.items():
        assert f" {name} " in text
        assert words in text
        if verb == "analyse":
            assert ("noise" in words) == (ANALYSES[name].motions == ("noisy",))
            assert ("drift" in words) == (ANALYSES[name].motions == ("drifting",))


REFUSED = {
    "run": "Missing argument",
    "run no-such-workflow": "no-such-workflow",
    "run quickstrt": "did you mean quickstart?",
    "run spce.toml": "spce.toml: no such file; did you mean spec.toml?",
    "run spce": "spce: no such file; did you mean spec.toml?",
    "run spec.toml --workers nan": "--workers",
    "status .": "no run directory",
    "stauts run": "did you mean status",
    "analyse attractors .": "no run directory",
    "analyse basins . --box x": "--box",
    "analyse . attractors": "the directory comes last: magpend analyse attractors .",
    "analyse attractors run --treshold 1": "did you mean --",
    "analyse curves run": "Missing option '--second'",
    "branches run": "magpend analyse branches DIR",
    "plot bifurcations run": "did you mean bifurcation",
    "simulate --frequency-hz nan": "frequency",
    "simulate --psi1 1 --psi1-deg 1": "keep one",
    "simulate --psi1 --no-figure": "--psi1",
    "simulate --model duffing --psi1 1 --no-figure": "unknown state of duffing 'psi1'",
    "simulate --out a.txt": "a.txt",
    "zoom spec.toml --psi3 0 1 --out a.toml": "unknown axis 'psi3'; did you mean psi",
    "zoom spec.toml --axis freqency=2:3 --out a.toml": "unknown axis 'freqency'; did you mean frequency_hz",
    "zoom spec.toml --frequency 2.1 --out a.toml": "a name with 2 numbers",
}


@pytest.mark.slow
@pytest.mark.parametrize(("line", "sentence"), REFUSED.items())
def test_bad_input__refused_in_a_sentence(main, write_spec, sweep_text, tmp_path, line, sentence):
    write_spec(sweep_text)
    before = sorted(tmp_path.rglob("*"))
    code, out, err = main(*line.split())
    assert (code, out) == (Exit.REFUSED, "")
    assert sentence in err
    assert "Traceback" not in err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_run__dry_run_creates_nothing(main, write_spec, sweep_text, tmp_path):
    write_spec(sweep_text)
    before = sorted(tmp_path.rglob("*"))
    code, out, _ = main("run", "spec.toml", "--dry-run")
    assert code == 0
    axes = "frequency 5, q 2, psi1_0 3, psi2_0 4"
    for words in ("120 cells", axes, "5 of 1 x 2 x 3 x 4 cells", "runs/spec (not created)"):
        assert words in out
    assert sorted(tmp_path.rglob("*")) == before


WELL = "x' = v\nv' = x - x**3 - d*v + A*cos(2*pi*f*t)\nd = 0.15\nA = 0.2"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tables", "hint"),
    [
        ({"noise": {"strengths": {"v": 0.05}, "steps_per_period": 64}}, "section run"),
        ({"drift": {"A": {"from": 0.2, "to": 0.3, "rate_per_period": 0.01}}}, "drift run"),
        ({"axes": {n: {"values": [0.15, 0.2]} for n in ("A", "d", "frequency_hz")}}, "regimes run --at frequency=0.2"),
        ({"axes": {"A": {"values": [0.2, 0.3]}}, "initial_conditions": {"kind": "random", "n": 2}}, "bifurcation run"),
    ],
    ids=["noise", "drift", "three axes", "one axis"],
)
def test_hint_after_a_run__is_a_figure_that_the_run_can_draw(main, tables, hint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    start = {"kind": "list", "points": [[0.1, 0.0]]}
    frequency = {} if "frequency_hz" in tables.get("axes", {}) else {"frequency_hz": 0.159}
    magpend.run(
        {"kind": "sweep", "model": WELL, "parameters": frequency, "initial_conditions": start}
        | {"integration": {"n_transient": 10, "n_keep": 4}, **tables},
        "run",
        workers=0,
        echo=lambda _: None,
    )
    command = figure_command(RunDirectory.open("run"))
    assert command == f"magpend plot {hint}"
    code, _, err = main(*command.split()[1:])
    assert code == 0, err
    name, _, rest = hint.partition(" run")
    assert f"run.plot.{name}({'at={' if rest else ')'}" in repr(magpend.Run.open("run"))


@pytest.mark.slow
def test_run__plot_of_two_parameters_draws_a_diagram_and_says_what_is_left(main, write_spec, sweep_text):
    write_spec(sweep_text)
    code, out, err = main("run", "spec.toml", "--workers", "0", "--plot")
    assert code == 0, err
    assert out.splitlines()[-3:] == [
        "figure: runs/spec/figures/bifurcation_psi1_q_1.6.png",
        "data: runs/spec/figures/bifurcation_psi1_q_1.6.nc",
        "left out: q is drawn at 1.6, one of 2 values. See: magpend plot regimes runs/spec",
    ]


@pytest.mark.slow
def test_atlas__runs_analyses_and_draws_a_specification_or_its_run(main, tmp_path):
    code, out, err = main("atlas", "tongues", "--smoke", "--workers", "0", "--json", "audit.json")
    assert code == 0, err
    assert re.search(r"^\d+ regions?, \d+ curves?, \d+ lines?", out)
    assert "changes of attractors between neighbouring points" in out
    assert out.splitlines()[-2].startswith("figure: runs/tongues-smoke/figures/atlas_")
    rows = json.loads((tmp_path / "audit.json").read_text())
    assert {row["what"] for row in rows} & {"fold", "not_decided"}
    code, again, err = main("atlas", tmp_path / "runs" / "tongues-smoke")
    assert code == 0, err
    assert again.splitlines()[0] == out.splitlines()[0]
    code, _, err = main("analyse", "atlas", tmp_path / "runs" / "tongues-smoke", "--parameter", "K", "--second", "K")
    assert code == Exit.REFUSED
    assert "give two parameters" in err


@pytest.mark.slow
def test_run__status__verify__plot(main, write_spec, walk_text, tmp_path, monkeypatch):
    write_spec(walk_text + "\n[smoke]\ninitial_conditions.n = 2\n")
    words, directory = ("run", "spec.toml", "--smoke", "--workers", "0"), tmp_path / "runs" / "spec-smoke"

    def fails(*_, **__):
        raise ValueError("no paint left")

    with monkeypatch.context() as patch:  # a figure that cannot be drawn is no error of a finished run
        patch.setattr(bifurcation, "plot_bifurcation", fails)
        code, out, _ = main(*words, "--plot")
    assert code == 0
    for said in ("cube: runs/spec-smoke/cube.zarr", "no figure:", "no paint left", "plot bifurcation runs/spec"):
        assert said in out
    assert main(*words, "--plot")[1].splitlines()[-2:] == [
        "figure: runs/spec-smoke/figures/bifurcation_psi1.png",
        "data: runs/spec-smoke/figures/bifurcation_psi1.nc",
    ]
    code, out, _ = main("status", directory)
    assert code == 0
    assert "complete" in out
    assert "24 of 24 cells (100.0 %), 4 of 4 tasks" in out
    assert re.search(r"bounded +\d+ ", out)
    assert main("verify", directory)[0] == 0
    assert main("plot", "bifurcation", directory, "--state", "psi2", "--degrees", "--format", "svg")[0] == 0
    assert (directory / "figures" / "bifurcation_psi2_degrees.svg").read_text().startswith("<?xml")

    chunk = next((directory / "cube.zarr" / "section").glob("c.*"))
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"\0")
    code, out, _ = main("verify", directory)
    assert code == Exit.DAMAGED
    assert "--repair" in out
    code, _, err = main("plot", "bifurcation", directory)
    assert code == Exit.DAMAGED
    assert "magpend verify" in err
    assert main("verify", directory, "--repair")[0] == 0
    assert "incomplete" in main("status", directory)[1]
    assert main(*words)[0] == 0
    assert main("verify", directory)[0] == 0


def test_run__a_failed_task_or_a_locked_directory_has_its_own_code(main, write_spec, sweep_text, monkeypatch, tmp_path):
    from filelock import FileLock

    from pipeline.compute import task

    def fails(*_):
        raise OSError(28, "No space left on device")

    words = ("run", write_spec(sweep_text), "--out", "run", "--workers", "0")
    monkeypatch.setattr(task, "compute", fails)
    code, _, err = main(*words)
    assert code == Exit.FAILED
    assert "No space left on device" in err
    with FileLock(tmp_path / "run" / "lock", is_singleton=False):
        code, _, err = main(*words)
    assert code == Exit.LOCKED
    assert "another magpend run" in err


@pytest.mark.slow
def test_simulate__series_figure_and_data_with_provenance(main, tmp_path):
    words = ("simulate", "--psi1-deg", "10", "--periods", "2", "--samples", "20", "--out")
    assert main(*words, "a.nc")[1].split() == ["series:", "a.nc", "figure:", "a.png"]
    code, out, _ = main(*words, "b.csv")
    assert code == 0
    assert out.split() == ["series:", "b.csv", "figure:", "b.png", "data:", "b.nc"]
    with xr.open_dataset(tmp_path / "b.nc", engine="scipy") as stored:
        assert {"psi1", "path"} <= set(stored.data_vars)
        assert {"created", "host", "versions", "parameters", "model"} <= set(stored.attrs)
    assert stored.attrs["host"].encode() in (tmp_path / "b.png").read_bytes()
    assert main("simulate", "--periods", "2", "--no-figure")[0] == 0
    assert not (tmp_path / "trajectory.png").exists()


def test_default_directory__keeps_dots_in_a_name(tmp_path):
    for name in ("fail_0.05", "fail_0.005"):
        path = tmp_path / f"{name}.toml"
        path.write_text('kind = "sweep"\nmodel = "duffing"\n')
        assert files.default_directory(path, smoke=False) == Path("runs") / name
        assert files.default_directory(path, smoke=True) == Path("runs") / f"{name}-smoke"
        assert files.default_directory(Path(name), smoke=False) == Path("runs") / name


def test_find_spec__of_the_gallery_by_its_folder_and_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = "gallery/ueda-attractor"
    assert files.find_spec(name) == files.shipped_workflows()[name]
    assert files.default_directory(files.find_spec(name), smoke=False) == Path("runs/ueda-attractor")
    with pytest.raises(SpecError, match="did you mean gallery/ueda-attractor"):
        files.find_spec("gallery/ueda-atractor")
    (tmp_path / "gallery").mkdir()
    (tmp_path / name).write_text("", "utf-8")  # a file of one's own comes first
    assert files.find_spec(name) == Path(name)


# ---- magpend analyse -------------------------------------------------------------------------------------


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


@pytest.mark.slow
def test_attractors__table_per_point(main, spirals, tmp_path):
    code, out, err = main("analyse", "attractors", spirals, "--csv", tmp_path / "a.csv")
    assert code == 0, err
    lines = out.splitlines()
    assert "attractors at 2 parameter points" in out
    left = next(line for line in lines[lines.index("frequency 2.2 Hz:") :] if " left " in line)
    assert re.search(r"periodic orbit +attracts +1 +left +0\.000 0\.000 +0\.9[67]\d\d .*multipliers$", left)
    assert lines[-1] == "all 32 cells end on attractors"
    ds = dense(derive(spirals, "attractors"), points=True)
    assert f"stored: {ds.encoding['source']}" in err
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        one = ds.sel(frequency=float(row["frequency"])).isel(attractor=int(row["attractor_id"]))
        assert int(row["n_cells"]) == int(one["n_cells"])
        assert (row["kind"], row["stability"], row["evidence"]) == ("periodic_orbit", "attracts", "multipliers")
        assert float(row["low"]) < float(row["fraction"]) < float(row["high"])
        assert sum(int(count) for name, count in row.items() if name.startswith("by_")) == int(row["n_cells"])
    by_side = {row["side"]: row for row in rows if row["frequency"] == "2.2"}
    assert by_side["left"]["mirror_partner"] == by_side["right"]["attractor_id"]
    assert "attractors: taken from" in main("analyse", "attractors", spirals)[2]


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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
    assert [path.name for path in (directory / "derived").iterdir()] == ["chosen.json"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["attractors", "--tolerance", "-1"], "tolerance = -1.0: must be at least 0."),
        (["attractors", "--threshold", "0"], "threshold = 0.0: must be greater than 0."),
        (["basins", "--confidence", "nan"], "confidence = nan: must be a finite number."),
        (["basins", "--interval", "wilsen"], "Did you mean 'wilson'?"),
        (["dimension", "--at", "freqency_hz=2.2"], "unknown axis 'freqency_hz'; did you mean frequency_hz?"),
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


@pytest.mark.slow
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
