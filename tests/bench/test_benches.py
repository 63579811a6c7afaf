"""Benchmarks are no part of the suite: one test looks at their parts and their options.

``MAGPEND_LONG=1`` runs every benchmark once, in a tiny size, so that none of them rots.
"""

import contextlib
import importlib
import io
import subprocess
import sys
from importlib.util import find_spec
from inspect import signature
from pathlib import Path

import numpy as np
import pytest

TINY = ["--trajectories", "8", "--periods", "1", "--rounds", "1"]
TINY_PEERS = [*TINY, "--error-period", "1", "--eps-drive", "preset", "--scipy-trajectories", "1"]


@pytest.fixture
def bench(monkeypatch):
    """Import a benchmark by name."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    return importlib.import_module


def test_benches__can_be_imported_and_say_their_options(bench, capsys):
    """An edit of the package that takes away what a benchmark imports, or of its options, is seen here."""
    for path in sorted(Path(__file__).parent.glob("*.py")):
        if path.stem == "test_benches" or (path.stem == "heyoka_model" and not find_spec("heyoka")):
            continue
        module = bench(path.stem)
        takes_options = hasattr(module, "main") and signature(module.main).parameters
        if takes_options and "ArgumentParser" in path.read_text("utf-8"):
            with pytest.raises(SystemExit) as end:
                module.main(["--help"])
            assert end.value.code == 0
            assert "usage:" in capsys.readouterr().out, path.stem


@pytest.mark.long
def test_scalar_twin__agrees_with_the_lanes(bench):
    kernel = bench("kernel")
    case = kernel.case_of(kernel.parse(["--trajectories", "32"]))
    assert kernel.check_agreement(case) < kernel.AGREEMENT


@pytest.mark.long
def test_kernel__prints_all_tables(bench, monkeypatch, capsys):
    kernel = bench("kernel")
    # children would compile everything again: their work is done here
    monkeypatch.setattr(kernel, "run_in_child", lambda arguments, environment: kernel.main(arguments))
    kernel.main([*TINY, "--tolerances", "1e-4", "1e-6"])
    printed = capsys.readouterr().out
    for name in (*kernel.VARIANTS, "lanes, tolerance 1e-04", "first run_branches"):
        assert name in printed


@pytest.mark.long
def test_kernel__limiter_is_back_after_the_run_without(bench):
    kernel = bench("kernel")
    module = importlib.import_module("magpend_core.engine.entry")
    before = module.SLACK
    with kernel.no_limiter():
        assert before < module.SLACK
    assert before == module.SLACK


@pytest.mark.long
def test_cheap__prints_all_variants(bench, capsys):
    cheap = bench("cheap")
    cheap.main(TINY)
    printed = capsys.readouterr().out
    for name in (*cheap.VARIANTS, "largest difference"):
        assert name in printed


@pytest.mark.long
def test_noisy__prints_the_ratio_of_each_case(bench, capsys):
    noisy = bench("noisy")
    noisy.main(["--trajectories", "16", "--periods", "1", "--steps", "8", "--rounds", "1", "--cases", "duffing"])
    assert "steps per second with noise over without" in capsys.readouterr().out


@pytest.mark.long
def test_events__prints_both_tables(bench, capsys):
    bench("events").main([*TINY[:2], "--periods", "2", "--rounds", "1", "--flows", "lorenz"])
    printed = capsys.readouterr().out
    for name in ("lorenz", "without the stop"):
        assert name in printed


@pytest.mark.long
def test_peers__models_are_the_same(bench):
    line = bench("peers").check_models(bench("magpend_core").load_preset(), seed=1)
    assert "scalar model" in line


@pytest.mark.long
def test_work_precision__draws_and_prints(bench, monkeypatch, tmp_path, capsys):
    # without numbalsoda, which compiles the model once more, scipy gives the reference; heyoka
    # compiles for minutes, and its model is checked above
    monkeypatch.setitem(sys.modules, "numbalsoda", None)
    out = tmp_path / "work_precision.png"
    bench("work_precision").main([*TINY_PEERS, "--peers", "magpend", "numbalsoda", "--out", str(out)])
    printed = capsys.readouterr().out
    assert out.stat().st_size > 0
    assert "us per period" in printed
    assert "numbalsoda is left out" in printed


@pytest.mark.long
def test_multistable_pendulum__prints_both_variants_with_the_same_labels(bench, capsys):
    bench("multistable_pendulum").main(["--starts", "200", "--rounds", "1"])
    printed = capsys.readouterr().out
    assert "to the end" in printed
    assert "until certain" in printed
    assert "starts with other labels in the two: 0" in printed
    assert "undecided  0 starts" in printed


@pytest.mark.long
def test_multistable_pendulum__threads_change_nothing(bench, monkeypatch):
    pendulum = bench("multistable_pendulum")
    monkeypatch.setattr(pendulum, "CHUNK", 16)
    one, three = (pendulum.whole("to the end", 50, 200.0, threads, 3) for threads in (1, 3))
    assert one.label.tolist() == three.label.tolist()
    assert one.attempts == three.attempts


@pytest.mark.long
def test_basins__prints_ratios_and_labels(bench, capsys):
    few = ["--scipy-trajectories", "1", "--scipy-periods", "1"]
    bench("basins").main(["--size", "4", "--bands", "2", "--transient", "300", *few])
    printed = capsys.readouterr().out
    for text in ("fixed transient", "stopped early", "ratio: periods 0.", "same labels: ", "RK45"):
        assert text in printed


@pytest.mark.long
def test_tangents__prints_a_ratio_for_each_number_of_exponents(bench, capsys):
    few = ["--trajectories", "4", "--periods", "16", "--rounds", "1"]
    # with two it would compile for itself
    bench("tangents").main([*few, "--exponents", "1", "4"])
    printed = capsys.readouterr().out
    for name in ("plain", "1 exponent ", "4 exponents"):
        assert name in printed


@pytest.mark.long
def test_intervals__hold_the_truth(bench):
    """A few seeds; the bench takes hundreds. Intervals too narrow by a half would hold it in 60 % of them."""
    intervals = bench("intervals")
    share, found = intervals.coverage(5)
    # of 50 intervals of 95 %, those of a seed going together
    assert share.mean() >= 0.8
    assert found[0].n_missing > 0
    assert {o.estimator for o in found} <= {"white", "pieces"}


@pytest.mark.long
def test_identification__compares_the_same_residuals(bench, capsys):
    identification = bench("identification")
    problem = identification.shipped_problem(2)
    apart = np.abs(identification.by_scipy(problem) - identification.by_lanes(problem)) * problem.noise.max()
    assert apart.max() < 1e-4
    identification.main(["--rounds", "1", "--pieces", "1"])
    printed = capsys.readouterr().out
    for name in ("solve_ivp", "variational equations", "normal matrices"):
        assert name in printed


@pytest.mark.long
def test_virtual_rig__finds_all_parameters_again(bench):
    """A third of each recording, one seed: no parameter is off by more than its interval allows."""
    rig = bench("virtual_rig")
    found = rig.outcome(1, shorten=3)
    off = np.abs(found.fit.theta - rig.truth()) / found.errors
    assert off.max() < 4.0
    assert found.hits.sum() >= 12
    assert (found.errors / rig.truth() < 0.5).all()


@pytest.mark.long
def test_text_models__prints_all_tables(bench, monkeypatch, capsys):
    # heyoka and numbalsoda compile for long; that their equations are the same is tested below
    monkeypatch.setitem(sys.modules, "numbalsoda", None)
    folders = []

    def in_this_process(words, *, env, **options):
        """A child would compile everything again, into a folder of its own."""
        folders.append(env["MAGPEND_CACHE_DIR"])
        assert not list(Path(folders[-1]).iterdir())
        written = io.StringIO()
        with contextlib.redirect_stdout(written):
            exec(words[words.index("-c") + 1], {})
        return subprocess.CompletedProcess(words, 0, written.getvalue(), "")

    text_models = bench("text_models")
    monkeypatch.setattr(text_models.subprocess, "run", in_this_process)
    # systems that other tests compile
    few = ["--trajectories", "16", "--periods", "1", "--rounds", "1", "--pairs", "pendulum-free"]
    few += ["--models", "lorenz", "--oscillators", "driven-1e4"]
    text_models.main([*few, "--peers", "scalar", "numbalsoda"])
    printed = capsys.readouterr().out
    for name in ("pendulum-free", "layers found: True", "scalar numba", "later process"):
        assert name in printed
    assert "numbalsoda is left out" in printed
    # a first and a later process
    assert len(folders) == 2
    assert len(set(folders)) == 1


@pytest.mark.long
@pytest.mark.parametrize("name", ["belt", "three-magnets", "pendulum-text"])
def test_text_peers__equations_are_those_of_the_engine(bench, name):
    peers, cases = bench("text_peers"), bench("text_models").CASES
    model = bench("magpend_core").load_model(name)
    pointwise, frequency = bench("magpend_core.pointwise"), 1.0 / cases[name].period
    states = np.random.default_rng(3).uniform(cases[name].low, cases[name].high, (20, len(cases[name].low)))
    ours = pointwise.rates(0.1, states, model.load(), frequency)
    rhs = peers.scalar_rhs(model, model.load().as_dict(), frequency)
    theirs = np.array([rhs(0.1, *y) for y in states.tolist()])
    assert np.allclose(theirs, ours, rtol=1e-10, atol=1e-10)
    heyoka = pytest.importorskip("heyoka")
    variables, right = peers.heyoka_equations(model, model.load().as_dict(), frequency)
    function = heyoka.cfunc(right, variables)
    theirs = function(inputs=np.ascontiguousarray(states.T), time=np.full(len(states), 0.1)).T
    assert np.allclose(theirs, ours, rtol=1e-10, atol=1e-10)


@pytest.mark.long
def test_object_store__prints_a_table(bench, monkeypatch, capsys):
    pytest.importorskip("obstore")
    for name in ("AWS_ENDPOINT_URL", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_REGION"):
        monkeypatch.setenv(name, "")  # the benchmark sets them, and they are as before at the end
    bench("object_store").main(["--tasks", "2", "--latency-ms", "1"])
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("set up", "commit a task", "load a variable", "verify"))


@pytest.mark.long
def test_scaling__ceiling(bench, capsys):
    bench("scaling").main(["--seconds", "0", "--workers", "4", "--task-seconds", "0.05", "--rounds", "3"])
    printed = capsys.readouterr().out
    assert "processor time per task" in printed
    lines = [line.split() for line in printed.splitlines() if "busy" in line and "task" not in line]
    assert len(lines) == 2
    assert all(0 < float(line[-1]) <= 1 for line in lines)


@pytest.mark.long
def test_same_set__prints_a_line_for_each_number_of_sections(bench, capsys):
    same_set = bench("same_set")
    same_set.main(["--cells", "6", "--cases", "Ueda"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines[1:]] == ["20", "60", "300", "512"]
    assert lines[-1].split()[-1] == "1"
