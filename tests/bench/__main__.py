"""Run benchmarks one after the other: ``python tests/bench [NAME ...] [--tiny]``; all by default.

Each also runs alone, ``python tests/bench/NAME.py``, with options of its own (``--help``). ``--tiny`` runs them in
their smallest sizes, which measures nothing and shows that they work.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
SMALL = ["--trajectories", "16", "--periods", "2", "--rounds", "1"]
SCIPY = ["--scipy-trajectories", "1", "--scipy-periods", "1"]
TINY = {
    "analysis_scaling": ["--cells", "200"],
    "basins": ["--size", "4", "--bands", "2", "--transient", "300", *SCIPY],
    "conclusions": ["map", "--tiny"],
    "costs": SMALL,
    "coverage": ["--rigs", "1", "--draws", "10"],
    "kernel": [*SMALL, "--tolerances", "1e-4", "--part", "here"],
    "peers": [*SMALL, "--models", "lorenz", "pendulum", "--points"],
    "same_set": ["--cells", "6", "--cases", "Ueda"],
    "scaling": ["--seconds", "0", "--workers", "4", "--task-seconds", "0.05", "--rounds", "3"],
    "series": ["--seeds", "1", "--cases", "ar1"],
    "virtual_rig": ["--seeds", "0"],
}
"""Options of the smallest size of each benchmark."""


def main() -> int:
    """Run the benchmarks in processes of their own; the exit status is the number of those that failed."""
    parser = argparse.ArgumentParser(prog="python tests/bench", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(TINY))
    parser.add_argument("--tiny", action="store_true", help="in the smallest size")
    options = parser.parse_args()
    failed = []
    for name in options.names or TINY:
        print(f"== {name}", flush=True)
        words = TINY[name] if options.tiny else []
        if subprocess.run([sys.executable, FOLDER / f"{name}.py", *words], check=False).returncode:
            failed.append(name)
    print("failed: " + ", ".join(failed) if failed else "all ran")
    return len(failed)


if __name__ == "__main__":
    sys.exit(main())
