"""A page or figure has its run's name, and never replaces that of another run."""

from __future__ import annotations

import pytest

from pipeline.cli.exits import Exit
from tests.pipeline.factories import duffing, quietly

pytestmark = pytest.mark.slow


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
        if name != "first.html":  # an export never replaces a file without --force
            assert main(*command(one))[0] == 0
        code, _, err = main(*command(other))
        assert code == Exit.REFUSED
        assert "--force" in err
        assert (tmp_path / name).read_bytes() == before
        assert main(*command(other), "--force")[0] == 0
        assert (tmp_path / name).read_bytes() != before
        for file in tmp_path.glob("own.*"):
            file.unlink()
