"""Make the figures of the article: ``python paper/figures.py``, a minute or two, compilation included."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
FIGURES = {
    "diagram.png": (["run quickstart --plot"], "runs/quickstart/figures/bifurcation_psi1.png"),
    "basins.png": (
        ["run duffing5", "analyse attractors runs/duffing5", "plot basins runs/duffing5"],
        "runs/duffing5/figures/basins.png",
    ),
}
"""For each figure the commands of magpend, and the file that they draw."""


def main() -> None:
    """Call the commands in a folder of their own, and copy what they draw beside the article."""
    around = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), os.environ.get("PYTHONPATH", "")])}
    with tempfile.TemporaryDirectory(prefix="magpend-paper-") as folder:
        for name, (commands, drawn) in FIGURES.items():
            for command in commands:
                print("magpend", command, flush=True)
                subprocess.run(
                    [sys.executable, "-m", "pipeline.cli.main", *command.split()], cwd=folder, env=around, check=True
                )
            (HERE / name).write_bytes((Path(folder) / drawn).read_bytes())


if __name__ == "__main__":
    main()
