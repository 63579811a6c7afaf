"""Runs as objects: methods for analyses and figures, the accessor of Datasets, trees."""

from __future__ import annotations

import inspect
import pickle
import pydoc
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from matplotlib import pyplot as plt

import magpend
from magpend._names import Analyses, Figures
from magpend._plots import Plots
from pipeline.cli import reference
from pipeline.plots import pixels
from pipeline.plots.style import TARGET, Target
from pipeline.plots.targets import GuestFigure
from pipeline.products.product import Options
from pipeline.products.registry import ANALYSES, FIGURES
from pipeline.runs.arguments import in_python
from pipeline.specification.problems import SpecError
from pipeline.store.errors import RefusedError

RESONANCE = {
    "kind": "continuation",
    "title": "Duffing, its bent resonance",
    "model": "duffing",
    "parameters": {"preset": "hardening"},
    "axes": {"frequency_hz": {"start": 0.18, "stop": 0.26, "num": 5}},
    "continuation": {"direction": "both"},
    "initial_conditions": {"kind": "random", "n": 2, "seed": 1, "x": [-1.0, 1.0], "v": [-1.0, 1.0]},
    "integration": {"rtol": 1e-8, "atol": 1e-8, "n_transient": 60, "n_keep": 12},
    "products": {"lyapunov": {"n_transient": 40, "n_periods": 64, "n_blocks": 4}},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return magpend.run(RESONANCE, tmp_path_factory.mktemp("face") / "resonance", workers=0, echo=lambda _: None)


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


# ---- signatures ---------------------------------------------------------------------------------


def declared(model: type[Options]) -> dict[str, object]:
    """Defaults of an options model; the mark of a required parameter where there is none."""
    return {
        name: inspect.Parameter.empty if info.is_required() else info.get_default(call_default_factory=True)
        for name, info in model.model_fields.items()
    }


def defaults_of(method, aside: set[str]) -> dict[str, object]:
    parameters = list(inspect.signature(method).parameters.values())[1:]
    assert {p.kind for p in parameters} == {inspect.Parameter.KEYWORD_ONLY}
    assert {p.default for p in parameters if p.name in aside} == {None}
    return {p.name: p.default for p in parameters if p.name not in aside}


@pytest.mark.parametrize("name", ANALYSES.listed)
def test_run__has_each_analysis_with_the_defaults_of_its_options(name):
    method, options = getattr(magpend.Run, name), ANALYSES[name].options
    assert vars(Analyses)[name].options is options
    assert defaults_of(method, {"echo", "workers", "scheduler"}) == declared(options)
    headings = re.findall(r"^(\w+)\n    \w", inspect.getdoc(method), re.MULTILINE)
    assert sorted(headings) == sorted([*options.model_fields, "echo", "workers", "scheduler", "Dataset", "SpecError"])
    assert "--" not in re.sub("-{4,}", "", inspect.getdoc(method))
    assert getattr(magpend, name) is method


@pytest.mark.parametrize("name", FIGURES)
def test_plots__have_each_figure_with_the_defaults_of_its_options(name):
    options = FIGURES[name].options
    assert vars(Figures)[name].options is options
    assert defaults_of(getattr(Plots, name), {"ax", "figure", "echo"}) == declared(options)


def test_methods__complete_and_refuse_as_written_ones_do(run):
    assert set(ANALYSES.listed) <= set(dir(run))
    assert set(FIGURES) <= set(dir(run.plot))
    assert next(iter(inspect.signature(run.basins).parameters)) == "interval"
    assert "Measure the basins" in pydoc.render_doc(magpend.Run.basins)
    assert pickle.loads(pickle.dumps(magpend.basins)) is magpend.basins
    for call, nearest in (
        (lambda: run.basins(confidense=0.9), "unknown option 'confidense'; did you mean confidence"),
        (lambda: run.basins(worker=1), "unknown option 'worker'; did you mean workers"),
        (lambda: magpend.basins(run, confidense=0.9), "unknown option 'confidense'; did you mean confidence"),
        (lambda: run.table("basins", confidense=0.9), "unknown option 'confidense'; did you mean confidence"),
        (lambda: run.plot.bifurcation(degres=True), "unknown option 'degres'; did you mean degrees"),
        (lambda: run.plot.bifurcation(out="a.png"), "unknown option 'out'"),
        (lambda: run.curves(), "second: missing"),
    ):
        with pytest.raises(SpecError, match=nearest):
            call()


@pytest.mark.slow
def test_generated__is_up_to_date():
    """Mended by: python -m pipeline.cli.reference."""
    assert list(reference.stale()) == []


def test_reference__check_fails_for_stale_methods(monkeypatch, capsys):
    """A default that has changed in the options makes the page of commands stale."""
    monkeypatch.setattr(sys, "argv", ["reference", "--check"])
    monkeypatch.setattr(reference, "pages", lambda: [reference.ROOT / "docs/reference/commands.md"])
    monkeypatch.setattr(ANALYSES["basins"].options.model_fields["box"], "default", 6)
    with pytest.raises(SystemExit, match="1"):
        reference.main()
    assert capsys.readouterr().out == "out of date: docs/reference/commands.md\n"


@pytest.mark.slow
def test_run__function_returns_the_run_with_methods(run):
    assert type(run) is magpend.Run
    assert magpend.Run.open(run) is run
    assert type(magpend.Run.open(str(run.directory))) is magpend.Run
    assert "smoke" in inspect.signature(magpend.run).parameters
    assert "run.plot.lyapunov(" in repr(run)
    assert run.status().complete
    assert "20 of 20 cells" in str(run.status())
    assert run.verify().sound


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("give another --out.", "give another out=."),
        ("draw a map with --map", "draw a map with as_map=True"),
        ("such as --at q=1.5, or leave out --map", "such as at={'q': 1.5}, or leave out as_map=True"),
        ("--closest 0.1 must be less than --farthest 1e-3: a", "closest=0.1 must be less than farthest=1e-3: a"),
        ("try --between 0 1; or --no-extend", "try between=(0, 1); or extend=False"),
        ("--posterior runs/a.b: has no file", "posterior='runs/a.b': has no file"),
        ("--parameter=q or --axis NAME=LOW:HIGH", "parameter='q' or ranges={'NAME': (LOW, HIGH)}"),
        ("run it again: magpend run SPEC --out runs/a.b --at q=1, or give --out DIR",
         "run it again: magpend run SPEC --out runs/a.b --at q=1, or give out=DIR"),
        ("--unknown 3", "--unknown 3"),
        ("--between Z: is no set", "between=Z: is no set"),
    ],
)  # fmt: skip
def test_errors__name_arguments(text, wanted):
    kinds = dict.fromkeys(("out", "at", "closest", "farthest", "between", "posterior", "parameter", "ranges"), "str")
    assert in_python(text, {**kinds, "as_map": "bool", "extend": "bool"}, {"map": "as_map"}) == wanted


