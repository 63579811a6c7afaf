"""Count right, open and wrong answers of `magpend.series_of` on seeded series of known dynamics.

    OMP_NUM_THREADS=1 python tests/bench/series.py [--seeds 3 4] [--cases NAME ...]

Each series has its own start or noise. Five questions are asked of it: is it chaotic, is it periodic, and does the 95 %
interval of the exponent, of the correlation dimension and of the period hold the known value. Noise has none of them,
so each answer but "not decided" is wrong there. Exponents and dimensions are those of Sprott, Chaos and Time-Series
Analysis (2003), appendix A; of Lorenz's system the dimension of Grassberger and Procaccia (1983). A dimension is right
if its interval meets the published one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

import magpend

TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Case:
    """A kind of series, and the known answers."""

    make: Callable[[int, np.random.Generator], np.ndarray]
    step: float
    sizes: tuple[tuple[int, float], ...]  # lengths, with the noise in standard deviations
    motion: str  # "chaotic", "periodic", "regular" or "noise"
    exponent: float = np.nan
    dimension: tuple[float, float] = (np.nan, np.nan)
    period: float = np.nan  # mean time between maxima, of a closed orbit the time of its cycle
    cycle: int = 0


def flow(rates: Callable[..., list[float]], step: float, skip: float) -> Callable[..., np.ndarray]:
    """Return a maker of series: first coordinates of trajectories from random starts."""

    def make(n: int, rng: np.random.Generator) -> np.ndarray:
        times = skip + np.arange(n) * step
        start = rng.uniform(0.5, 1.5, 3)
        return solve_ivp(rates, (0.0, times[-1]), start, "DOP853", times, rtol=1e-9, atol=1e-9).y[0]

    return make


def roessler(c: float) -> Callable[..., list[float]]:
    """Return the rates of Roessler's system with a = b = 0.2."""
    return lambda t, y: [-y[1] - y[2], y[0] + 0.2 * y[1], 0.2 + y[2] * (y[0] - c)]


def lorenz(t: float, y: np.ndarray) -> list[float]:
    """Return the rates of Lorenz's system."""
    return [10.0 * (y[1] - y[0]), y[0] * (28.0 - y[2]) - y[1], y[0] * y[1] - 8.0 / 3.0 * y[2]]


def ueda(t: float, y: np.ndarray) -> list[float]:
    """Return the rates of Ueda's oscillator; the phase of its drive is a coordinate."""
    return [y[1], -0.05 * y[1] - y[0] ** 3 + 7.5 * np.sin(y[2]), 1.0]


