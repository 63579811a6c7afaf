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
from matplotlib import pyplot as plt
from matplotlib.colors import to_hex
from matplotlib.text import Text

import magpend
from pipeline.products.registry import ANALYSES as PRODUCTS
from pipeline.products.registry import FIGURES
from pipeline.runs.derive import stored_each
from tests.pipeline.declared import complaints

pytestmark = pytest.mark.usefixtures("long_steps_of_a_file")

SWEEP = """
kind = "sweep"
title = "Duffing, a plane of two parameters"
model = "duffing"
parameters = { preset = "twin-well", overrides.cubic = 1.0 }
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
parameters = { preset = "hardening", overrides.damping = 0.1 }
axes = { frequency_hz = { start = 0.16, stop = 0.30, num = 15 } }
continuation = { direction = "both" }
initial_conditions = { kind = "random", n = 2, seed = 1, x = [-1.0, 1.0], v = [-1.0, 1.0] }
integration = { rtol = 1e-8, atol = 1e-8, n_transient = 60, n_keep = 12 }
"""

RAMP = """
kind = "sweep"
title = "Duffing, its drive grows while it moves"
model = "duffing"
parameters = { preset = "twin-well", frequency_hz = 0.159154943, overrides.cubic = 1.0 }
drift.amplitude = { from = 0.15, to = 0.25, start_periods = 4 }
axes = { amplitude_rate_per_period = { values = [0.005, 0.02] } }
initial_conditions = { kind = "list", points = [[-0.8, 0.0], [1.2, 0.0]] }
integration = { rtol = 1e-7, atol = 1e-7, n_transient = 0, n_keep = 40 }
"""

NOISY = """
kind = "sweep"
title = "Duffing, driven by noise as well"
model = "duffing"
parameters = { preset = "twin-well", frequency_hz = 0.159154943, overrides.cubic = 1.0 }
noise = { strengths = { v = 0.1 }, seed = 1, steps_per_period = 128 }
axes = { noise_v = { values = [0.1, 0.15, 0.2] }, realization = { start = 0, stop = 19, step = 1 } }
initial_conditions = { kind = "list", points = [[-0.8, 0.0]] }
integration = { n_transient = 0, n_keep = 100 }
"""

CYCLE = """
kind = "sweep"
title = "A flow, for what limit cycles alone have"
model.name = "hopf"
model.states = { x = {}, y = {} }
model.parameters = { a = 1.0, shear = 0.5 }
model.equations.x = "a*x - 3*y - (x*x + y*y)*(x - shear*y)"
model.equations.y = "3*x + a*y - (x*x + y*y)*(shear*x + y)"
section = { of = "y", value = 0.0, direction = "up", longest = 20.0 }
axes = { a = { values = [0.5, 1.0] } }
initial_conditions = { kind = "list", points = [[0.3, 0.0], [1.2, 0.0]] }
integration = { n_transient = 10, n_keep = 4 }
"""

SPECS = {"sweep": SWEEP, "walk": WALK, "ramp": RAMP, "noisy": NOISY, "cycle": CYCLE}

POINT = "--at frequency_hz=0.159154943 --at amplitude=0.3"
LINE = "--at amplitude=0.15"
SWEPT = f"sweep {POINT} --starts 100"

ANALYSES = {
    "attractors": "sweep",
    "basins": "sweep --box 2 --resamples 20",
    "hysteresis": "walk",
    "settling": "sweep",
    "chaos": "sweep",
    "dimension": f"sweep {POINT} --n-max 2000",
    "spectrum": f"sweep {POINT} --averages 3",
    "phase": "cycle --kick x=0.2 --grid 8",
    "series": f"sweep {POINT} --attractor E --periods 60 --samples 16",
    "branches": "walk",
    "manifolds": f"{SWEPT} --length 0.5 --chord 0.1",
    "tangency": f"{SWEPT} --parameter amplitude --from 0.3 --to 0.31 --length 0.5",
    "tongues": f"sweep {LINE} --second damping --second-from 0.2 --second-to 0.3 --denominator 1",
    "events": "walk",
    "response": "walk",
    "backbone": "walk --undamped damping=0 --undamped amplitude=0",
    "sensitivities": "walk --deviation damping=0.01",
    "curves": "walk --second amplitude --second-from 0.25 --second-to 0.35",
    "atlas": "sweep",
    "orbits": f"sweep {POINT} --period 1 --starts 40",
    "resilience": f"sweep {LINE} --directions 8 --confirmations 8 --phases 2 --timed 8",
    "tipping": "ramp --settle 60 --interval 0.1",
    "delay": "ramp",
    "overlaps": f"sweep {LINE} --parameter frequency --from 0.155 --to 0.159154943",
    "escapes": "noisy --high x=0.5",
    "density": "noisy --skip 10",
    "transfer": "noisy --bins 8 --resamples 3",
    "edge": f"sweep --at frequency_hz=0.159154943 {LINE} --between A B --pairs 1 --returns 16 --period 0",
}

