"""Programs of the repository that are in no package, as modules; and Python in a process of its own."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]


def program(path: str) -> ModuleType:
    """Return a file of the repository as a module."""
    spec = importlib.util.spec_from_file_location(f"{Path(path).stem}_of_tests", ROOT / path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def fresh_python(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run code in a new Python that finds magpend in this checkout."""
    paths = [str(ROOT), str(ROOT / "pipeline" / "face"), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths).rstrip(os.pathsep), **variables}
    return subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
