"""Benchmarks are no part of the suite (``python tests/bench`` runs them): one test looks at their parts and options."""

import importlib
import runpy
from inspect import signature
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
PARTS = {"implicit", "racing", "solvers", "stiff"}


def test_benches__can_be_imported_take_options_and_are_listed(monkeypatch, capsys):
    """An edit of the package that takes away what a benchmark imports is seen here."""
    monkeypatch.syspath_prepend(FOLDER)
    tiny = runpy.run_path(str(FOLDER / "__main__.py"), run_name="bench")["TINY"]
    names = {path.stem for path in FOLDER.glob("*.py")} - {"__main__", "test_benches"}
    assert names == set(tiny) | PARTS
    for name in sorted(names):
        module = importlib.import_module(name)
        if hasattr(module, "main") and hasattr(module, "argparse") and signature(module.main).parameters:
            with pytest.raises(SystemExit) as end:
                module.main(["--help"])
            assert end.value.code == 0
            assert "usage:" in capsys.readouterr().out, name
