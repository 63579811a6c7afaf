"""Animations: what they show against an integration of another kind, the files, what is refused."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import xarray as xr
from PIL import Image
from scipy.integrate import solve_ivp

import magpend
from pipeline.cli.console import Exit
from pipeline.layout.vocabulary import TRANSIENT
from pipeline.plots import palette
from pipeline.plots.animation import durations
from pipeline.products.diagrams import AnimationOptions
from pipeline.results.ragged import dense
from pipeline.runs import instants
from pipeline.runs.derive import AnalysedRun
from pipeline.runs.filming import Start, animation, of_attractors
from tests.pipeline.factories import duffing, finished

HZ = 0.11

RUN = duffing(
    "frequency_hz = { values = [0.15915494309189535, 0.16] }",
    'kind = "list"\npoints = [[1.0, 0.0], [-1.0, 0.0], [0.9, 0.1]]',
    n_transient=200,
    n_keep=8,
    tolerance=1e-8,
    more='[parameters]\npreset = "twin-well-periodic"',
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two orbits of period 1, one in each well, found from three starts."""
    return finished(tmp_path_factory.mktemp("animations"), RUN)


@pytest.fixture(scope="module")
def swinging():
    """A start of the driven pendulum, which has a drawing, at 6 frames a second."""
    start = Start({"th": 0.4, "w": -0.2}, model="driven-pendulum", frequency_hz=HZ)
    return animation(start=start, seconds=4, fps=6, size=400)


def pendulum(t, y):
    """The driven pendulum's equations, written out again."""
    return [y[1], 1.66 * np.cos(2 * np.pi * HZ * t) - 0.2 * y[1] - np.sin(y[0])]


@pytest.mark.slow
def test_animation__frames_are_where_another_integration_says(swinging):
    """DOP853 of the equations as they stand here, and the bob at (sin th, -cos th)."""
    data = swinging.figure.data
    at_frames = data.time.values[:: data.attrs["substeps"]]
    assert np.diff(at_frames) == pytest.approx(data.attrs["speed"] / 6.0)
    assert data.attrs["speed"] == 5.0  # a period of 9.1 s takes about two
    there = solve_ivp(pendulum, (0.0, at_frames[-1]), [0.4, -0.2], "DOP853", at_frames, rtol=1e-11, atol=1e-11)
    found = data.orbit.isel(motion=0, sample=slice(None, None, data.attrs["substeps"])).values
    np.testing.assert_allclose(found, there.y.T, atol=1e-6)
    frames = list(swinging.frames())
    assert len(frames) == swinging.n_frames == 24
    assert not np.array_equal(frames[3], frames[20])
    machine = swinging.movers[0]
    for k in (0, 7, swinging.n_frames - 1):
        machine.at(k * data.attrs["substeps"])
        bob = np.array([np.sin(there.y[0, k]), -np.cos(there.y[0, k])])
        np.testing.assert_allclose(np.ravel(machine.traced.dot.get_data()), bob, atol=1e-6)
        np.testing.assert_allclose(np.transpose(machine.lines[0].get_data()), [[0.0, 0.0], bob], atol=1e-6)


@pytest.mark.slow
def test_of_attractors__what_does_not_attract_is_shown_when_asked_for(run, monkeypatch):
    """Else it is said to be there; where nothing attracts, all sets are shown."""
    opened, options = AnalysedRun.of(run), AnimationOptions(at={"frequency": 0.16})
    found = dense(opened.derive("attractors"), points=True).copy(deep=True)
    monkeypatch.setattr(AnalysedRun, "derive", lambda run, name: found)
    found["stability"][:, 1] = TRANSIENT
    found["share"][:, 1] = 0.0
    shown, notes = of_attractors(opened, options)
    assert [one.name for one in shown] == ["A: period 1"]
    assert notes == ["not shown: 1 of the sets that do not attract; choose with --attractor LETTER"]
    (shown,), notes = of_attractors(opened, options, ["B"])
    assert (shown.name, shown.colour) == ("B: period 1, transient", palette.GREY_OF[TRANSIENT])
    assert notes == []
    found["stability"][:, 0] = TRANSIENT
    assert [one.name[0] for one in of_attractors(opened, options)[0]] == ["A", "B"]


@pytest.mark.parametrize(("period", "hz"), [(2.0 / 2.44, 2.44), (6.0, 1.0), (1.0 / 2.6, 2.6), (np.nan, 2.2)])
def test_schedule__lasts_what_was_asked(period, hz):
    """Whole periods are shown by another speed, not by another length."""
    for seconds in (1.0, 3.0, 5.1, 8.0):
        plan = instants.schedule([one_moving(period, hz)], AnimationOptions(seconds=seconds, fps=16))
        assert plan.n_frames / 16 == pytest.approx(seconds, abs=1 / 16)
        assert plan.duration == pytest.approx(plan.speed * plan.n_frames / 16)
        if plan.repeats:
            assert plan.duration / period == pytest.approx(round(plan.duration / period))


def test_animation__cells_pass_through_their_sections(run):
    """Cell 4 is the second start at the second frequency: its film goes through what the cube holds."""
    film = animation(run, cells=[4], seconds=10, fps=5, speed=3.0)
    data = film.figure.data
    cube = magpend.open_run(run).isel(frequency=1, initial_condition=1)
    assert "frequency = 0.16 Hz" in str(data.name.values[0])
    sections = np.arange(4) / 0.16
    assert sections[-1] < data.time.values[-1]
    for i, name in enumerate(("x", "v")):
        values = np.interp(sections, data.time.values, data.orbit.isel(motion=0, state=i).values)
        # linear between samples
        np.testing.assert_allclose(values, cube.section.sel(state=name).values[:4], atol=2e-4)