@pytest.mark.slow
def test_errors__name_arguments_at_every_door(run, tmp_path, command):
    figure = run.plot.lyapunov
    for call in (
        lambda: figure(as_map=True),
        lambda: run.cube().magpend.plot.lyapunov(as_map=True),
        lambda: magpend.figure(run, "lyapunov", as_map=True),
    ):
        with pytest.raises(SpecError, match="leave out as_map=True"):
            call()
    two = run.cube().expand_dims(q=[1.0, 2.0])
    for draw, other in (
        (lambda: magpend.plot_lyapunov(two), "plot_lyapunov_map"),
        (lambda: magpend.plot_lyapunov_map(run.cube()), "plot_lyapunov"),
    ):
        with pytest.raises(ValueError, match=rf"draw a \w+ with {other}$"):
            draw()
    with pytest.raises(SpecError, match=r"^dashboard=True: .* or give scheduler= an address"):
        magpend.run(RESONANCE, tmp_path / "none", dashboard=True)
    with pytest.raises(SpecError, match=r"such as at=\{'q': 1\}, or draw a map with as_map=True"):
        two.magpend.plot.lyapunov()
    for call in (run.branches, run.table):
        with pytest.raises(SpecError, match="low= must be less than high="):
            call(*(["branches"] if call == run.table else []), low=0.2, high=0.1)
    (tmp_path / "other").write_text("a file")
    for given in (lambda out: magpend.run(RESONANCE, out), lambda out: magpend.preview(RESONANCE, out)):
        with pytest.raises(RefusedError, match="give another out=") as caught:
            given(tmp_path / "other")
        assert "--" not in str(caught.value)
    with pytest.raises(SpecError, match=r"axes=\{'NAME': \{'start': LOW, 'stop': HIGH, 'num': NUM\}\}"):
        run.extend()
    assert pickle.loads(pickle.dumps(magpend.figure)) is magpend.figure


