"""Run a setting of a system through magpend, analyse it, and have it judged."""

from __future__ import annotations

import signal
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from tests.zoo import answers, variants
from tests.zoo.answers import Answer
from tests.zoo.judge import Verdict, judge_point, words
from tests.zoo.rescaling import UNITS, Units, plain_units, rescaled


@dataclass
class Outcome:
    """What came of a setting: the rows in words, the verdict, or the error."""

    name: str
    setting: str
    verdict: Verdict = field(default_factory=Verdict)
    found: str = ""
    error: str = ""
    seconds: float = 0.0

    @property
    def word(self) -> str:
        """Verdict in a word."""
        return "error" if self.error else self.verdict.word

    @property
    def reasons(self) -> list[str]:
        """Return the reasons for a verdict other than right."""
        return [self.error] if self.error else self.verdict.wrong


def outcome_of(name: str, setting: str, limit: float = 0.0) -> Outcome:
    """Run one setting of a system in a temporary folder; an error or a time above the limit [s] is kept."""
    started = time.perf_counter()
    outcome = Outcome(name, setting)
    data, units = variants.load(name), None
    try:
        if setting in UNITS:
            data, units = rescaled(data, UNITS[setting])
        else:
            data = dict(variants.settings(data))[setting]
        with _time_limit(limit), tempfile.TemporaryDirectory(prefix=f"zoo-{name}-") as folder:
            ds, rows = analysed(data, Path(folder))
            outcome.verdict = judged(answers.load(name), ds, rows, units)
            outcome.found = "; ".join(words(row) for row in rows)
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        outcome.error = f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
    outcome.seconds = time.perf_counter() - started
    return outcome


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the block after some seconds; 0 for no limit."""

    def expire(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"more than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, expire)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def analysed(data: Mapping[str, Any], folder: Path) -> tuple[Any, list[dict[str, Any]]]:
    """Run a specification and find its attractors; returns the analysis' dataset and the table's rows."""
    from pipeline.analysis.attractors.analysis import attractors_table
    from pipeline.results.ragged import dense
    from pipeline.runs.derive import derive
    from pipeline.runs.run import run

    run(data, folder / "run", workers=0, echo=lambda _: None)
    found = derive(folder / "run", "attractors")
    return dense(found, points=True), attractors_table(found).rows


def judged(answer: Answer, ds: Any, rows: list[dict[str, Any]], units: Units | None = None) -> Verdict:
    """Judge the rows of all parameter points of a run, whose numbers may have other units."""
    from pipeline.layout.vocabulary import model_of, split_dims
    from pipeline.results.sets import Geometry

    model = model_of(ds)
    units = units or plain_units(model.state_names)
    geometry = Geometry(model.is_angle, tuple(np.array(model.scales) / units.factors)).difference
    dims, _ = split_dims(ds["attractor_id"])
    verdict = Verdict()
    for index in np.ndindex(*(ds.sizes[d] for d in dims)):
        one = ds.isel(dict(zip(dims, index, strict=True)))
        where = {d: float(one[d]) for d in dims}
        here = [
            {**units.row(row), "points": units.own(one["attractor_points"].sel(attractor=row["attractor_id"]).values)}
            for row in rows
            if all(np.isclose(row[d], v, rtol=1e-12, atol=0.0) for d, v in where.items())
        ]
        where = {d: v * units.time if d == "frequency" else v for d, v in where.items()}
        n_cells, n_left = _cells(one)
        verdict.add(judge_point(answer, where, here, n_cells=n_cells, n_left=n_left, geometry=geometry))
    return verdict


def _cells(one: Any) -> tuple[int, int]:
    """Cells of a parameter point that did not diverge, and those of them that belong to no set."""

    def shows(name: str, word: str) -> np.ndarray:
        return np.asarray(one[name].values == one[name].attrs["flag_meanings"].split().index(word))

    gone = shows("status", "diverged") | shows("decision", "diverges")
    return int(np.count_nonzero(~gone)), int(np.count_nonzero((one["attractor_id"].values < 0) & ~gone))
