"""A day with another system: every command of README and docs on runs of the Duffing oscillator.

It has two states, no angles, no words for its motions and other units than the pendulum; whatever knew the
pendulum would fail here.
"""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest
import xarray as xr

import magpend
from pipeline.products.registry import COMMANDS, FIGURES

SWEEP = """
kind = "sweep"
title = "Duffing, a plane of two parameters"
model = "duffing"
parameters = { preset = "twin-well" }
axes = { frequency_hz = { values = [0.155, 0.159154943] }, amplitude = { values = [0.15, 0.3] } }
initial_conditions.kind = "grid"
initial_conditions.x = { start = -1.5, stop = 1.5, num = 5 }
initial_conditions.v = { start = -1.0, stop = 1.0, num = 5 }
integration = { rtol = 1e-7, atol = 1e-7, n_transient = 60, n_keep = 220 }
products.lyapunov = { n_transient = 40, n_periods = 64, n_blocks = 4 }
products.extremes = { quantities = ["energy", "v"] }
products.rotation = { n_periods = 40 }
smoke = { axes.frequency_hz.values = [0.155] }
"""

WALK = """
kind = "continuation"
title = "Duffing, its bent resonance"
model = "duffing"
parameters = { preset = "hardening" }
axes = { frequency_hz = { start = 0.16, stop = 0.30, num = 15 } }
continuation = { direction = "both" }
initial_conditions = { kind = "random", n = 2, seed = 1, x = [-1.0, 1.0], v = [-1.0, 1.0] }
integration = { rtol = 1e-8, atol = 1e-8, n_transient = 60, n_keep = 12 }
"""

RAMP = """
kind = "sweep"
title = "Duffing, its drive grows while it moves"
model = "duffing"
parameters = { preset = "twin-well", frequency_hz = 0.159154943 }
drift.amplitude = { from = 0.15, to = 0.25, start_periods = 4 }
axes = { amplitude_rate_per_period = { values = [0.005, 0.02] } }
initial_conditions = { kind = "list", points = [[-0.8, 0.0], [1.2, 0.0]] }
integration = { rtol = 1e-7, atol = 1e-7, n_transient = 0, n_keep = 40 }
"""

NOISY = """
kind = "sweep"
title = "Duffing, driven by noise as well"
model = "duffing"
parameters = { preset = "twin-well", frequency_hz = 0.159154943 }
noise = { strengths = { v = 0.1 }, seed = 1, steps_per_period = 128 }
axes = { noise_v = { values = [0.1, 0.15, 0.2] }, realization = { start = 0, stop = 19, step = 1 } }
initial_conditions = { kind = "list", points = [[-0.8, 0.0]] }
integration = { n_transient = 0, n_keep = 100 }
"""

SPECS = {"sweep": SWEEP, "walk": WALK, "ramp": RAMP, "noisy": NOISY}

POINT = "--at frequency_hz=0.159154943 --at amplitude=0.3"
LINE = "--at amplitude=0.15"
SWEPT = f"sweep {POINT} --starts 100"

ANALYSES = {
    "attractors": "sweep",
    "basins": "sweep --box 2 --resamples 20",
    "hysteresis": "walk",
    "settling": "sweep --n-sample 4",
    "chaos": "sweep",
    "dimension": f"sweep {POINT} --n-max 2000",
    "branches": "walk --period 1",
    "manifolds": f"{SWEPT} --length 0.5 --chord 0.1",
    "tangency": f"{SWEPT} --parameter amplitude --from 0.3 --to 0.31 --length 0.5",
    "tongues": f"sweep {LINE} --second damping --second-from 0.2 --second-to 0.3 --denominator 1",
    "curves": "walk --period 1 --second amplitude --second-from 0.25 --second-to 0.35",
    "orbits": f"sweep {POINT} --period 1 --starts 40",
    "resilience": f"sweep {LINE} --directions 8 --confirmations 8 --phases 2 --timed 8",
    "tipping": "ramp --settle 60 --width 0.1",
    "delay": "ramp",
    "overlaps": f"sweep {LINE} --parameter frequency --from 0.155 --to 0.159154943",
    "escapes": "noisy --high x=0.5",
    "density": "noisy --skip 10",
    "edge": f"sweep --at frequency_hz=0.159154943 {LINE} --between A B --pairs 1 --returns 16 --period 0",
}

ELSEWHERE = {"bands"}
"""Commands that need the posterior of an identification: see tests/pipeline/analysis/test_bands.py."""

