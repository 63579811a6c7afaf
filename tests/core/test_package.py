"""The package as people import it: names without the compiler; and digests of sources."""

import pytest

import magpend_core
from magpend_core.source_digests import meaning_digest


@pytest.mark.slow
def test_import__leaves_the_compiler_out(run_python):
    script = (
        "import sys, magpend_core\n"
        "from magpend_core import ParameterError, Parameters, Status\n"
        "from magpend_core import load_model, load_preset\n"
        "from magpend_core.status import Status as same\n"
        "assert Status is same and Status.PERIODIC == 1\n"
        "load_preset(q=1.5).pack(), load_model('duffing').digest, dir(magpend_core)\n"
        "print([m for m in ('numba', 'llvmlite', 'scipy') if m in sys.modules])\n"
    )
    assert run_python(script).strip() == "[]"
    script = (
        "import magpend_core.sections, magpend_core.trajectory\n"
        "from magpend_core import sections, trajectory\n"
        "print(*map(callable, (sections, trajectory, magpend_core.sections, magpend_core.trajectory)))"
    )
    assert run_python(script).split() == ["True"] * 4


def test_package__has_all_its_names_and_no_other():
    assert set(magpend_core.__all__) <= set(dir(magpend_core))
    for name in magpend_core.__all__:
        assert getattr(magpend_core, name).__name__ == name
    assert set(magpend_core._HOME_OF) == set(magpend_core.__all__)
    with pytest.raises(AttributeError, match="no attribute 'section'"):
        _ = magpend_core.section


SOURCE = '''"""Module."""

import math  # why

RATE = 0.5
"""Half."""


def grow(x: float) -> float:
    """Grow."""
    if x < 0.0:
        raise ValueError(f"x = {x} is negative")
    return math.exp(RATE * x)
'''


@pytest.fixture
def digest(tmp_path):
    def of(source, name="one.py"):
        (tmp_path / name).write_text(source, "utf-8")
        return meaning_digest([tmp_path / name])

    return of


@pytest.mark.parametrize(
    ("old", "new", "is_same"),
    [
        ('"""Module."""', '"""A module\nof two lines."""', True),
        ('    """Grow."""\n', "", True),
        ('"""Half."""', '"""One half."""', True),
        ("  # why", "", True),
        ("RATE * x", "(RATE\n  * x)", True),
        ("is negative", "is less than 0", True),
        ("= 0.5", "= .50", True),
        ("= 0.5", "= 0.25", False),
        ("x < 0.0", "x <= 0.0", False),
        ("RATE * x", "x * RATE", False),
        ("math.exp", "math.expm1", False),
        ("ValueError", "ArithmeticError", False),
        ("    return", "    if x: return", False),
        ("x: float", "x: float = 1.0", False),
    ],
)
def test_meaning_digest__sees_what_is_done_and_not_what_is_said(digest, old, new, is_same):
    assert SOURCE.count(old) == 1
    assert (digest(SOURCE.replace(old, new)) == digest(SOURCE)) == is_same


def test_meaning_digest__sees_names_and_places_of_files(digest, tmp_path):
    assert digest(SOURCE, "two.py") != digest(SOURCE, "one.py")
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "deep" / "one.py").write_text(SOURCE, "utf-8")
    above = meaning_digest([tmp_path / "deep"])
    (tmp_path / "deep" / "one.py").rename(tmp_path / "deep" / "er" / "one.py")
    assert meaning_digest([tmp_path / "deep"]) != above
