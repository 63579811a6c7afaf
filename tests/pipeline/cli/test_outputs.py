"""Where commands write: not into run directories, and not over what somebody else has written."""

from __future__ import annotations

import pytest

from pipeline.cli.console import Exit
from tests.pipeline.factories import contents, duffing, quietly

pytestmark = pytest.mark.slow

SPEC = duffing(
    "amplitude = { start = 0.2, stop = 0.3, num = 3 }",
    n_transient=30,
    n_keep=8,
    more="[parameters]\nfrequency_hz = 0.2",
)

ANALYSE = ("analyse", "attractors", "run", "--no-polish", "--no-extend", "--csv")
PLOT = ("plot", "bifurcation", "run", "--out")
REPORT = ("report", "run", "--only-stored", "--out")
SIMULATE = ("simulate", "--model", "duffing", "--frequency", 0.2, "--periods", 2, "--no-figure", "--out")
STATUS = ("status", "run", "--log")
ANIMATE = ("animate", "--model", "duffing", "--frequency", 0.2, "--x", 0.1, "--seconds", 0.2, "--out")
ZOOM = ("zoom", "run", "--amplitude", 0.2, 0.25, "--out")
EXPORT = ("export", "run", "--orbits", 0, "--out")

COMMANDS = {
    "table.csv": ANALYSE,
    "figure.png": PLOT,
    "page.html": REPORT,
    "series.csv": SIMULATE,
    "series.nc": SIMULATE,
    "said.log": STATUS,
    "film.gif": ANIMATE,
    "copy.html": EXPORT,
    "new.toml": ZOOM,
}


@pytest.fixture
def whole(copied):
    return copied(SPEC)


@pytest.mark.parametrize("name", COMMANDS)
def test_commands__write_into_no_run_directory_and_follow_no_link(whole, main, tmp_path, name):
    before = contents(whole)
    for below in (".", "cube.zarr", "commits"):
        code, _, said = main(*COMMANDS[name], whole / below / name)
        assert code == 2, said
        assert f"lies inside of the run directory {whole}; give a place outside of it" in said
    for file in ("run.json", "cube.zarr/zarr.json", "timings.jsonl") if name == "said.log" else ():
        assert main(*STATUS, whole / file)[0] == 2
    (tmp_path / name).symlink_to(tmp_path / "nowhere")
    code, _, said = main(*COMMANDS[name], tmp_path / name)
    assert code == 2, said
    assert "link that leads nowhere" in said
    assert not (tmp_path / "nowhere").exists()
    assert contents(whole) == before


@pytest.mark.parametrize("name", [n for n in COMMANDS if n not in ("film.gif", "new.toml")])
def test_commands__replace_what_is_their_own_alone(whole, main, tmp_path, name):
    path = tmp_path / name
    # a table of other columns is a stranger's, too; a series may have any
    others = {"table.csv": (b"time,x\n0,1\n", b"a;b\n1;2\n"), "series.csv": (b"a;b\n1;2\n",)}
    for theirs in others.get(name, (b"somebody's data\n",)):
        path.write_bytes(theirs)
        code, _, said = main(*COMMANDS[name], path)
        assert code == 2, said
        assert f"{path}: exists, and magpend did not write it" in said
        assert path.read_bytes() == theirs
    code, _, said = main(*COMMANDS[name], path, "--force")
    assert code == 0, said
    if name != "said.log":  # a log is added to
        assert not path.read_bytes().startswith(theirs)
        code, _, said = main(*COMMANDS[name], path)
        assert code == 0, said


def test_plot__figures_of_the_run_may_be_named(whole, main):
    assert main(*PLOT, whole / "figures" / "mine.png")[0] == 2  # no such folder yet
    assert main(*PLOT[:-1])[0] == 0
    assert main(*PLOT, whole / "figures" / "mine.png")[0] == 0


# ---- a page or figure never replaces that of another run -------------------------------------------------


@pytest.fixture
def two(tmp_path):
    """Two runs of one name in two folders."""
    for folder, start in (("a-runs", 0.15), ("b-runs", 0.16)):
        text = duffing(f"frequency_hz = {{ start = {start}, stop = 0.25, num = 3 }}").replace('"small"', '"Öl"')
        (tmp_path / folder).mkdir()
        (tmp_path / f"{folder}/spec.toml").write_text(text, "utf-8")
        quietly(tmp_path / f"{folder}/spec.toml", tmp_path / f"{folder}/first")
    return "a-runs/first", "b-runs/first"


def test_commands__never_replace_the_file_of_another_run(main, two, tmp_path):
    one, other = two
    commands = {
        "first-report.html": lambda run: ("report", run, "--only-stored"),
        "first.html": lambda run: ("export", run),
        "own.html": lambda run: ("report", run, "--only-stored", "--out", "own.html"),
        **{
            f"own.{kind}": lambda run, kind=kind: ("plot", "bifurcation", run, "--out", f"own.{kind}")
            for kind in ("png", "pdf", "svg")
        },
    }
    for name, command in commands.items():
        code, _, err = main(*command(one))
        assert code == 0, err
        before = (tmp_path / name).read_bytes()
        assert main(*command(one))[0] == 0
        code, _, err = main(*command(other))
        assert code == Exit.REFUSED
        assert "--force" in err
        assert (tmp_path / name).read_bytes() == before
        assert main(*command(other), "--force")[0] == 0
        assert (tmp_path / name).read_bytes() != before
        for file in tmp_path.glob("own.*"):
            file.unlink()
