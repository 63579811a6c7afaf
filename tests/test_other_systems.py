"""The main job on Windows and macOS, as far as Linux can show it; no test of theirs runs here."""

import ast
import json
import os
import re
import subprocess
import sys

import pytest

from pipeline.store import local
from tests.programs import ROOT

PRODUCT = ("pipeline", "magpend_core", "workflows", "setup.py")


@pytest.mark.slow
def test_main_job__runs_without_what_only_posix_has(tmp_path):
    """It computes, draws, continues and verifies; its output goes to a file in the encoding of a Windows console."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "pipeline" / "face")])
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONIOENCODING": "cp1252"}

    def magpend(*words):
        words = [sys.executable, str(ROOT / "tests" / "windows.py"), *words]
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, check=False, timeout=300)
        said = (done.stdout + done.stderr).decode("cp1252")
        assert done.returncode == 0, said
        return said

    assert "44 cells by status" in magpend("run", "quickstart", "--smoke", "--plot")
    assert (tmp_path / "runs" / "quickstart-smoke" / "figures" / "bifurcation_psi1.png").is_file()
    assert "nothing to do" in magpend("run", "quickstart", "--smoke")
    magpend("verify", "runs/quickstart-smoke")


def _opens_text_without_encoding(call):
    """Whether a call reads or writes text in the encoding of the system: cp1252 on Windows."""
    names = {keyword.arg: keyword.value for keyword in call.keywords}
    if "encoding" in names:
        return False
    name, is_method = (
        (call.func.attr, True) if isinstance(call.func, ast.Attribute) else (getattr(call.func, "id", ""), False)
    )
    if name in ("read_text", "write_text"):
        return is_method and len(call.args) < (1 if name == "read_text" else 2)
    if name in ("run", "Popen", "check_output"):
        return any(isinstance(names.get(n), ast.Constant) and names[n].value for n in ("text", "universal_newlines"))
    if name not in ("open", "fdopen") or ast.unparse(call.func) == "os.open":
        return False
    place = 0 if is_method and name == "open" else 1
    mode = names.get("mode") or (call.args[place] if len(call.args) > place else None)
    if mode is None:
        return not (is_method and call.args)  # `Thing.open(path)` of our own
    told = mode.value if isinstance(mode, ast.Constant) else ""
    return bool(re.fullmatch("[rwaxt+]+", str(told)))


def _found_in(text):
    calls = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call))
    return [call.lineno for call in calls if _opens_text_without_encoding(call)]


def test_texts__are_opened_with_an_encoding():
    files = [path for name in PRODUCT for path in ([ROOT / name] if "." in name else (ROOT / name).rglob("*.py"))]
    assert len(files) > 300
    assert {str(path): lines for path in files if (lines := _found_in(path.read_text("utf-8")))} == {}


@pytest.mark.parametrize(
    "line",
    [
        "open(path)",
        "open(path, 'w')",
        "path.open()",
        "path.open('a')",
        "path.read_text()",
        "path.write_text(text)",
        "subprocess.run(words, text=True)",
        "os.fdopen(number, 'w')",
    ],
)
def test_texts__without_an_encoding_are_found(line):
    assert _found_in(line) == [1]


def test_holder__is_never_asked_by_a_signal_where_that_ends_a_console(monkeypatch):
    """On Windows the signal 0 of `os.kill` is Ctrl-C."""
    gone = json.dumps({**local.holder(), "pid": 2**22 + 1}).encode()
    assert local.has_ended(gone)
    monkeypatch.delattr(os, "killpg")
    monkeypatch.setattr(os, "kill", None)
    assert not local.has_ended(gone)
