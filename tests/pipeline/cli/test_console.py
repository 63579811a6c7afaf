"""What goes where: results to the standard output, notes beside it, progress from the first seconds on."""

from __future__ import annotations

import csv
import io
import json
import logging
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from magpend_core.engine import jit
from magpend_core.models import DEFAULT
from pipeline.cli import console, models
from pipeline.cli.common import tell
from pipeline.cli.console import Exit, Work, progress
from pipeline.products.product import Table
from pipeline.products.reporting import report, reporting
from tests.programs import fresh_python

TABLE = Table([{"x": np.float64(1.5), "name": "a"}, {"x": np.nan, "name": "b"}], ["two lines", "for people"])


@pytest.fixture(autouse=True)
def _configured():
    console.configure(False, False, None)
    yield
    console.close()


def test_tell__lines_for_people_and_rows_for_programs(capsys, tmp_path):
    tell(TABLE, None, None)
    assert capsys.readouterr().out == "two lines\nfor people\n"
    tell(TABLE, "-", None)
    assert list(csv.DictReader(io.StringIO(capsys.readouterr().out))) == [
        {"x": "1.5", "name": "a"},
        {"x": "", "name": "b"},
    ]
    tell(TABLE, None, "-")
    assert json.loads(capsys.readouterr().out) == [{"x": 1.5, "name": "a"}, {"x": None, "name": "b"}]
    tell(TABLE, str(tmp_path / "a.csv"), None)
    captured = capsys.readouterr()
    assert captured.out == "two lines\nfor people\n"
    assert "table:" in captured.err
    assert (tmp_path / "a.csv").read_text() == "x,name\n1.5,a\n,b\n"


def test_configure__quiet_verbose_and_log(capsys, tmp_path):
    console.configure(True, False, tmp_path / "a.log")
    console.note("a note")
    logging.getLogger("magpend").warning("a warning")
    assert capsys.readouterr().err == "a warning\n"
    assert "INFO a note" in (tmp_path / "a.log").read_text()
    console.configure(False, True, None)
    console.LOG.debug("a detail")
    assert capsys.readouterr().err == "a detail\n"


def test_work__says_how_far_and_how_long():
    work = Work("polishing orbits", started=0.0)
    assert work.line(3.0) == "polishing orbits: 3.0 s so far"
    work.total, work.expected_s = 20.0, 60.0
    assert work.line(10.0) == "polishing orbits: 0 of 20 (0 %), about 50 s left"
    work.done, work.heard = 5.0, 10.0
    assert work.line(10.0) == "polishing orbits: 5 of 20 (25 %), 30 s left"
    assert work.line(25.0) == "polishing orbits: 5 of 20 (25 %), 15 s left"
    assert work.line(50.0) == "polishing orbits: 5 of 20 (25 %), 50 s so far"
    work.done = 20.0
    assert work.line(40.0) == "polishing orbits: 20 of 20 (100 %)"


def test_progress__first_line_within_seconds_and_without_reports(monkeypatch, capsys):
    monkeypatch.setattr(console, "FIRST_LINE_S", 0.05)
    with progress("analyse"):
        said, until = "", time.monotonic() + 60
        while "analyse: " not in said and time.monotonic() < until:
            time.sleep(0.01)
            said += capsys.readouterr().err
    assert "analyse: " in said


@pytest.mark.slow
def test_at_rest__ends_the_lines_of_a_command_that_serves(monkeypatch, capsys):
    monkeypatch.setattr(console, "FIRST_LINE_S", 0.2)
    with progress("explore"):
        console.at_rest()
        time.sleep(0.5)
    assert capsys.readouterr().err == ""
    console.at_rest()  # without a display there is nothing to end


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")
def test_reporting__says_when_it_compiles():
    """The work is named again afterwards, and what is compiled says nothing."""

    def twice(x, out):
        out[0] = 2.0 * x

    compiled, out, heard = jit.entry(twice, "of_a_test", {}, None), np.zeros(1), []
    with reporting(lambda what, *_: heard.append(what)):
        report("work", 0, 1)
        for _ in range(2):
            compiled(1.5, out)
    assert out[0] == 3.0
    assert heard == ["work", "compiling", "work"]


@pytest.mark.slow
def test_head__ends_with_0(made, environment):
    """Whoever reads no further is no error."""
    command = f"{sys.executable} -m pipeline.cli.main status {made.info.directory} | head -c 1"
    command += "; echo rc ${PIPESTATUS[0]}"
    found = subprocess.run(["bash", "-c", command], env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.endswith("rc 0\n")
    assert "Error" not in found.stderr  # on a busy machine progress is shown
    code = "import sys; from pipeline.cli import console\nfor i in range(100000): console.result('line')"
    command = f'{sys.executable} -c "{code}" 2>&1 | head -1'
    found = subprocess.run(["bash", "-c", command], env=environment, capture_output=True, text=True, check=True)
    assert "EnoughError" in found.stdout or found.stdout == "line\n"


def test_help__keeps_square_brackets_units_bounds_and_defaults(main):
    code, out, _ = main("analyse", "chaos", "--help")
    assert code == 0
    text = " ".join(out.split())
    assert "[products] lyapunov" in text
    assert "counts as nonzero [1/s]; 0 or more. Default: 0.005." in text
    for group in ("analyse", "plot"):
        assert main(group, "--help")[0] == 0
    assert "--install-completion" in main("--help")[1]


@pytest.mark.slow
def test_completion__completes_names():
    lines = {
        "magpend analyse hy": "hysteresis",
        "magpend plot ga": "gallery",
        "magpend analyse basins --metric ch": "chessboard",
        "magpend run quick": "quickstart",
        "magpend models doub": "double-pendulum",
    }
    code = f"""
import os, sys
from pipeline.cli.main import main
sys.argv[0] = "magpend"
for line in {list(lines)!r}:
    os.environ |= {{"COMP_WORDS": line, "COMP_CWORD": str(len(line.split()) - 1)}}
    try:
        main()
    except SystemExit:
        print()"""
    assert fresh_python(code, _MAGPEND_COMPLETE="complete_bash").stdout.split() == list(lines.values())


def test_models__lists_states_parameters_and_presets(main):
    assert models.DEFAULT == DEFAULT
    assert "duffing" in main("models")[1]
    _, out, _ = main("models", "duffing")
    assert "damping" in out
    assert "preset hardening" in out
    _, out, _ = main("models", "duffing", "--json")
    assert [s["name"] for s in json.loads(out)[0]["states"]] == ["x", "v"]
    code, _, err = main("models", "dufing")
    assert code == Exit.REFUSED
    assert "duffing" in err
    assert "twin-well" in main("presets", "--model", "duffing")[1]