# ---- analyses and tables ------------------------------------------------------------------------


@pytest.mark.slow
def test_attractors__options_reach_the_command_and_the_method_alike(run, command, tmp_path):
    words = ("--no-connect", "--threshold", "0.01", "--csv", "found.csv")
    command(tmp_path, "analyse", "attractors", str(run.directory), *words)
    from_command = pd.read_csv(tmp_path / "found.csv")
    table = run.table("attractors", connect=False, threshold=0.01)
    pd.testing.assert_frame_equal(table.replace("", np.nan), from_command, check_dtype=False, rtol=0.0, atol=0.0)
    found = run.attractors(connect=False, threshold=0.01)
    assert found.identical(magpend.attractors(run, connect=False, threshold=0.01))
    pd.testing.assert_frame_equal(found.magpend.table(), table)
    # such a threshold tears the branches apart, so that it makes a difference
    assert found.identical(run.attractors())  # they are the run's from now on
    assert found.attrs["n_ids"] > run.attractors(connect=True).attrs["n_ids"]
    with pytest.raises(SpecError, match="threshold = -1"):
        run.attractors(threshold=-1.0)
    with pytest.raises(SpecError, match="unknown analysis 'atractors'"):
        run.table("atractors")


@pytest.mark.slow
def test_extend__opens_the_wider_run(run, tmp_path):
    more = run.extend(out=tmp_path / "more", starts=3, workers=0, echo=lambda _: None)
    assert type(more) is magpend.Run
    assert more.complete
    assert more.directory == tmp_path / "more"
    assert (more.cube().sizes["branch"], run.cube().sizes["branch"]) == (6, 4)
    assert set(run.cube()["section"].values.ravel()) < set(more.cube()["section"].values.ravel())


@pytest.mark.slow
def test_zoom__is_a_specification_that_run_takes(run):
    notes = []
    table = run.zoom({"frequency": (0.2, 0.28)}, num=3, echo=notes.append)
    spec = magpend.Spec.read(table)
    np.testing.assert_allclose(spec.axes["frequency_hz"].array(), [0.2, 0.24, 0.28])
    assert "reaches beyond the old 0.18 to 0.26" in notes[0]


# ---- figures ------------------------------------------------------------------------------------


def points_of(ax):
    """Positions of the markers and of the polygons in axes."""
    lines = [line.get_xydata() for line in ax.get_lines() if len(line.get_xydata())]
    filled = [path.vertices for area in ax.collections for path in area.get_paths()]
    return np.sort(np.concatenate([*lines, *filled]).round(12), axis=0)