@pytest.mark.slow
def test_animate__files_open_with_their_frames_and_loop(main, run, tmp_path):
    """GIF and WebP repeat for ever; MP4 where ffmpeg is."""
    words = ["animate", run, "--at", "frequency=0.16", "--attractor", "b", "--seconds", "2", "--fps", "8", "--size"]
    for suffix in ("gif", "webp"):
        code, out, err = main(*words, "300", "--out", f"film.{suffix}")
        assert code == 0, err
        assert out.splitlines() == [f"animation: film.{suffix}", "data: film.nc"]
        with Image.open(tmp_path / f"film.{suffix}") as film:
            said = int(err.split(" frames")[0].split()[-1])
            assert (film.n_frames, film.width, film.info["loop"]) == (said, 300, 0)
            shown = []
            for k in range(film.n_frames):
                film.seek(k)
                film.load()
                shown.append(film.info["duration"])
            assert sum(shown) == pytest.approx(1000 * said / 8.0, abs=10)
    with xr.open_dataset(tmp_path / "film.nc", engine="scipy") as stored:
        assert stored.orbit.dims == ("motion", "sample", "state")
        assert stored.attrs["n_frames"] == said
    out = main(*words, "300")[1]
    assert out.splitlines()[0] == f"animation: {run}/figures/animation_frequency_0.16_attractor_b.gif"
    code, _, err = main(*words, "301", "--out", "film.mp4")
    assert code == (0 if shutil.which("ffmpeg") else Exit.REFUSED), err
    assert not shutil.which("ffmpeg") or (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"


@pytest.mark.slow
def test_animate__a_start_with_and_without_a_run(main, run, tmp_path):
    """States come first, or after the directory: neither is taken for the other."""
    small = ["--seconds", "1", "--fps", "4", "--size", "200", "--force", "--out", "film.gif"]
    alone = ["--th", "0.4", "--w", "-0.2", "--model", "driven-pendulum", "--frequency", str(HZ)]
    for words, start in ((alone, [0.4, -0.2]), ([str(run), "--at", "frequency=0.16", "--x", "0.3"], [0.3, 0.0])):
        code, _, err = main("animate", *words, *small)
        assert code == 0, err
        with xr.open_dataset(tmp_path / "film.nc", engine="scipy") as stored:
            assert stored.orbit.values[0, 0].tolist() == start


POINT = ["RUN", "--at", "frequency=0.16"]
REFUSED = [
    (["RUN", "--at", "frequency=0.1595"], "frequency_hz = 0.1595 is not on its axis"),
    (["RUN"], "frequency_hz (2 values): choose a value of each"),
    ([*POINT, "--attractor", "Z"], "--attractor Z: does not exist at this point; there"),
    (["RUN", "--cell", "6"], "--cell 6: the run has the cells 0 to 5, counted through frequency, i"),
    (["RUN", "--cell", "1", "--attractor", "A"], "--attractor and --cell: a film shows one of these"),
    ([*POINT, "--cell", "1"], "--at: a cell already has a parameter point"),
    ([*POINT, "--degrees"], "have no angle"),
    (["--at", "q=1"], "--at: needs a run; give its directory."),
    (["--seconds", "500", "--fps", "50"], "25000 frames; at most 5000. Lower one of the two."),
    (["--speed", "1e6", "--model", "duffing"], "periods are too many for a film"),
]


@pytest.mark.slow
def test_animate__refuses_in_one_sentence(main, run, tmp_path):
    before = sorted(run.rglob("*"))
    for words, said in REFUSED:
        code, _, err = main("animate", *[str(run) if word == "RUN" else word for word in words])
        assert code == Exit.REFUSED, words
        assert said in err
        assert "Traceback" not in err
    assert not list(tmp_path.iterdir())
    assert {p for p in sorted(run.rglob("*")) if p not in before} <= set((run / "derived").rglob("*"))


def one_moving(period, hz=0.5):
    parameters = magpend.load_model("duffing").load()
    return instants.Moving("", "0", parameters, hz, np.zeros(2), np.empty((0, 2)), period)


def test_schedule__whole_periods_where_they_fit():
    """Orbits of 2 and 3 drive periods of 2 s repeat together after 12 s, which fill the 13 s asked for."""
    both = [one_moving(4.0), one_moving(6.0)]
    plan = instants.schedule(both, AnimationOptions(seconds=13.0, fps=10.0, speed=1.0))
    assert (plan.duration, plan.n_frames, plan.repeats) == (12.0, 130, True)
    assert plan.times.size == plan.n_frames * plan.substeps + 1
    short = instants.schedule(both, AnimationOptions(seconds=5.0, fps=10.0, speed=1.0))
    assert (short.duration, short.repeats) == (5.0, False)
    chaos = instants.schedule([*both, one_moving(np.nan)], AnimationOptions(seconds=13.0, speed=1.0))
    assert (chaos.duration, chaos.repeats) == (13.0, False)
    rest = instants.schedule([one_moving(0.0)], AnimationOptions(seconds=3.0, speed=1.0))
    assert (rest.duration, rest.repeats) == (3.0, True)
    chosen = instants.schedule(both, AnimationOptions())
    assert (chosen.duration, chosen.speed, chosen.n_frames) == (12.0, 1.5, 200)


def test_durations__add_up():
    assert durations(3, 30.0, 10) == [30, 40, 30]
    assert sum(durations(300, 24.0, 10)) == 12_500
