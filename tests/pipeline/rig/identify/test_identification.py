"""From a specification and files to a finished identification; data by another integrator."""

from __future__ import annotations

import json
import shutil
import signal
import time
import tomllib

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from magpend_core.models import load_model
from pipeline.rig.identify import directory as d
from pipeline.rig.identify import identification
from pipeline.rig.identify import validation as checking
from pipeline.specification.problems import SpecError

TRUTH = {"damping": 0.15, "linear": 1.1, "cubic": 0.4}
NOISE, ZERO = 0.004, 0.02

SPEC = """
kind = "identification"
title = "ring-downs of an oscillator"
model = "duffing"
preset = "hardening"
[parameters]
amplitude = 0.0
[identify.damping]
bounds = [0.0, 1.0]
[identify.linear]
[identify.cubic]
[sensors]
zero = ["x"]
[[recordings]]
file = "ringdown.csv"
mapping = "ringdown.toml"
hold_out = [2]
[search]
n_starts = 3
n_samples = 8
"""
MAPPING = """
model = "duffing"
time = { channel = "time" }
drive = "none"
[channels.x]
channel = "x"
unit = "m"
"""


def oscillator(_, y):
    return y[1], -TRUTH["damping"] * y[1] - TRUTH["linear"] * y[0] - TRUTH["cubic"] * y[0] ** 3