AT = {"at": {"frequency_hz": 0.2}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"), [("bifurcation", {"state": "v"}), ("attractors", {}), ("section", AT), ("fractions", {})]
)
def test_plot__draws_into_the_given_axes_alone(run, name, options):
    figure, (left, right) = plt.subplots(1, 2, layout="constrained")
    right.plot([0, 1], [2, 3])
    before, children = plt.get_fignums(), len(right.get_children())
    assert getattr(run.plot, name)(ax=left, **options) is left
    assert plt.get_fignums() == before
    assert figure.axes == [left, right]
    assert len(right.get_children()) == children
    assert len(right.get_lines()) == 1
    assert not figure.legends
    own = magpend.figure(run, name, options)
    np.testing.assert_array_equal(points_of(left), points_of(own.axes[0]))
    assert left.get_xlabel() == own.axes[0].get_xlabel()
    assert left.get_xlim() == own.axes[0].get_xlim()
    assert plt.get_fignums() == before  # `magpend.figure` is its holder's alone
    figure.canvas.draw()


@pytest.mark.slow
def test_plot__makes_a_figure_of_pyplot_that_holds_its_data(run):
    ax = run.plot.bifurcation()
    assert plt.gcf() is ax.figure
    assert ax.figure.data["x"].size == 5 * 4 * 12
    panels = run.plot.lyapunov(spectrum=True)
    assert panels.shape == (2,)
    assert panels[1].get_ylabel().startswith("exponents")
    ax.set_title("mine")
    ax.figure.canvas.draw()
    # several panels go into a subfigure
    figure = plt.figure(figsize=(9, 4), layout="constrained")
    left, right = figure.subfigures(1, 2)
    sides = run.plot.bifurcation(layout="side", figure=left)
    assert [ax.figure for ax in sides] == [left, left]
    assert left.axes == list(sides)
    assert right.axes == []
    gallery = run.plot.gallery(**AT, figure=right)
    assert {ax.figure for ax in gallery} == {right}
    figure.canvas.draw()


def test_plot__refuses_a_place_that_does_not_fit(run):
    figure, ax = plt.subplots()
    children = len(ax.get_children())
    for name, options in (("gallery", AT), ("bifurcation", {"layout": "side"}), ("lyapunov", {}), ("convergence", {})):
        with pytest.raises(SpecError, match=r"several panels, and ax= holds one; give figure= instead"):
            getattr(run.plot, name)(ax=ax, **options)
    assert len(ax.get_children()) == children
    with pytest.raises(SpecError, match="has axes already"):
        run.plot.bifurcation(figure=figure)
    with pytest.raises(SpecError, match="drop one"):
        run.plot.bifurcation(figure=figure, ax=ax)
    with pytest.raises(SpecError, match=r"unknown state 'w'"):
        run.plot.bifurcation(state="w", ax=ax)
    assert not ax.get_lines()
    assert TARGET.get() is None


@pytest.mark.slow
def test_plot__shows_absent_cells_below_the_given_axes(run):
    cube = run.cube().load()
    cube["status"][0] = 0
    _, ax = plt.subplots()
    assert cube.magpend.plot.bifurcation(ax=ax) is ax
    (strip,) = ax.child_axes
    assert strip.get_xlim() == ax.get_xlim()
    assert cube.magpend.counts()["pending"] == 4
    whole = cube.magpend.plot.bifurcation()  # a strip is no panel
    assert len(whole.figure.axes) == 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bifurcation", "lyapunov", "convergence", "gallery", "attractors"])
def test_guest_figure__keeps_nothing_for_itself(run, name, monkeypatch):
    """What is not passed on to the caller's figure would not be seen."""
    made = []
    monkeypatch.setattr(
        Target, "__setattr__", lambda self, key, value: (object.__setattr__(self, key, value), made.append(value))
    )
    figure = plt.figure()
    options = AT if name in ("convergence", "gallery") else {}
    getattr(run.plot, name)(figure=figure, **options)
    (guest,) = [value for value in made if isinstance(value, GuestFigure)]
    assert [type(artist).__name__ for artist in guest.get_children()] == ["Rectangle"]
    assert figure.axes