ELSEWHERE = {"bands"}
"""Commands that need the posterior of an identification: see tests/pipeline/analysis/branches/test_bands.py."""

FIGURES_OF = {
    **{name: words for name, words in ANALYSES.items() if name in FIGURES and name not in ("attractors", "basins")},
    "bifurcation": "walk --state v",
    "attractors": "walk",
    "gallery": f"sweep {POINT}",
    "basins": f"sweep {POINT} --shade",
    "fractions": f"sweep {LINE}",
    "isochrones": "cycle --at a=1 --grid 16",
    "waterfall": f"sweep {LINE} --averages 3 --segment 16",
    "lyapunov": f"sweep {LINE}",
    "convergence": f"sweep {POINT}",
    "multipliers": "walk",
    "genealogy": "walk",
    "transfer": "noisy --at noise_v=0.2 --bins 8 --resamples 3",
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
                if name == "walk":
                    call("analyse", "branches", name, "--period", "1")
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
@pytest.mark.parametrize("name", [name for name in PRODUCTS.listed if name not in ELSEWHERE])
def test_analyse(runs, name):
    """Prints a table for people, and the same for programs."""
    words = ("analyse", name, *ANALYSES[name].split())
    out, _ = runs(*words)
    assert out.strip()
    found = json.loads(runs(*words, "--json")[0])
    text, _ = runs(*words, "--csv", "-")
    rows = list(csv.DictReader(text.splitlines())) if name == "events" else found  # whose JSON is a graph
    assert len(list(csv.DictReader(text.splitlines()))) == len(rows)
    if rows:
        assert not {"side", "rotation_psi1"} & set(rows[0])
        assert not re.search(r"\bpsi[12]|\brad\b", out)
    assert "magpend" not in out


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in PRODUCTS.listed if name not in ELSEWHERE])
def test_result__each_variable_is_declared_and_says_what_it_is_and_in_which_unit(runs, day, name):
    runs("analyse", name, *ANALYSES[name].split())
    run = magpend.Run.open(day / ANALYSES[name].split()[0])
    results = list(stored_each(run, name))
    assert results
    for ds in results:
        assert not list(complaints(ds, name, run.cube()))


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
        figure = magpend.figure(magpend.Run.open(day / directory), name, json.loads(stored.attrs["options"]))
        again = figure.data
        assert set(stored.variables) == {key for key, v in again.variables.items() if v.size}
        for key in stored.variables:
            wanted = again[key].values
            if wanted.dtype.kind in "fiu":
                np.testing.assert_array_equal(stored[key], wanted, err_msg=key)
            else:
                assert stored[key].astype(str).values.tolist() == wanted.astype(str).tolist(), key

        texts = " ".join(" ".join(text.get_text() for text in figure.findobj(Text)).split())
        assert {"walk": "damping = ", "cycle": "section y = 0"}.get(directory, "cubic = 1") in texts
        assert all(f"= {float(value):.6g}" in texts for value in re.findall(r"--at \w+=(\S+)", words))


MINE = {
    "font.size": 17.0,
    "axes.labelsize": 21.0,
    "axes.linewidth": 3.0,
    "axes.edgecolor": "#ff0000",
    "lines.linewidth": 4.0,
    **{f"{axis}tick.{key}": v for axis in "xy" for key, v in (("direction", "inout"), ("labelsize", 19.0))},
}


ONE_PANEL = [
    words
    for words in PICTURES
    if FIGURES[words.split()[0]].panels != "several" and "side" not in words and "density" not in words
]
"""A density over an axis has a second panel."""


