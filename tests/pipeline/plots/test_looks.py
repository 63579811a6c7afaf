"""The look of new figures: magpend's, changed by a style of the user, whatever the rcParams are."""

from __future__ import annotations

import io

import matplotlib
import numpy as np
import pytest
from cycler import cycler
from matplotlib import pyplot as plt
from matplotlib.colors import to_hex

from pipeline.analysis.basins.fractions_figure import plot_coexisting, plot_fractions
from pipeline.plots import Frame, palette, plot_bifurcation, save_figure
from pipeline.plots.looks import check_style, given
from pipeline.specification.problems import SpecError
from tests.pipeline.plots.made_up import DUFFING, by_gid, make_attractors
from tests.pipeline.plots.test_door import make_cube

TWO = {"axes.prop_cycle": cycler(color=["#102030", "#a0b0c0"])}


def sweep(ids):
    coords = {"frequency": ("frequency", np.linspace(0.1, 0.2, len(ids)), {"units": "Hz"})}
    return make_attractors(ids, ("frequency", "initial_condition"), coords, attrs=DUFFING)


def pixels_of(figure):
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=50)
    return buffer.getvalue()


@pytest.mark.slow
def test_look__of_a_new_figure_does_not_depend_on_rc_params():
    plain, before = plot_bifurcation(make_cube()), dict(matplotlib.rcParams.copy())
    with plt.style.context(["ggplot", {"font.size": 30.0, "lines.linewidth": 7.0}]):
        other = plot_bifurcation(make_cube())
        assert pixels_of(other) == pixels_of(plain)
    assert dict(matplotlib.rcParams.copy()) == before
    styled = plot_bifurcation(make_cube(), frame=Frame(style="ggplot"))
    assert pixels_of(styled) != pixels_of(plain)
    assert to_hex(styled.axes[0].get_facecolor()) == "#e5e5e5"


@pytest.mark.slow
def test_look__a_style_file_gives_width_fonts_and_resolution(tmp_path):
    path = tmp_path / "paper.mplstyle"
    path.write_text("figure.figsize: 3.4, 2.5\naxes.labelsize: 6.5\nfont.family: DejaVu Sans\nsavefig.dpi: 70\n")
    figure = plot_bifurcation(make_cube(), frame=Frame(style=path))
    assert figure.get_figwidth() == pytest.approx(3.4)
    assert figure.frame.compact
    label = figure.axes[0].xaxis.label
    assert (label.get_size(), label.get_fontname()) == (6.5, "DejaVu Sans")
    width = int.from_bytes(save_figure(figure, tmp_path / "a.png").read_bytes()[16:20], "big")
    assert width == 238  # 3.4 * 70
    with given(path, 140.0):
        figure = plot_bifurcation(make_cube())
    assert int.from_bytes(save_figure(figure, tmp_path / "b.png").read_bytes()[16:20], "big") == 476


@pytest.mark.slow
def test_look__attractors_keep_the_colours_of_a_style_over_figures():
    found = sweep([[0, 0, 0, 1, 1, 2], [0, 0, 0, 1, 1, 2]])
    bands = by_gid(plot_fractions(found, frame=Frame(style=TWO)))
    points = by_gid(plot_coexisting(found, frame=Frame(style=TWO)))
    for name, colour in {"A": "#102030", "B": "#a0b0c0"}.items():
        assert to_hex(bands[f"band:{name}"].get_facecolor()[0]) == colour
        assert to_hex(points[f"points:{name}"].get_facecolor()[0]) == colour
    # no colour of its own, rather than that of another
    assert to_hex(points["points:C"].get_facecolor()[0]) == palette.OTHERS.lower()


@pytest.mark.parametrize(
    ("style", "message"),
    [
        ("gplot", r"style = 'gplot': is neither .*; did you mean 'ggplot'\? Available: .*ggplot"),
        (
            "none/of.mplstyle",
            r"style = 'none/of\.mplstyle': is neither a style of matplotlib nor a readable style file",
        ),
        ({"font.sise": 3.0}, r"'font\.sise' is no rcParam; did you mean 'font\.size'\?"),
        (["ggplot", {"font.size": "vast"}], "style: .*vast"),
    ],
)
def test_check_style__names_what_is_wrong(style, message):
    with pytest.raises(SpecError, match=message):
        check_style(style)