@pytest.mark.slow
def test_plot__counts_points_on_pixels_as_fine_as_in_files(run, monkeypatch):
    """The image of many points does not depend on the resolution of the screen."""
    monkeypatch.setattr(pixels, "MARKER_LIMIT", 0)
    monkeypatch.setitem(plt.rcParams, "figure.dpi", 72.0)
    (shown,), (kept,) = run.plot.bifurcation().images, magpend.figure(run, "bifurcation").axes[0].images
    np.testing.assert_allclose(shown.get_array().shape, kept.get_array().shape, rtol=0.02)  # texts differ by pixels


# ---- Datasets -----------------------------------------------------------------------------------


def test_accessor__knows_model_run_and_cells(run):
    ds = run.cube()
    assert ds.magpend.model.name == "duffing"
    assert ds.magpend.parameters.as_dict() == run.parameters.as_dict()
    assert ds.sel(frequency=0.2).magpend.run().directory == run.directory
    assert sum(ds.magpend.counts().values()) == 20
    assert ds.magpend.sel_cell(frequency_hz=0.22, branch=1).identical(ds.isel(frequency=2, branch=1))
    assert ds.magpend.sel_cell(frequency=0.225, nearest=True).frequency == pytest.approx(0.22)
    with pytest.raises(ValueError, match=r"nearest values are 0\.22 and 0\.24"):
        ds.magpend.sel_cell(frequency=0.225)
    with pytest.raises(ValueError, match="unknown axis 'q'"):
        ds.magpend.sel_cell(q=1.0)
    for choose in (ds.magpend.sel_cell, lambda **at: magpend.plot_bifurcation(ds, at=at)):
        with pytest.raises(ValueError, match="unknown axis 'freqency'; did you mean frequency"):
            choose(freqency=0.2)


@pytest.mark.slow
def test_accessor__refuses_wrong_datasets_in_a_sentence(run):
    cube = run.cube()
    for wrong, message in (
        (lambda: xr.Dataset().magpend.model, r"no cube of magpend\.open_run and no result"),
        (lambda: cube.magpend.table(), "not the result of an analysis"),
        (lambda: run.attractors().magpend.plot, r"needs a cube of magpend\.open_run, and this is attractors"),
        (lambda: cube.magpend.plot.attractors(), r"needs the analysis attractors.*use run\.plot"),
        (lambda: cube.magpend.plot.branches(), r"branches needs an analysis.*use run\.plot"),
        (lambda: xr.Dataset(attrs=cube.attrs).magpend.run(), r"open the run with magpend\.Run\.open"),
    ):
        with pytest.raises((ValueError, SpecError), match=message):
            wrong()


@pytest.mark.slow
def test_open_run__tree_has_what_is_kept_and_names_what_is_stale(run, tmp_path):
    shutil.copytree(run.directory, tmp_path / "copy", ignore=shutil.ignore_patterns("derived"))
    copy = magpend.Run.open(tmp_path / "copy")
    second, first = copy.attractors(threshold=0.01), copy.attractors(threshold=0.3)
    copy.hysteresis()
    tree = magpend.open_run(copy, tree=True)
    other = Path(second.encoding["source"]).stem
    assert set(tree.children) == {"cube", "attractors", other, "hysteresis"}
    for name, wanted in (("cube", copy.cube()), ("attractors", first), (other, second)):
        node = tree[name].to_dataset()
        assert not any(v._in_memory for k, v in node.variables.items() if k in ("section", "n_cells"))
        assert node.identical(wanted)
    assert '"threshold": 0.3' in tree["attractors"].attrs["derived_options"]
    assert [tree.attrs[key] for key in ("cells", "computed", "pending", "left_out")] == [20, 20, 0, []]
    # results of an earlier cube: one record is withdrawn
    next((tmp_path / "copy" / "commits").iterdir()).unlink()
    late = magpend.open_run(tmp_path / "copy", tree=True)
    assert set(late.children) == {"cube"}
    assert late.attrs["pending"] > 0
    assert f"{other}.zarr" in late.attrs["left_out"]