FIGURES_OF = {
    **{name: words for name, words in ANALYSES.items() if name in FIGURES and name not in ("attractors", "basins")},
    "bifurcation": "walk --state v",
    "attractors": "walk",
    "gallery": f"sweep {POINT}",
    "basins": f"sweep {POINT} --shade",
    "fractions": f"sweep {LINE}",
    "lyapunov": f"sweep {LINE}",
    "convergence": f"sweep {POINT}",
    "multipliers": "walk --period 1",
    "drift": "ramp",
    "section": f"sweep {POINT}",
}

PICTURES = [
    *(f"{name} {FIGURES_OF.get(name, 'sweep')}" for name in FIGURES),
    "lyapunov sweep --map",
    f"lyapunov sweep --spectrum --per period {LINE}",
    f"bifurcation sweep --quantity energy.max {LINE}",
    "regimes sweep --show number",
    "bifurcation walk --layout side --width 85 --format pdf",
]


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """A folder with the specifications of all runs."""
    folder = tmp_path_factory.mktemp("duffing")
    for name, text in SPECS.items():
        (folder / f"{name}.toml").write_text(text)
    return folder


@pytest.fixture
def call(command, day):
    return lambda *words: command(day, *words)


@pytest.fixture
def runs(call, day):
    """Call a command, after the runs that it names have been made."""

    def after(*words):
        for name in SPECS:
            if name in words and not (day / name).exists():
                out, _ = call("run", f"{name}.toml", "--out", name, "--workers", "0")
                assert f"cube: {name}/cube.zarr" in out
        return call(*words)

    return after


@pytest.mark.slow
def test_cube__has_the_models_own_names(runs, day):
    assert "complete" in runs("status", "sweep")[0]
    ds = magpend.open_run(day / "sweep")
    assert ds.state.values.tolist() == ["x", "v"]
    assert ds.attrs["model"] == "duffing"
    assert {"x_0", "v_0", "frequency", "amplitude"} <= set(ds.dims)
    assert not {"turns", "side", "link"} & {*ds.variables, *ds.dims}
    ds.to_netcdf(day / "cube.nc", engine="scipy")
    assert magpend.Run.open(day / "sweep").model.name == "duffing"


def test_simulate(call, day):
    words = "--x 0.5 --v 0.1 --frequency 0.16 --set amplitude=0.25 --periods 3 --samples 20 --out one.csv --no-figure"
    call("simulate", "--model", "duffing", *words.split())
    with (day / "one.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["x_m"]) == 0.5
    assert "energy_J_per_kg" in rows[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ELSEWHERE])
def test_analyse(runs, name):
    """Prints a table for people, and the same for programs."""
    words = ("analyse", name, *ANALYSES[name].split())
    out, _ = runs(*words)
    assert out.strip()
    rows = json.loads(runs(*words, "--json")[0])
    text, _ = runs(*words, "--csv", "-")
    assert len(list(csv.DictReader(text.splitlines()))) == len(rows)
    if rows:
        assert not {"side", "rotation_psi1"} & set(rows[0])
        assert not re.search(r"\bpsi[12]|\brad\b", out)
    assert "magpend" not in out


@pytest.fixture(scope="module")
def outputs():
    """What each command of a figure has printed, by its words."""
    return {}


@pytest.fixture
def drawn(runs, outputs):
    """Draw a figure, once; returns the paths of the figure and of its data."""

    def draw(words):
        if words not in outputs:
            outputs[words] = runs("plot", *words.split())[0]
        return [line.partition(": ")[2] for line in outputs[words].splitlines()[-2:]]

    return draw


@pytest.mark.slow
@pytest.mark.parametrize("words", PICTURES)
def test_plot(drawn, day, words):
    """Draws a figure; the data beside it say what it shows and how it is drawn, which gives the same again."""
    figure, data = drawn(words)
    assert (day / figure).stat().st_size > 2000
    name, directory = words.split()[:2]
    with xr.open_dataset(day / data, engine="scipy") as stored:
        assert stored.attrs["figure"] == name
        again = magpend.figure(magpend.Run.open(day / directory), name, json.loads(stored.attrs["options"])).data
        assert set(stored.variables) == {key for key, v in again.variables.items() if v.size}
        for key in stored.variables:
            wanted = again[key].values
            if wanted.dtype.kind in "fiu":
                np.testing.assert_array_equal(stored[key], wanted, err_msg=key)
            else:
                assert stored[key].astype(str).values.tolist() == wanted.astype(str).tolist(), key


def test_figures__have_names_of_their_own(drawn):
    """No two commands above write one file, whichever of them have been run before."""
    figures = [drawn(words)[0] for words in PICTURES]
    assert len(set(figures)) >= len(PICTURES) - 1
