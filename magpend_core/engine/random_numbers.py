"""Compute random numbers from a counter: Philox-4x32-10, and normal numbers from it.

A counter-based generator has no state: its output is a function of a key and a counter. So the noise of a cell
depends on the run's seed (the key), the cell and the step (the counter) alone, and not on what was drawn before
it or on other lanes. Philox: J. K. Salmon, M. A. Moraes, R. O. Dror and D. E. Shaw, Parallel random numbers: as
easy as 1, 2, 3, SC'11 (2011), section 3.3. Normal numbers are made by the method of Box and Muller (Ann. Math.
Stat. 29, 1958, 610): it needs no rejection, hence no branch.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from magpend_core.engine.jit import inline
from magpend_core.engine.simd import sqrt
from magpend_core.engine.vecmath import TWO_PI, log, sincos
from magpend_core.engine.words import exclusive_or, lower_word, one_and_fraction, upper_word, word, word_product

N_ROUNDS = 10
_MULTIPLIERS = word(0xD2511F53), word(0xCD9E8D57)
_KEY_STEPS = 0x9E3779B9, 0xBB67AE85
_FIRST, _SECOND = _MULTIPLIERS
_HALF_DIGIT = 2.0**-53

MAX_SEED = 2**64 - 1
MAX_SOURCES = 64
"""Most independent noises of a cell: each has its own numbers in the counter."""
_TAG_BIT = 20  # above the digits that a count of steps needs, see `counter_words`
COUNT_OFFSET = 2.0**52
"""Added to a count, it leaves the count's binary digits in the low bits of the float."""


def key_words(seed: int) -> np.ndarray:
    """Return the round keys of a seed, two words for each round, shape (20,).

    Parameters
    ----------
    seed
        From 0 to `MAX_SEED`; its lower and its upper 32 bits are the two words of the key.
    """
    first, second = seed & 0xFFFFFFFF, seed >> 32
    keys = []
    for i in range(N_ROUNDS):
        keys += [(first + i * _KEY_STEPS[0]) & 0xFFFFFFFF, (second + i * _KEY_STEPS[1]) & 0xFFFFFFFF]
    return np.array(keys, np.int64).view(np.float64)


def tag_word(source: int, purpose: int) -> float:
    """Return the word that separates the numbers of different noises and uses within a step.

    Parameters
    ----------
    source
        Number of the noise, below `MAX_SOURCES`.
    purpose
        From 0 to 31.
    """
    return word((source * 32 + purpose) << _TAG_BIT)


@inline
def philox(a: Any, b: Any, c: Any, d: Any, keys: Any) -> Any:
    """Return four random words for a counter of four words, by ten rounds of Philox-4x32.

    Parameters
    ----------
    a, b, c, d
        Words of the counter (see `words`).
    keys
        What `key_words` returned.
    """
    for i in range(N_ROUNDS):
        first, second = word_product(_FIRST, a), word_product(_SECOND, c)
        a = exclusive_or(exclusive_or(upper_word(second), b), keys[2 * i])
        c = exclusive_or(exclusive_or(upper_word(first), d), keys[2 * i + 1])
        b, d = lower_word(second), lower_word(first)
    return a, b, c, d


@inline
def uniform(a: Any, b: Any) -> Any:
    """Return a uniform number in (0, 1) from two random words: an odd multiple of 2**-53."""
    return (one_and_fraction(a, b) - 1.0) + _HALF_DIGIT


@inline
def uniform_pair(count: Any, low: Any, high: Any, tag: Any, keys: Any) -> Any:
    """Return two independent uniform numbers in (0, 1).

    Parameters
    ----------
    count
        Whole number, below 2**51: of the step since the cell's start.
    low, high
        Words that identify the cell.
    tag
        Of `tag_word`.
    keys
        Of `key_words`.
    """
    counter = count + COUNT_OFFSET
    a, b, c, d = philox(lower_word(counter), exclusive_or(upper_word(counter), tag), low, high, keys)
    return uniform(a, b), uniform(c, d)


@inline
def normal_pair(count: Any, low: Any, high: Any, tag: Any, keys: Any) -> Any:
    """Return two independent standard normal numbers; see `uniform_pair` for the parameters."""
    first, second = uniform_pair(count, low, high, tag, keys)
    radius = sqrt(-2.0 * log(first))
    sine, cosine = sincos(TWO_PI * second)
    return radius * cosine, radius * sine