def torus(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return a motion of two frequencies, 1 and 1/sqrt(3)."""
    a, b = rng.uniform(0.0, TURN, 2)
    t = 0.17 * np.arange(n)
    slow = t / np.sqrt(3.0) + b
    return np.cos(t + a) * (1.0 + 0.3 * np.sin(slow)) + 0.5 * np.cos(slow)


def orbit(*amplitudes: float) -> Callable[..., np.ndarray]:
    """Return a maker of closed orbits with given harmonics and random phase."""

    def make(n: int, rng: np.random.Generator) -> np.ndarray:
        t = 0.1 * np.arange(n) + rng.uniform(0.0, TURN)
        return np.sum([a * np.cos((k + 1) * t + k) for k, a in enumerate(amplitudes)], axis=0)

    return make


def autoregressive(*poles: float) -> Callable[..., np.ndarray]:
    """Return a maker of linear noise with given coefficients."""
    return lambda n, rng: lfilter([1.0], poles, rng.normal(size=n + 1000))[1000:]


def pink(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return noise with a spectrum 1/f and random phases."""
    lines = rng.normal(size=(2, n // 2 + 1))
    return np.fft.irfft((lines[0] + 1j * lines[1]) / np.sqrt(np.maximum(np.arange(n // 2 + 1), 1.0)), n)


def randomised(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return noise with the spectrum of a series of Roessler's system."""
    lines = np.abs(np.fft.rfft(CASES["roessler"].make(n, rng) * np.hanning(n)))
    return np.fft.irfft(lines * np.exp(1j * rng.uniform(0.0, TURN, len(lines))), n)


NARROW = (1.0, -1.98 * np.cos(0.2), 0.9801)
CASES = {
    "roessler": Case(
        flow(roessler(5.7), 0.2, 300.0),
        0.2,
        ((1500, 0.0), (4000, 0.0), (8000, 0.0), (4000, 0.01), (4000, 0.05), (4000, 0.2)),
        "chaotic",
        0.0714,
        (1.991 - 0.065, 1.991 + 0.065),
        5.857,
    ),
    "lorenz": Case(
        flow(lorenz, 0.03, 30.0),
        0.03,
        ((1500, 0.0), (4000, 0.0), (8000, 0.0), (4000, 0.01), (4000, 0.05), (4000, 0.2)),
        "chaotic",
        0.9056,
        (2.04, 2.06),
    ),
    "ueda": Case(
        flow(ueda, 0.2, 200.0), 0.2, ((4000, 0.0), (10_000, 0.0), (4000, 0.02)), "chaotic", 0.1034, (2.543, 2.807)
    ),
    "torus": Case(
        torus, 0.17, ((1500, 0.0), (4000, 0.0), (12_000, 0.0), (4000, 0.05)), "regular", 0.0, (2.0, 2.0), TURN
    ),
    "orbit": Case(orbit(1.0, 0.3), 0.1, ((1500, 0.05), (3000, 0.2), (4000, 0.0)), "periodic", 0.0, (1.0, 1.0), TURN, 1),
    "orbit-2": Case(orbit(0.5, 1.0), 0.1, ((4000, 0.1),), "periodic", 0.0, (1.0, 1.0), TURN, 2),
    "doubled": Case(
        flow(roessler(3.5), 0.2, 800.0), 0.2, ((4000, 0.0), (4000, 0.02)), "periodic", 0.0, (1.0, 1.0), 2 * 5.7726, 2
    ),
    "ar1": Case(autoregressive(1.0, -0.95), 1.0, ((1500, 0.0), (4000, 0.0)), "noise"),
    "narrow": Case(autoregressive(*NARROW), 1.0, ((1500, 0.0), (4000, 0.0)), "noise"),
    "skewed": Case(lambda n, rng: np.exp(0.1 * autoregressive(*NARROW)(n, rng)), 1.0, ((4000, 0.0),), "noise"),
    "pink": Case(pink, 1.0, ((4000, 0.0),), "noise"),
    "randomised": Case(randomised, 0.2, ((4000, 0.0),), "noise"),
}

QUESTIONS = ("chaotic", "periodic", "exponent", "dimension", "period")


def answers(case: Case, found: xr.Dataset) -> dict[str, str]:
    """Return "right", "open" or "wrong" for each question; "" where there is nothing to ask."""
    said = str(found.attrs["motion"])
    right = {"chaotic": "open" if said == "not decided" else "right" if _agrees(said, case.motion) else "wrong"}
    if said == "periodic":
        cycle = int(found["value"].sel(quantity="cycle"))
        right["periodic"] = "right" if case.motion == "periodic" and cycle == case.cycle else "wrong"
    elif said == "chaotic":
        right["periodic"] = "wrong" if case.motion in ("periodic", "noise") else "right"
    else:
        right["periodic"] = "open"
    right["exponent"] = _holds(found, "exponent", (case.exponent, case.exponent))
    right["dimension"] = _holds(found, "correlation_dimension", case.dimension)
    right["period"] = _holds(found, "period", (case.period, case.period)) if np.isfinite(case.period) else ""
    return right


def _agrees(said: str, truth: str) -> bool:
    return said == truth or (said == "regular" and truth == "periodic")


def _holds(found: xr.Dataset, name: str, truth: tuple[float, float]) -> str:
    one = found.sel(quantity=name)
    if str(one["reason"].item()):
        return "open"
    return "right" if float(one["low"]) <= truth[1] and float(one["high"]) >= truth[0] else "wrong"


def told(found: xr.Dataset, name: str) -> str:
    """Return a result for the table of single series."""
    one = found.sel(quantity=name)
    low, value, high = (float(one[key]) for key in ("low", "value", "high"))
    return "-" if str(one["reason"].item()) else f"{value:.4g} [{low:.4g}, {high:.4g}]"


def main(words: list[str] | None = None) -> int:
    """Print each series and the table; the exit status is the number of wrong answers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 4])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    options = parser.parse_args(words)
    counts = {q: dict.fromkeys(("right", "open", "wrong"), 0) for q in QUESTIONS}
    for name in options.cases:
        case = CASES[name]
        for seed in options.seeds:
            for n, noise in case.sizes:
                rng = np.random.default_rng([seed, n, int(1000 * noise)])
                x = case.make(n, rng)
                x = x + noise * x.std() * rng.normal(size=n)
                found = magpend.series_of(xr.Dataset({"x": ("time", x)}, {"time": np.arange(n) * case.step}))
                given = answers(case, found)
                numbers = [told(found, q) for q in ("exponent", "correlation_dimension", "period")]
                wrong = [q for q in QUESTIONS if given[q] == "wrong"]
                print(
                    f"{name:10s} {seed:3d} {n:6d} {noise:5.2f}  {found.attrs['motion']:12s}",
                    " ".join(f"{text:25s}" for text in numbers),
                    f"WRONG: {', '.join(wrong)}" if wrong else "",
                    f"({found.attrs['motion_reason']})",
                    flush=True,
                )
                for q in QUESTIONS:
                    if given[q]:
                        counts[q][given[q]] += 1
    print(f"\n{'question':10s} right  open wrong")
    for q, own in counts.items():
        print(f"{q:10s} {own['right']:5d} {own['open']:5d} {own['wrong']:5d}")
    return sum(own["wrong"] for own in counts.values())


if __name__ == "__main__":
    sys.exit(main())
