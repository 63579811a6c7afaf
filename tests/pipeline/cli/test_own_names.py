"""A page or figure has its run's name, and never replaces that of another run."""

from __future__ import annotations

import pytest

from pipeline.cli.exits import Exit

pytestmark = pytest.mark.slow

SPEC = """
kind = "sweep"
title = "{title}"
model = "duffing"
[axes]
frequency_hz = {{ start = {start}, stop = 0.25, num = 3 }}
[initial_conditions]
kind = "list"
points = [[0.5, 0.0]]
[integration]
rtol = 1e-6
atol = 1e-6
n_transient = 2
n_keep = 3
"""


@pytest.fixture
def two(main, write_spec):
    """Two runs of one name in two folders."""
    for folder, start in (("a", 0.15), ("b", 0.16)):
        path = write_spec(SPEC.format(start=start, title="Öl"), f"{folder}.toml")
        code, _, err = main("run", path, "--out", f"{folder}-runs/first", "--workers", "0")
        assert code == 0, err
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