def write_ringdowns(path, seed, n_pieces=4, n=150):
    """Pieces of ring-downs by DOP853, a gap of a second between them, a zero offset and noise."""
    rng, rows, begin = np.random.default_rng(seed), [], 0.0
    for _ in range(n_pieces):
        t = 0.1 * np.arange(n)
        found = solve_ivp(
            oscillator,
            (0.0, t[-1]),
            [rng.uniform(1.0, 2.0), rng.uniform(-1.0, 1.0)],
            method="DOP853",
            t_eval=t,
            rtol=1e-10,
            atol=1e-10,
        )
        x = found.y[0] + ZERO + NOISE * rng.normal(size=n)
        rows += [f"{begin + a:.3f},{b:.8f}" for a, b in zip(t, x, strict=True)]
        begin += t[-1] + 1.1
    path.write_text("\n".join(["time,x", *rows]) + "\n")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with a specification, its recording, another recording, and a finished identification."""
    folder = tmp_path_factory.mktemp("bench")
    write_ringdowns(folder / "ringdown.csv", 1)
    write_ringdowns(folder / "other.csv", 2, n_pieces=3, n=120)
    (folder / "ringdown.toml").write_text(MAPPING)
    (folder / "spec.toml").write_text(SPEC)
    lines = []
    result = identification.identify(folder / "spec.toml", folder / "out", echo=lines.append)
    return folder, result, lines


def files_of(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.slow
def test_identify__truth_is_within_the_intervals(bench):
    _, result, lines = bench
    # three gaps: a warning or a note each, nothing that makes the numbers wrong
    said = result["recordings"][0]["findings"]
    assert all(line in "\n".join(lines) for line in said)
    assert not any("error" in line for line in said)
    truth = {**TRUTH, "zero.x": ZERO}
    assert result["names"] == ["damping", "linear", "cubic", "zero.x"]
    for name, value in truth.items():
        low, high = result["estimates"][name]["interval"]
        # twice as wide: one in twenty of 95 % intervals misses
        margin = 0.5 * (high - low)
        assert low - margin < value < high + margin, name
        assert high - low < 0.1 * max(abs(value), 0.1)
    assert result["covariance"]["estimator"] == "white"
    assert result["rms"]["x"] == pytest.approx(NOISE, rel=0.1)
    assert result["held_out"]["rms"]["x"] == pytest.approx(NOISE, rel=0.2)
    assert [p["piece"] for p in result["held_out"]["pieces"]] == [2]
    assert [p["piece"] for p in result["pieces"]] == [0, 1, 3]
    assert 0.999 < result["correlation"]["x"] < 1
    assert result["warnings"] == []


def test_identify__preset_reads_back(bench):
    folder, result, _ = bench
    preset = load_model("duffing").preset(folder / "out" / "preset.toml")
    assert dict(preset.values) == pytest.approx(result["values"], rel=1e-15)
    assert "identified from ringdown.csv" in preset.provenance["linear"]
    assert "specification" in preset.provenance["amplitude"]


def test_identify__residuals_are_measured_less_computed(bench):
    import xarray as xr

    folder, result, _ = bench
    with xr.open_dataset(folder / "out" / "residuals.nc", engine="scipy") as ds:
        fitted = ds["held_out"].values == 0
        rms = float(np.sqrt(np.mean(ds["x_residual"].values[fitted] ** 2)))
        assert rms == pytest.approx(result["rms"]["x"], rel=1e-12)
        assert ds.sizes["sample"] == 600


def test_identify__again_does_nothing(bench):
    folder, result, _ = bench
    before, lines = files_of(folder / "out"), []
    assert identification.identify(folder / "spec.toml", folder / "out", echo=lines.append) == result
    assert files_of(folder / "out") == before
    assert lines == [f"{folder / 'out'} is complete; nothing to do."]


@pytest.mark.slow
def test_identify__goes_on_to_the_same_bytes(bench, tmp_path):
    """As after a kill: some outcomes are there, one of them torn, and no result."""
    folder, _, _ = bench
    whole = files_of(folder / "out")
    out = tmp_path / "out"
    shutil.copytree(folder / "out", out)
    for name in (d.RESULT, d.PRESET, d.RESIDUALS, "outcomes/start-0002.npz", "outcomes/profile-cubic.npz"):
        (out / name).unlink()
    torn = out / "outcomes" / "start-0001.npz"
    torn.write_bytes(torn.read_bytes()[:200])
    kept = (out / "outcomes" / "start-0000.npz").stat().st_mtime_ns
    identification.identify(folder / "spec.toml", out, echo=lambda _: None)
    assert files_of(out) == whole
    assert (out / "outcomes" / "start-0000.npz").stat().st_mtime_ns == kept


@pytest.mark.slow
def test_identify__stopped_by_a_signal_goes_on_to_the_same_bytes(bench, tmp_path, start):
    """A process stopped between two outcomes says so, and the same command continues."""
    folder, _, _ = bench
    out = tmp_path / "out"
    process = start("identify", folder / "spec.toml", "--out", out)
    deadline = time.monotonic() + 120
    while not list(out.glob("outcomes/start-*.npz")) and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 143
    assert "the same command continues from there" in err
    assert not (out / d.RESULT).exists()
    identification.identify(folder / "spec.toml", out, echo=lambda _: None)
    whole, found = files_of(folder / "out"), files_of(out)
    begun = {d.IDENTIFICATION}  # says when and where
    assert {k: v for k, v in found.items() if k not in begun} == {k: v for k, v in whole.items() if k not in begun}


def test_result__an_error_in_a_recording_is_a_warning_of_the_result():
    from pipeline.rig.identify.reports import _errors

    source = d.Source("a.csv", "", "")
    found = _errors([source], [["warning: gap of x: none", "error: wrap of x: it jumps by a turn"]])
    assert found == ["a.csv has an error: wrap of x: it jumps by a turn"]


def test_check__refits_the_starts_alone(bench):
    folder, result, _ = bench
    found = checking.check(folder / "out", folder / "other.csv")
    assert found["rms"]["x"] == pytest.approx(NOISE, rel=0.15)
    assert len(found["pieces"]) == 3
    assert found["correlation"]["x"] > 0.999
    # a wrong parameter shows
    values = json.loads((folder / "out" / d.RESULT).read_text())
    other = folder / "wrong"
    shutil.copytree(folder / "out", other)
    values["values"]["linear"] *= 1.05
    (other / d.RESULT).write_text(json.dumps(values))
    assert checking.check(other, folder / "other.csv")["rms"]["x"] > 5 * NOISE
    assert result["values"]["linear"] != values["values"]["linear"]


def test_cli__identify_and_check(bench, main):
    folder, result, _ = bench
    code, out, _ = main("identify", folder / "spec.toml", "--out", folder / "out")
    assert code == 0
    assert "damping = " in out
    assert f"preset: {folder / 'out' / 'preset.toml'}" in out
    code, out, _ = main("identify", folder / "spec.toml", "--out", folder / "out", "--json")
    assert json.loads(out)["rms"] == result["rms"]
    words = ("identify", "check", folder / "out", folder / "other.csv")
    assert json.loads(main(*words, "--json")[1])["rms"]["x"] == pytest.approx(NOISE, rel=0.15)
    assert "piece 2: x " in main(*words)[1]


def test_cli__kinds_are_told_apart(bench, main):
    folder, _, _ = bench
    code, _, err = main("run", folder / "spec.toml", "--out", folder / "no")
    assert code == 2
    assert "magpend identify" in err
    code, _, err = main("identify", "quickstart", "--out", folder / "no")
    assert code == 2
    assert "magpend run" in err
    code, _, err = main("identify", "check", folder / "no", folder / "other.csv")
    assert code == 2
    assert "no identification" in err
    assert not (folder / "no").exists()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("hold_out = [2]", "hold_out = [0, 1, 2, 3]", "all pieces are held out"),
        ("hold_out = [2]", "hold_out = [2, 7]", "pieces 0 to 3, and no 7"),
        ("hold_out = [2]", "window_s = [900.0, 901.0]", "window"),
        ("hold_out = [2]", "piece_s = 0.5", "choose a longer piece_s"),
        ("hold_out = [2]", 'drive = "recorded"', "names no drive channel"),
        ("amplitude = 0.0", "amplitude = 0.2", "the model is driven"),
        ("[search]", '[fit]\nchannels = ["v"]\n[search]', "has no channel 'v'"),
    ],
)
def test_identify__bad_input_is_refused_before_anything(bench, tmp_path, old, new, words):
    folder, _, _ = bench
    assert old in SPEC
    text = SPEC.replace(old, new).replace('zero = ["x"]', "") if "channels" in new else SPEC.replace(old, new)
    (folder / "bad.toml").write_text(text)
    with pytest.raises(SpecError, match=words):
        identification.identify(folder / "bad.toml", tmp_path / "out", echo=lambda _: None)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_identify__no_convergence_is_no_result(bench, tmp_path, monkeypatch, main):
    from dataclasses import replace

    folder, _, _ = bench
    search = identification.search

    def failing(*args, **kwargs):
        return [replace(fit, converged=False, message="no end in sight") for fit in search(*args, **kwargs)]

    monkeypatch.setattr(identification, "search", failing)
    code, _, err = main("identify", folder / "spec.toml", "--out", tmp_path / "out")
    assert code == 4
    assert "none of 3 starts converged" in err
    assert "no end in sight" in err
    assert not (tmp_path / "out" / d.RESULT).exists()


def test_refuse_invisible__names_what_the_data_cannot_see(bench):
    """A cubic stiffness where nothing ever moves, and starts at rest."""
    from dataclasses import replace

    from pipeline.rig.identify.build import build, read_all
    from pipeline.rig.identify.specification import parse_identification

    folder, _, _ = bench
    spec = parse_identification(tomllib.loads(SPEC), folder)
    problem = build(spec, read_all(spec)).problem
    still = tuple(replace(p, start=np.zeros(2)) for p in problem.pieces)
    with pytest.raises(SpecError) as caught:
        identification.refuse_invisible(replace(problem, pieces=still))
    by_tangents = parse_identification(tomllib.loads(SPEC + '[fit]\nslopes = "variational"\n'), folder)
    assert build(by_tangents, read_all(by_tangents)).problem.slopes == "variational"
    assert [p.split(":")[0] for p in caught.value.problems] == ["identify.damping", "identify.linear", "identify.cubic"]


@pytest.fixture(scope="module")
def without_cubic(bench):
    """The same recording with a law that lacks something."""
    folder, _, _ = bench
    text = SPEC.replace("[identify.cubic]\n", "").replace("amplitude = 0.0", "amplitude = 0.0\ncubic = 0.0")
    (folder / "linear.toml").write_text(text.replace("profiles = true", "profiles = false"))
    identification.identify(folder / "linear.toml", folder / "linear", figures=False, echo=lambda _: None)
    return folder / "linear"


@pytest.mark.slow
def test_compare__goes_by_held_out_pieces(bench, without_cubic, main):
    folder, _, _ = bench
    code, out, _ = main("identify", "compare", without_cubic, folder / "out", "--json")
    assert code == 0
    rows = json.loads(out)
    assert [r["directory"] for r in rows] == [str(folder / "out"), str(without_cubic)]
    assert rows[0]["held_out_x"] < 0.5 * rows[1]["held_out_x"]
    assert [r["unknowns"] for r in rows] == [4, 3]
    code, out, _ = main("identify", "compare", without_cubic, folder / "out")
    assert out.splitlines()[0].startswith(f"{folder / 'out'}: held out x 0.00")


def test_compare__refuses_other_data(bench, tmp_path):
    from pipeline.rig.identify.validation import compare

    folder, _, _ = bench
    shutil.copytree(folder / "out", tmp_path / "other")
    path = tmp_path / "other" / d.RESULT
    result = json.loads(path.read_text())
    result["held_out"] = None
    path.write_text(json.dumps(result))
    with pytest.raises(SpecError, match="other held-out pieces"):
        compare([folder / "out", tmp_path / "other"])


@pytest.mark.slow
def test_identify__what_the_model_lacks_is_found_in_the_residuals(without_cubic):
    """The residuals of a law that lacks something are autocorrelated, and the intervals say so."""
    result = d.read_result(without_cubic)
    assert "the residuals are autocorrelated" in result["covariance"]["why"]
    assert result["covariance"]["estimator"] == "newey-west"
    assert result["covariance"]["n_effective"]["x"] < 0.3 * result["covariance"]["n_samples"]


def test_check__long_pieces_of_other_numbers_and_lengths(bench, tmp_path):
    """Starts are found over stretches that grow; one short piece and two long ones, each its own length."""
    folder, _, _ = bench
    parts = []
    for k, (seed, n) in enumerate([(11, 40), (12, 700), (13, 1000)]):
        write_ringdowns(tmp_path / "one.csv", seed, n_pieces=1, n=n)
        rows = (tmp_path / "one.csv").read_text().split()[1:]
        parts += [f"{float(r.split(',')[0]) + 200 * k:.3f},{r.split(',')[1]}" for r in rows]
    (tmp_path / "long.csv").write_text("\n".join(["time,x", *parts]) + "\n")
    found = checking.check(folder / "out", tmp_path / "long.csv")
    assert len(found["pieces"]) == 3
    for piece in found["pieces"]:
        assert piece["rms"]["x"] == pytest.approx(NOISE, rel=0.25)


def test_judgement__without_a_spread_has_no_correlation():
    from pipeline.rig.identify.judgement import Judgement
    from pipeline.rig.identify.problem import Piece

    measured = np.column_stack([np.ones(5), np.arange(5.0), np.full(5, np.nan)])
    piece = Piece(0, 0, np.arange(5.0), measured, np.zeros(2))
    judged = Judgement(("a", "b", "c"), (piece,), (0.1 * measured,)).as_dict()
    assert judged["correlation"]["a"] is None
    assert judged["correlation"]["b"] == pytest.approx(1.0)
    assert judged["rms"]["a"] == pytest.approx(0.1)
    assert judged["rms"]["c"] is None


@pytest.mark.slow
def test_identify__outliers_under_a_robust_loss(bench, tmp_path):
    """One sample in forty is off by a hundred times the noise: that leads least squares alone astray."""
    folder, _, _ = bench
    rng = np.random.default_rng(8)
    rows = [line.split(",") for line in (folder / "ringdown.csv").read_text().split()[1:]]
    for i in rng.choice(len(rows), len(rows) // 40, replace=False):
        rows[i][1] = str(float(rows[i][1]) + 100 * NOISE * rng.choice([-1, 1]))
    (tmp_path / "ringdown.csv").write_text("\n".join(["time,x", *(",".join(r) for r in rows)]) + "\n")
    (tmp_path / "ringdown.toml").write_text(MAPPING)
    text = SPEC.replace("n_starts = 3", "n_starts = 1").replace("n_samples = 8\n", "")
    found = {}
    for loss in ("linear", "cauchy"):
        # profiles are those of the robust fit alone
        search = text if loss == "cauchy" else text.replace("n_starts = 1", "n_starts = 1\nprofiles = false")
        (tmp_path / "spec.toml").write_text(f'{search}[fit]\nloss = "{loss}"\nnoise = {{ x = {NOISE} }}\n')
        found[loss] = identification.identify(
            tmp_path / "spec.toml", tmp_path / loss, figures=False, echo=lambda _: None
        )
    errors = {loss: abs(r["values"]["linear"] - TRUTH["linear"]) for loss, r in found.items()}
    assert errors["cauchy"] < errors["linear"]
    assert found["cauchy"]["covariance"]["estimator"] == "newey-west"
    low, high = found["cauchy"]["estimates"]["linear"]["interval"]
    assert low - 0.5 * (high - low) < TRUTH["linear"] < high + 0.5 * (high - low)
    # the profile of the loss, against the standard error of its scores
    profile_low, profile_high = found["cauchy"]["estimates"]["linear"]["profile_interval"]
    assert profile_high - profile_low == pytest.approx(high - low, rel=0.3)
    wide = np.diff(found["linear"]["estimates"]["linear"]["interval"])
    assert high - low < 0.5 * wide


@pytest.mark.slow
def test_identify__stretches_with_a_price_on_their_gaps(bench, tmp_path):
    """Gaps that cost take freedom from the starts: intervals are those of whole pieces, or nearly."""
    folder, whole, _ = bench
    text = SPEC.replace("hold_out = [2]", "piece_s = 4.0")
    text = text.replace("n_starts = 3", "n_starts = 1\nprofiles = false").replace("n_samples = 8\n", "")
    width = {}
    for name, price in (("free", '"free"'), ("joined", "1000.0")):
        (folder / f"{name}.toml").write_text(f"{text}[fit]\ncontinuity = {price}\n")
        result = identification.identify(folder / f"{name}.toml", tmp_path / name, figures=False, echo=lambda _: None)
        assert len(result["pieces"]) == 16
        low, high = result["estimates"]["linear"]["interval"]
        assert low - 0.5 * (high - low) < TRUTH["linear"] < high + 0.5 * (high - low)
        width[name] = high - low
    low, high = whole["estimates"]["linear"]["interval"]
    assert width["joined"] < 0.6 * width["free"]
    # four pieces instead of the three that were fitted whole
    assert width["joined"] == pytest.approx((high - low) * np.sqrt(3 / 4), rel=0.35)
