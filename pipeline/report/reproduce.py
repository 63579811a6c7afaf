"""Reproduce a study: compute its results, draw its pictures, judge its claims, and write one page."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.layout.writing import json_value, write_atomically
from pipeline.report.estimates import Estimate, Verdict, judged
from pipeline.report.measures import MEASURES
from pipeline.report.page import Block, Facts, Grid, Note, Outcome, Page, Part, Text, write
from pipeline.report.pictures import picture
from pipeline.report.report import made_by, provenance_of
from pipeline.report.study import ClaimTable, FigureTable, Results, Study
from pipeline.runs.stopping import stoppable
from pipeline.specification.problems import SpecError, unknown_name
from pipeline.store.provenance import versions

PAGE, CLAIMS = "report.html", "claims.json"
Echo = Callable[[str], None]


@dataclass(frozen=True)
class Judgement:
    """A claim with its measured estimate and the verdict."""

    figure: str  # number of the figure
    claim: ClaimTable  # the claim
    estimate: Estimate  # the measured value with its interval
    verdict: Verdict  # the verdict
    plain: Verdict  # the verdict as if nothing had been calibrated on the claim
    reason: str  # reason for the verdict, if the numbers alone do not show it

    @property
    def fails(self) -> bool:
        """Whether a required claim is contradicted by the result."""
        return self.claim.required and self.plain is Verdict.NOT_MET


@dataclass(frozen=True)
class Reproduced:
    """Result of reproducing a study: its folder, its report page and the judged claims."""

    folder: Path  # folder with all results
    page: Path  # path of the HTML page
    judgements: Sequence[Judgement]  # judged claims

    @property
    def failed(self) -> list[Judgement]:
        """Required claims that the results contradict."""
        return [judgement for judgement in self.judgements if judgement.fails]


def reproduce(
    study: Study,
    folder: Path,
    *,
    figures: Sequence[str] = (),
    smoke: bool = False,
    workers: int | None = None,
    echo: Echo = print,
) -> Reproduced:
    """Compute the missing runs of a study, judge its claims and write its report page.

    Parameters
    ----------
    study
        See `pipeline.report.study.load_study`.
    folder
        Folder for all results, which is made if necessary. Results that it holds already are used.
    figures
        Numbers of the figures; by default all.
    smoke
        Whether to use the small sizes of the specifications.
    workers
        See `pipeline.runs.run.run`.
    echo
        Function that prints a line.

    Raises
    ------
    SpecError
        If a figure is unknown; before anything is computed.
    Exception
        See `pipeline.runs.run.run`. Committed tasks stay, and the same call continues.
    """
    chosen = _chosen(study, figures)
    results = Results(study, folder, smoke=smoke, workers=workers, echo=echo)
    results.prepare({name for figure in chosen for name in figure.needs})
    with stoppable(str(folder)):
        parts, judgements = [], []
        for figure in chosen:
            echo(f"figure {figure.number}: {figure.title}")
            own = [judge(results, figure.number, claim) for claim in figure.claims]
            parts.append(_part(results, figure, own))
            judgements += own
    name = f"report-{'-'.join(n for f in chosen for n in f.numbers)}.html" if figures else PAGE
    parts += _provenance(results)
    page = Page(study.table.title, _summary(results, judgements), parts, made_by())
    write(page, folder / name)
    write_atomically(folder / name.replace(PAGE[:6], CLAIMS[:6]).replace(".html", ".json"), _rows(judgements))
    return Reproduced(folder, folder / name, judgements)


def _chosen(study: Study, figures: Sequence[str]) -> list[FigureTable]:
    every = study.table.figures
    known = [number for figure in every for number in figure.numbers]
    unknown = [unknown_name("figure", number, known) for number in figures if number not in known]
    if unknown:
        raise SpecError(unknown)
    return [f for f in every if not figures or set(f.numbers) & set(figures)]


def judge(results: Results, figure: str, claim: ClaimTable) -> Judgement:
    """Measure the quantity of a claim, and compare it with the claimed range.

    The verdict is undecided if the axis is coarser, or the sample smaller, than the claim requires.
    """
    try:
        found = MEASURES[claim.measure](results, claim.of, claim.options)
    except KeyError as error:
        raise SpecError(f"figure {figure}: {claim.measure} lacks the option {error}.") from None
    plain, reason = judged(found.low, found.high, *claim.range), ""
    if found.missing:
        plain, reason = Verdict.UNDECIDED, f"Not measured: {found.missing}.{_decides(claim)}"
    elif claim.step and found.step and found.step > claim.step * (1 + 1e-6):
        plain = Verdict.UNDECIDED
        reason = f"The axis has steps of {found.step:.4g}; the claim needs steps of at most {claim.step:g}."
    elif claim.n and found.n is not None and found.n < claim.n:
        plain, reason = Verdict.UNDECIDED, f"The sample is {found.n}; the claim needs at least {claim.n}."
    elif plain is Verdict.UNDECIDED:
        reason = "The interval lies partly outside the claimed range; a larger sample or a finer axis can decide."
    if claim.calibrated and plain is not Verdict.UNDECIDED:
        agrees = "agrees with the claim" if plain is Verdict.MET else "contradicts the claim"
        return Judgement(figure, claim, found, Verdict.CALIBRATED, plain, f"The result {agrees}.")
    return Judgement(figure, claim, found, Verdict.CALIBRATED if claim.calibrated else plain, plain, reason)


def _decides(claim: ClaimTable) -> str:
    steps = f"steps of at most {claim.step:g}" if claim.step else ""
    cells = f"at least {claim.n} cells" if claim.n else ""
    both = " and ".join(part for part in (steps, cells) if part)
    return f" The claim needs {both}." if both else ""


def _part(results: Results, figure: FigureTable, judgements: Sequence[Judgement]) -> Part:
    blocks: list[Block] = []
    if figure.source:
        blocks.append(Note(figure.source))
    if figure.says:
        blocks.append(Text(f"The paper's text: {figure.says}"))
    if figure.note:
        blocks.append(Note(figure.note))
    blocks += [picture(results, table) for table in figure.pictures]
    blocks += [_outcome(judgement) for judgement in judgements]
    blocks.append(Note("This section alone:", _command(results, figure)))
    return Part(f"{_named(figure)}: {figure.title}", blocks)


def _named(figure: FigureTable) -> str:
    if not figure.number[:1].isdigit():
        return figure.number
    return f"{'Figures' if len(figure.numbers) > 1 else 'Figure'} {figure.number}"


def _command(results: Results, figure: FigureTable) -> str:
    smoke = " --smoke" if results.smoke else ""
    shipped = results.study.name if results.study.path.name == "study.toml" else str(results.study.path)
    name = shlex.quote(shipped)
    out = shlex.quote(str(results.folder))
    return f"magpend reproduce {name}{smoke} --figure {figure.numbers[0]} --out {out}"


def _outcome(judgement: Judgement) -> Outcome:
    claim = judgement.claim
    return Outcome(
        claim.statement,
        claim.source,
        f"Came out: {spelled(judgement)}",
        judgement.verdict,
        judgement.reason,
        claim.required,
    )


def spelled(judgement: Judgement) -> str:
    """Return a text with the measured result of a claim, its interval, and the claimed range."""
    found, claim = judgement.estimate, judgement.claim
    if found.missing:
        return "not measured."
    unit = f" {claim.unit}" if claim.unit else ""
    digits = _digits(found.high - found.low)
    high = "more" if math.isinf(found.high) else digits.format(found.high)
    text = f"{digits.format(found.value)}{unit} ({digits.format(found.low)} to {high})"
    return f"{text}; {found.text}. Claimed: {_range(claim)}{unit}."


def _digits(width: float) -> str:
    if not (math.isfinite(width) and width > 1e-8):
        return "{:.7g}"
    return f"{{:.{min(max(0, 1 - math.floor(math.log10(width))), 9)}f}}"


def _range(claim: ClaimTable) -> str:
    if claim.expected is not None:
        return f"{claim.expected:.10g}" + (f" ± {claim.tolerance:g}" if claim.tolerance else "")
    low, high = math.isfinite(claim.least), math.isfinite(claim.most)
    if low and high:
        return f"{claim.least:g}" if claim.least == claim.most else f"{claim.least:g} to {claim.most:g}"
    return f"at least {claim.least:g}" if low else f"at most {claim.most:g}" if high else "any"


def _summary(results: Results, judgements: Sequence[Judgement]) -> list[Block]:
    """Make the blocks at the top of the page: counts of verdicts, source, all claims, versions."""
    table = results.study.table
    counts = {verdict: sum(j.verdict is verdict for j in judgements) for verdict in Verdict}
    failed = sum(j.fails for j in judgements)
    lead = [Text(headline(judgements, results.smoke))] if judgements else []
    blocks: list[Block] = [*lead, Note(table.source), *(Text(text) for text in table.about)]
    size = "smoke size: it shows that everything works, and decides little" if results.smoke else "full size"
    blocks.append(
        Facts(
            {
                "size": size,
                "claims": ", ".join(f"{n} {verdict.words}" for verdict, n in counts.items() if n) or "none",
                "required claims contradicted": str(failed),
                "versions": ", ".join(f"{name} {version}" for name, version in versions().items()),
            }
        )
    )
    rows = [
        (j.figure, j.claim.statement, spelled(j).partition(";")[0].rstrip("."), j.verdict.words)
        for j in decided_first(judgements)
    ]
    if rows:
        heads = ("figure", "claim", "result (95 % interval)", "verdict")
        blocks.append(Grid(heads, rows, "Claims that are tests", stacked=True))
    if calibrated := calibrated_on(judgements):
        blocks.append(Text(calibrated))
    return blocks


def headline(judgements: Sequence[Judgement], smoke: bool) -> str:
    """Return a sentence on how many claims are met, not met or undecided."""
    tests = decided_first(judgements)
    met, failed, left = (sum(j.verdict is v for j in tests) for v in (Verdict.MET, Verdict.NOT_MET, Verdict.UNDECIDED))
    text = f"Of {len(tests)} claims that are tests, {met} are met, {failed} not met, {left} undecided."
    remedy = " The smoke size shows that every step works; the full size (without --smoke) decides more."
    return text + (remedy if smoke else "")


def decided_first(judgements: Sequence[Judgement]) -> list[Judgement]:
    """Return the claims that test the model, decided ones first; claims used for calibration are left out."""
    tests = [j for j in judgements if j.verdict is not Verdict.CALIBRATED]
    return sorted(tests, key=lambda j: j.verdict is Verdict.UNDECIDED)


def calibrated_on(judgements: Sequence[Judgement]) -> str:
    """Return a paragraph on the claims on which parameters were calibrated; an empty text if there are none."""
    own = [j for j in judgements if j.verdict is Verdict.CALIBRATED]
    if not own:
        return ""
    text = f"{len(own)} of {len(judgements)} claims are no test: parameters were calibrated on them."
    heads = {
        Verdict.MET: "Came out",
        Verdict.NOT_MET: "Did not come out",
        Verdict.UNDECIDED: "Undecided whether they came out",
    }
    for verdict, head in heads.items():
        named = [f"figure {j.figure}: {j.claim.statement.rstrip('.')}" for j in own if j.plain is verdict]
        text += f" {head}: {'; '.join(named)}." if named else ""
    return text


def _provenance(results: Results) -> list[Part]:
    runs = results.runs()
    if not runs:
        return []
    rows = [(name, run.info.title, str(run.plan.n_cells), run.digest) for name, run in runs.items()]
    table = Grid(("run", "what", "cells", "digest of the cube"), rows, stacked=True)
    own = []
    for name, run in runs.items():
        spec = results.study.table.runs[name].spec
        words = "SPEC" if spec.endswith(".toml") else spec + (" --smoke" if results.smoke else "")
        own.append(Part(f"Run {name}", list(provenance_of(run, words))))
    return [Part("Provenance", [table], own)]


def _rows(judgements: Sequence[Judgement]) -> str:
    rows = [
        {
            "figure": j.figure,
            "statement": j.claim.statement,
            "source": j.claim.source,
            "measure": j.claim.measure,
            "of": list(j.claim.of),
            "least": json_value(j.claim.range[0]),
            "most": json_value(j.claim.range[1]),
            "expected": json_value(j.claim.expected),
            "unit": j.claim.unit,
            "value": json_value(j.estimate.value),
            "low": json_value(j.estimate.low),
            "high": json_value(j.estimate.high),
            "text": j.estimate.text or j.estimate.missing,
            "verdict": j.verdict.words,
            "reason": j.reason,
            "required": j.claim.required,
            "fails": j.fails,
        }
        for j in judgements
    ]
    return json.dumps(rows, indent=1, ensure_ascii=False) + "\n"
