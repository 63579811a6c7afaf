"""Damaged files are refused in words, in a bounded time."""

from __future__ import annotations

import random
import time

import pytest

from pipeline.importing import auto, matlab, xpp
from pipeline.importing.assembly import assembled
from pipeline.specification.problems import SpecError
from tests.pipeline.importing.published import PUBLISHED
from tests.pipeline.importing.test_procedural import AB_C, AB_F, AB_F90, AB_M

TEXTS = [*(one.text for one in PUBLISHED.values()), *[AB_F90, AB_F, AB_C, AB_M] * 2]
READERS = {AB_F90: auto.read_fortran, AB_F: auto.read_fortran, AB_C: auto.read_c, AB_M: matlab.read}
BITS = (
    *"()[]{}'=^-!%\",;&|#\n\x00é_",
    *("[1..9]", "[1..99999]", "[j]", "**", "1e400", "9" * 50, "sum(0,9)of(", "shift(", "if(", "then(", "else("),
    *("par ", "init ", "global 1 ", "table f % 9 0 1 ", "aux ", "wiener ", "@ ", "\\\n", "t", "pi", "i'", "x'="),
    *("(t+1)=", "0=", "set a {", "lambda", "mod(t,", "sin(t*", "done\n", "nan", "inf", "__import__('os')", "f(x)="),
)
LONGEST = 30.0
"""Seconds that one file may take on a busy machine."""


def damaged(rng: random.Random, text: str) -> str:
    """Damage a text at a few places."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 5))):
        at = rng.randrange(len(text) + 1)
        end = min(len(text), at + rng.randint(1, 20))
        other = rng.choice(TEXTS)
        begin = rng.randrange(len(other))
        bits = (
            "",
            rng.choice(BITS) + text[at:end],
            text[at:end] * rng.randint(2, 50),
            other[begin : begin + rng.randint(1, 200)] + text[at:end],
            chr(rng.randrange(256)),
        )
        text = text[:at] + rng.choice(bits) + text[end:]
    return text


def judge(path, seed: int, count: int) -> tuple[int, int]:
    """Read damaged texts; return how many become models, and how many are refused."""
    rng = random.Random(seed)
    good = bad = 0
    for _ in range(count):
        whole = rng.choice(TEXTS)
        text = damaged(rng, whole)
        path.write_bytes(text.encode("latin-1", "replace"))
        begun = time.monotonic()
        try:
            source = READERS.get(whole, xpp.read)(path)
            assembled(source)
            good += 1
        except SpecError as error:
            bad += all(error.problems)
        assert time.monotonic() - begun < LONGEST, text
    return good, bad


def test_read__damaged_files(tmp_path):
    good, bad = judge(tmp_path / "damaged.ode", 1, 250)
    assert good > 8
    assert bad > 100


@pytest.mark.slow
def test_read__ten_thousand_damaged_files(tmp_path):
    good, bad = judge(tmp_path / "damaged.ode", 2, 10_000)
    assert good + bad == 10_000
