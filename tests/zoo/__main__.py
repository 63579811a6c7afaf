"""Run the zoo and print a table: ``python -m tests.zoo [NAME ...] [--quick] [--settings all] [--workers N]``.

Each system runs with its own settings, or with ``--settings all`` with its variants, too (some 700 runs). The exit
status is 1 if anything is wrong. A new system is a specification ``systems/NAME.toml`` and its answer beside it.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from magpend_core.models import load_model
from magpend_core.models.text.model import TextModel
from tests.zoo import answers, variants
from tests.zoo.rescaling import UNITS
from tests.zoo.running import Outcome, outcome_of

WORDS = ("right", "not settled", "kind undecided", "WRONG", "error")


def main() -> int:
    """Parse the command line, run, print."""
    parser = argparse.ArgumentParser(prog="python -m tests.zoo", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="systems; all by default")
    parser.add_argument("--quick", action="store_true", help="only the sample of the suite")
    parser.add_argument("--settings", default=variants.OWN, help="'own', 'all', or the name of one")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds for a setting")
    asked = parser.parse_args()
    names = asked.names or answers.names()
    if asked.quick:
        names = [n for n in names if answers.load(n).quick]
    jobs = [(n, s) for n in names for s in _settings(n, asked.settings)]
    outcomes = []
    for outcome in _outcomes(jobs, asked.workers, asked.limit):
        outcomes.append(outcome)
        print(_line(outcome), flush=True)
    print(summary(outcomes))
    return int(any(o.word in ("WRONG", "error") for o in outcomes))


def _settings(name: str, asked: str) -> list[str]:
    if asked in UNITS:
        return [asked] if isinstance(load_model(variants.load(name)["model"]), TextModel) else []
    every = [word for word, _ in variants.settings(variants.load(name))]
    return every if asked == "all" else [word for word in every if word == asked]


def _outcomes(jobs: list[tuple[str, str]], workers: int, limit: float) -> Iterator[Outcome]:
    """Yield outcomes as they come."""
    if workers < 2:
        yield from (outcome_of(*job, limit) for job in jobs)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for done in as_completed([pool.submit(outcome_of, *job, limit) for job in jobs]):
            yield done.result()


def _line(outcome: Outcome) -> str:
    """Line of the table: system, setting, verdict, time; then what was expected and found."""
    lines = [f"{outcome.name:28s} {outcome.setting:16s} {outcome.word:14s} {outcome.seconds:6.1f} s"]
    if outcome.word != "right":
        known = answers.load(outcome.name)
        lines.append("    expected: " + "; ".join(_placed(k) for k in known.sets))
        lines.append("    found:    " + (outcome.found or "nothing"))
    return "\n".join([*lines, *(f"    WRONG: {reason}" for reason in outcome.reasons)])


def _placed(known: answers.Known) -> str:
    where = ", ".join(f"{k} = {v:g}" for k, v in known.where.items())
    return f"{known.words} at {where}" if where else known.words


def summary(outcomes: Iterable[Outcome]) -> str:
    """Count the verdicts in a line."""
    outcomes = list(outcomes)
    counts = Counter(o.word for o in outcomes)
    n = len({o.name for o in outcomes})
    told = ", ".join(f"{counts[word]} {word}" for word in WORDS)
    return f"{n} systems, {len(outcomes)} settings: {told}"


if __name__ == "__main__":
    sys.exit(main())
