"""Bits of runs and numbers of analyses, which stay as they are until a version is raised.

The cells of small runs of every kind of motion have stored hashes: they are the same on every CPU. Sums over cells and
numbers of analyses, which numpy and LAPACK compute, may differ in their last digits; they are stored to ten digits.
After a change on purpose raise the number of its version (`magpend_core.versions`, `pipeline.layout.identity`,
``version`` of a product or an analysis), then store anew: ``python -m tests.pipeline.runs.test_golden_bits``.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from pathlib import Path

import numpy as np
import pytest

from pipeline.layout.identity import numbered
from pipeline.layout.own_words import with_plain_names
from pipeline.runs.derive import derive
from pipeline.runs.run import run
from pipeline.runs.versions import version_of
from pipeline.store.run import RunDirectory
from tests.pipeline.factories import silent

STORED = Path(__file__).with_name("golden_bits.json")

SHORT = "[integration]\nn_transient = 6\nn_keep = 4\nrtol = 1e-7\natol = 1e-7\n"
LISTED = '[initial_conditions]\nkind = "list"\n'
WELL = f"""{LISTED}points = [[0.5, 0.0], [-1.2, 0.4], [0.1, 0.9]]
[axes]
frequency_hz = {{ start = 0.15, stop = 0.25, num = 3 }}
"""
PENDULUM = f"""{LISTED}points_deg = [[10.0, -20.0, 0.0, 0.0], [90.0, 30.0, 200.0, -50.0]]
[axes]
frequency_hz = {{ start = 1.5, stop = 2.5, num = 3 }}
"""
ANGLE_GRID = """[initial_conditions]
kind = "grid"
psi1_deg = { start = -60, stop = 60, num = 9 }
psi2_deg = { start = -60, stop = 60, num = 9 }
"""
CYCLE = """[model]
name = "cycle"
states = { x = {}, y = {} }
parameters = { mu = 0.1 }
define = { s = "x**2 + y**2" }
equations = { x = "mu*x - y - x*s", y = "x + mu*y - y*s" }
[section]
of = "y"
value = 0.05
longest = 20.0
[axes]
mu = { values = [-0.1, 0.1, 0.3] }
"""
DRIVE = "rising_s,falling_s\n" + "".join(f"{k / 2.2 + 0.01 * (k % 3)!r},{(k + 0.5) / 2.2!r}\n" for k in range(12))

DUFFING = f'kind = "sweep"\nmodel = "duffing"\n{WELL}{SHORT}'
SWEEP = f'kind = "sweep"\n{PENDULUM}{SHORT}'
CLOSING = "stop_when_closed = true\n"


def with_model(name):
    return DUFFING.replace("duffing", name)


RUNS = {
    "pendulum": SWEEP,
    "continuation": SWEEP.replace("sweep", "continuation")
    + '[continuation]\npath = "frequency_hz"\ndirection = "both"\n',
    "order 8": f'{DUFFING}method = "dop853"\n',
    "order 5": DUFFING,
    "stiff": with_model("forced-van-der-pol") + 'method = "rodas5p"\n',
    "stopped when closed": DUFFING.replace("= 6", "= 400") + CLOSING,
    "impacts": with_model("impact"),
    "friction": with_model("belt-stick").replace("0.15", "0.4").replace("0.25", "0.5"),
    "torus": with_model("forced-van-der-pol") + "[products]\nrotation = { n_periods = 100 }\n",
    "flow": f'kind = "sweep"\n{CYCLE}{LISTED}points = [[0.3, 0.0], [-0.4, 0.2]]\n{SHORT}',
    "drift": f"{DUFFING}[drift.amplitude]\nto = 0.4\nstart_s = 5.0\nduration_s = 20.0\n",
    "recorded drive": f'kind = "sweep"\n[drive]\nfile = "drive.csv"\n[axes]\nq = {{ values = [0.6, 1.6] }}\n'
    f"{LISTED}points_deg = [[10.0, -20.0, 0.0, 0.0]]\n{SHORT}",
    "noise": DUFFING.split("rtol")[0] + "[noise]\nstrengths = { v = 0.1 }\nseed = 1\n",
    "refined": f'kind = "sweep"\n{ANGLE_GRID}refine = 4\n[parameters]\nfrequency_hz = 2.2\n'
    + SHORT.replace("= 6", "= 60")
    + CLOSING,
    "extremes": f'{SWEEP}[products]\nextremes = {{ quantities = ["energy", "psi1"] }}\n',
    "exponents": f"{DUFFING}[products]\nlyapunov = {{ n_transient = 8, n_periods = 32, n_blocks = 4 }}\n",
}
ROUNDING = ("normal_form_error", "residual")
"""What differs between CPUs: sizes of rounding errors."""

SUMS = ("exponents", "torus")
"""Runs with products that are sums over periods."""

ANALYSES = {
    "order 8": ("attractors", "basins", "branches", "chaos", "settling"),
    "pendulum": ("attractors", "basins"),
    "continuation": ("attractors", "hysteresis"),
    "flow": ("attractors", "branches"),
    "stiff": ("attractors", "branches"),
    "exponents": ("chaos",),
}


def digits(values):
    """What is stored of an array that may differ in its last digits."""
    known = values[np.isfinite(values)]
    return [int(known.size), *(float(f"{x:.10e}") for x in (np.abs(known).sum(), (known**2).sum()))]


def told(ds, exact):
    """Hash of each variable of a dataset, or its digits."""
    found = {}
    for name in sorted(map(str, ds.data_vars)):
        if name in ROUNDING:
            continue
        values = np.ascontiguousarray(ds[name].values)
        is_exact = exact or values.dtype.kind not in "fc"
        found[name] = hashlib.sha256(values.tobytes()).hexdigest()[:16] if is_exact else digits(values)
    return found


def made(name, folder):
    (folder / "drive.csv").write_text(DRIVE, "utf-8")
    (folder / "spec.toml").write_text(RUNS[name], "utf-8")
    run(folder / "spec.toml", folder / "run", workers=0, echo=silent)
    return folder / "run"


def of_run(name, folder):
    directory = made(name, folder)
    opened = RunDirectory.open(directory)
    return {"versions": numbered(opened.info.identity)["versions"], "values": told(opened.cube(), name not in SUMS)}


def of_analysis(name, analysis, directory):
    return {
        "versions": version_of(analysis),
        "values": told(with_plain_names(derive(directory, analysis)), exact=False),
    }


@pytest.fixture(scope="module")
def stored():
    return json.loads(STORED.read_text("utf-8"))


def compare(found, wanted):
    assert found["versions"] == wanted["versions"], "a version was raised: store the new numbers"
    assert found["values"].keys() == wanted["values"].keys()
    for name, value in wanted["values"].items():
        expected = value if isinstance(value, str) else pytest.approx(value, rel=1e-7, abs=1e-12)
        assert found["values"][name] == expected, name


@pytest.mark.parametrize("name", RUNS)
def test_golden_bits__of_cells(name, stored, tmp_path):
    compare(of_run(name, tmp_path), stored[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", ANALYSES)
def test_golden_numbers__of_analyses(name, stored, tmp_path):
    directory = made(name, tmp_path)
    for analysis in ANALYSES[name]:
        compare(of_analysis(name, analysis, directory), stored[f"{name}: {analysis}"])


def main() -> None:
    """Store the bits of today."""
    found = {}
    with tempfile.TemporaryDirectory() as scratch:
        for k, name in enumerate(RUNS):
            folder = Path(scratch) / str(k)
            folder.mkdir()
            found[name] = of_run(name, folder)
            for analysis in ANALYSES.get(name, ()):
                found[f"{name}: {analysis}"] = of_analysis(name, analysis, folder / "run")
    STORED.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", "utf-8")


if __name__ == "__main__":
    main()
