"""Counter-based random numbers: known answers, distributions, independence of neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from magpend_core.engine.plain_python import plain
from magpend_core.engine.random_numbers import COUNT_OFFSET, key_words, normal_pair, philox, tag_word, uniform
from magpend_core.engine.words import word

WORDS = 0xFFFFFFFF

# the file kat_vectors of Random123 1.14 (Salmon et al. 2011): counter, key, answer of philox4x32 with 10 rounds
KNOWN = [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((WORDS,) * 4, (WORDS,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


def numbers(x: object) -> list[int]:
    return np.atleast_1d(np.asarray(x, np.float64)).view(np.int64).tolist()


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN)
def test_philox__known_answers(counter: tuple[int, ...], key: tuple[int, int], answer: tuple[int, ...]) -> None:
    keys = key_words(key[0] | key[1] << 32)
    found = plain(philox)(*(word(x) for x in counter), keys)
    assert [numbers(x)[0] for x in found] == list(answer)


@pytest.fixture(scope="module")
def drawn() -> tuple[np.ndarray, np.ndarray]:
    """A million pairs of normal numbers: 1000 steps of 1000 cells."""
    count, cell = np.meshgrid(np.arange(1000.0), np.arange(1000), indexing="ij")
    low = cell.astype(np.int64).view(np.float64)
    return plain(normal_pair)(count, low, word(7), tag_word(0, 0), key_words(42))


@pytest.mark.slow
def test_normal_pair__is_normal_and_neighbours_are_independent(drawn) -> None:
    for sample in drawn:
        x = sample.ravel()
        n = len(x)
        # four standard errors of each moment of the normal law
        assert abs(x.mean()) < 4 / np.sqrt(n)
        assert abs(x.var() - 1) < 4 * np.sqrt(2 / n)
        assert abs(stats.skew(x)) < 4 * np.sqrt(6 / n)
        assert abs(stats.kurtosis(x)) < 4 * np.sqrt(24 / n)
        assert stats.kstest(x, "norm").pvalue > 1e-3
        for level in (2.0, 3.0, 4.0, 4.5):  # the tails, on both sides
            expected = n * stats.norm.sf(level)
            for beyond in ((x > level).sum(), (x < -level).sum()):
                assert abs(beyond - expected) < 4 * np.sqrt(expected) + 1
    first, second = drawn
    pairs = {
        "both of a pair": (first, second),
        "successive steps": (first[1:], first[:-1]),
        "neighbouring cells": (first[:, 1:], first[:, :-1]),
        "squares of a pair": (first**2, second**2),
    }
    for name, (a, b) in pairs.items():
        correlation = np.corrcoef(a.ravel(), b.ravel())[0, 1]
        assert abs(correlation) < 4 / np.sqrt(a.size), name


def test_normal_pair__differs_by_seed_source_purpose_and_cell() -> None:
    calls = [(0.0, word(1), word(2), tag_word(0, 0), key_words(3))]
    calls += [(1.0, *calls[0][1:]), (2.0**33, *calls[0][1:])]
    calls += [(0.0, word(2), word(1), tag_word(0, 0), key_words(3)), (0.0, word(1), word(3), *calls[0][3:])]
    calls += [(*calls[0][:3], tag_word(s, p), key_words(3)) for s, p in ((1, 0), (0, 1), (63, 31))]
    calls += [(*calls[0][:4], key_words(seed)) for seed in (4, 3 + 2**32, 2**64 - 1)]
    found = [plain(normal_pair)(*call) for call in calls]
    assert len({float(pair[0]) for pair in found}) == len(calls)


def test_words__ends_and_low_bits() -> None:
    make = plain(uniform)
    assert make(word(0), word(0)) == 2.0**-53
    assert make(word(WORDS), word(WORDS)) == 1.0 - 2.0**-53
    for count in (0, 1, 2**32 - 1, 2**32, 2**51 - 1):
        bits = int(np.float64(count + COUNT_OFFSET).view(np.int64))
        assert bits & (2**51 - 1) == count
        assert bits >> 52 == 1023 + 52