@pytest.mark.slow
@pytest.mark.parametrize("words", ONE_PANEL)
def test_plot__leaves_the_rc_params_of_given_axes(drawn, day, words):
    (_, data), (name, directory) = drawn(words), words.split()[:2]
    with xr.open_dataset(day / data, engine="scipy") as stored:
        options = json.loads(stored.attrs["options"])
    options.pop("width", None)
    run = magpend.Run.open(day / directory)
    own = magpend.figure(run, name, options)
    with plt.rc_context(MINE):
        figure, ax = plt.subplots()
        (before,) = ax.plot([], [], "C3")
        assert getattr(run.plot, name)(ax=ax, **options) is ax
    figure.canvas.draw()
    plt.close(figure)
    assert {label.get_size() for label in (ax.xaxis.label, ax.yaxis.label)} == {21.0}
    for tick in (*ax.xaxis.get_major_ticks(), *ax.yaxis.get_major_ticks()):
        assert (tick.get_tickdir(), tick.label1.get_size()) == ("inout", 19.0)
        assert tick.label1.get_fontfamily() == plt.rcParams["font.family"]
    assert {spine.get_linewidth() for spine in ax.spines.values()} == {3.0}
    assert {to_hex(spine.get_edgecolor()) for spine in ax.spines.values()} == {"#ff0000"}
    assert not ax.xaxis.get_minor_ticks()
    assert (before.get_linewidth(), to_hex(before.get_color())) == (4.0, "#d62728")
    mine, drawn = ([line for line in axes.lines if line.get_linestyle() != "None"] for axes in (ax, own.axes[0]))
    assert [line.get_linewidth() for line in mine[1:]] == pytest.approx([4.0 * line.get_linewidth() for line in drawn])
    assert [to_hex(line.get_color()) for line in mine[1:]] == [to_hex(line.get_color()) for line in drawn]


UNFIT = {
    "one parameter point": ("sweep", "walk"),
    "one swept parameter": (f"sweep {POINT}", "sweep"),
    "two swept parameters": ("walk", f"sweep {LINE}"),
    "a sweep": ("walk", "walk --at frequency=0.2"),
    "starts on a grid": ("walk", "walk --at frequency=0.2"),
    "the product rotation": ("walk",),
    "the product lyapunov": ("walk", "walk --at frequency=0.2"),
    "a run with [drift]": ("walk", "sweep", "noisy"),
    "a run with [noise]": ("walk", "sweep", "ramp"),
    "a section": ("walk", "sweep"),
}
"""Runs that lack what a figure needs, by the words of the guide; a figure with no words takes any steady run."""

REQUIRED = {"second": "damping", "second_low": 0.2, "second_high": 0.3, "between": ("A", "B"), "high": {"x": 0.5}}
"""Values of the options that figures require, of those that have them."""

TAKES = {"resilience": {f"sweep {POINT}"}, "rotation": {"sweep", f"sweep {LINE}"}, "tongues": {f"sweep {POINT}"}}
"""Runs that a figure takes by another part of its words: at most one parameter, or two; tongues choose a row."""


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURES)
def test_plot__refuses_runs_that_lack_what_the_guide_says(runs, day, name):
    """What the guide says suffices, too: see the runs of `PICTURES`, and below the plane of two parameters."""
    (needs,) = [group[name] for group in FIGURES.groups.values() if name in group]
    fields = FIGURES[name].options.model_fields
    needed = fields.keys() - ({"second"} if name == "atlas" else set())  # the run's own second axis, if none is given
    required = {key: value for key, value in REQUIRED.items() if key in needed}
    unfit = [run for words, some in UNFIT.items() if words in needs for run in some]
    refused = set(unfit or ["ramp", "noisy"]) - TAKES.get(name, set())
    if needs and "sweep" not in refused:
        runs("status", "sweep")
        magpend.figure(magpend.Run.open(day / "sweep"), name, required)
    for words in refused:
        directory, *at = words.split(" --at ")
        runs("status", directory)
        chosen = {key: float(value) for key, _, value in (one.partition("=") for one in at)}
        with pytest.raises(magpend.SpecError):
            magpend.figure(magpend.Run.open(day / directory), name, {**required, "at": chosen})


@pytest.mark.slow
def test_figures__have_names_of_their_own(drawn):
    """No two commands above write one file, whichever of them have been run before."""
    figures = [drawn(words)[0] for words in PICTURES]
    assert len(set(figures)) >= len(PICTURES) - 1
