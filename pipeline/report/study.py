"""Read the file of a study, and compute its results, each once: runs, and inputs that plug-ins add."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any

from pydantic import Field, ValidationError, create_model, model_validator

from pipeline.products.plugins import added
from pipeline.products.registry import ANALYSES, FIGURES
from pipeline.report.inputs import Input
from pipeline.report.pictures import PictureTable, kinds
from pipeline.runs.derive import AnalysedRun
from pipeline.runs.run import run
from pipeline.specification.files import STUDY, find_spec, read_toml, shipped_files
from pipeline.specification.problems import SpecError, problems_of, unknown_name, validated
from pipeline.specification.spec import Spec
from pipeline.specification.tables import Table

INPUTS: dict[str, Input] = added("inputs")
"""Kinds of input beside runs, by their key in a study's file."""


class RunTable(Table):
    """Table ``[runs.NAME]`` of a study's file: a run of the study."""

    spec: str = Field(description="Specification: a file, relative to the study, or the name of one that ships.")


class ClaimTable(Table):
    """Table ``[[figures.claims]]`` of a study's file: a claim, and the measure that decides it."""

    statement: str = Field(description="The claim, paraphrased.")
    source: str = Field(description="Author and place of the claim.")
    measure: str = Field(description="Name of the measure, see pipeline.report.measures.")
    of: Annotated[tuple[str, ...], Field(strict=False, min_length=1)] = Field(
        description="Names of the measured runs or other inputs."
    )
    options: dict[str, Any] = Field({}, description="Options of the measure.")
    least: float = Field(-math.inf, allow_inf_nan=True, description="Least value that meets the claim.")
    most: float = Field(math.inf, allow_inf_nan=True, description="Largest value that meets the claim.")
    expected: float | None = Field(None, description="Published value, instead of least and most.")
    tolerance: Annotated[float, Field(ge=0)] | None = Field(
        None, description="Largest distance from the expected value that meets the claim."
    )
    unit: str = Field("", description="Unit of these values.")
    step: Annotated[float, Field(gt=0)] | None = Field(
        None, description="Coarsest step of the axis that can decide the claim."
    )
    n: Annotated[int, Field(ge=1)] | None = Field(
        None, description="Fewest cells (or curves, or periods) that can decide the claim."
    )
    calibrated: bool = Field(
        False, description="Whether parameters were calibrated on the claim, so that it is no test."
    )
    required: bool = Field(False, description="Whether the command fails if the claim is contradicted.")

    @model_validator(mode="after")
    def _one_form(self) -> ClaimTable:
        bounded = self.model_fields_set & {"least", "most"}
        if (self.expected is None) != (self.tolerance is None):
            raise ValueError("expected and tolerance belong together; give both, or least and most.")
        if self.expected is not None and bounded:
            raise ValueError(f"expected excludes {' and '.join(sorted(bounded))}; give one form.")
        return self

    @property
    def range(self) -> tuple[float, float]:
        """Least and largest value that meet the claim."""
        if self.expected is None or self.tolerance is None:
            return self.least, self.most
        return self.expected - self.tolerance, self.expected + self.tolerance


class FigureTable(Table):
    """Table ``[[figures]]`` of a study's file: figures of the paper, with pictures and claims."""

    number: str = Field(description="Number of the figure, or several numbers; a name without spaces may replace it.")
    title: str = Field(description="Title of the figure.")
    source: str = Field("", description="Citation of the figure's own paper, if it is not the study's.")
    says: str = Field("", description="Statement of the paper's text, paraphrased, with its place.")
    note: str = Field("", description="Difference from the paper.")
    pictures: Annotated[tuple[PictureTable, ...], Field(strict=False)] = Field(
        (), description="Pictures of the figure."
    )
    claims: Annotated[tuple[ClaimTable, ...], Field(strict=False)] = Field((), description="Claims about the figure.")

    @property
    def numbers(self) -> list[str]:
        """Numbers that the figures have in the paper."""
        return self.number.replace(",", " ").split()

    @property
    def needs(self) -> set[str]:
        """Names of the runs and other inputs that the pictures and claims use."""
        return {p.of for p in self.pictures} | {name for claim in self.claims for name in claim.of}


class _StudyTable(Table):
    """Content of the TOML file of a study, without the inputs that plug-ins add."""

    title: str = Field(description="Title of the report.")
    source: str = Field(description="Citation of the reproduced paper.")
    about: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        (), description="Paragraphs that introduce the report."
    )
    runs: dict[str, RunTable] = Field({}, description="Runs that are computed.")
    figures: Annotated[tuple[FigureTable, ...], Field(strict=False, min_length=1)] = Field(
        description="Figures, in order."
    )

    def given(self) -> dict[str, tuple[Input, Table]]:
        """Return the kind and the table of all inputs beside runs, by name."""
        return {name: (kind, table) for key, kind in INPUTS.items() for name, table in getattr(self, key).items()}


_FIELDS: dict[str, Any] = {
    key: (GenericAlias(dict, (str, kind.table)), Field({}, description=kind.meaning)) for key, kind in INPUTS.items()
}
StudyTable = create_model("StudyTable", __base__=_StudyTable, __doc__="Content of the TOML file of a study.", **_FIELDS)


class Study:
    """A study: its name, the path of its TOML file and the content of this file."""

    def __init__(self, name: str, path: Path, table: _StudyTable) -> None:
        self.name, self.path, self.table = name, path, table

    def file(self, name: str) -> Path:
        """Return the path of a file that is given relative to the study's TOML file."""
        return self.path.parent / name


def shipped_studies() -> dict[str, Path]:
    """Return the paths of the studies that ship with the package, by name."""
    return {path.parent.name: path for path in shipped_files(f"*/{STUDY}")}


def load_study(name: str | Path) -> Study:
    """Read a study, given by its file or the name of one that ships; raise SpecError with all its problems."""
    path, shipped = Path(name), shipped_studies()
    if not path.suffix and str(name) in shipped:
        path = shipped[str(name)]
    elif not path.suffix:
        raise SpecError(unknown_name("study", str(name), shipped))
    try:
        table = StudyTable.model_validate(read_toml(path))
    except ValidationError as error:
        raise SpecError(problems_of(error, StudyTable, "")) from None
    problems = _problems(table)
    if problems:
        raise SpecError(problems)
    return Study(path.parent.name if path.name == STUDY else path.stem, path, table)


def _problems(table: _StudyTable) -> list[str]:
    """Return what is wrong with the names in a study: duplicates, and unknown inputs, figures or measures."""
    from pipeline.report.measures import MEASURES

    pictures = kinds()
    known = [*table.runs, *(name for key in INPUTS for name in getattr(table, key))]
    twice = {name for name in known if known.count(name) > 1}
    problems = [f"{name}: names two things of the study; give one another name." for name in sorted(twice)]
    for i, figure in enumerate(table.figures):
        problems += [
            f"figures[{i}]: {unknown_name('input', name, known)}" for name in sorted(figure.needs - set(known))
        ]
        for k, picture in enumerate(figure.pictures):
            if picture.kind not in pictures:
                at = f"figures[{i}].pictures[{k}].kind"
                problems.append(f"{at}: {unknown_name('kind of picture', picture.kind, pictures)}")
            if picture.kind == "plot":
                problems += _plot_problems(f"figures[{i}].pictures[{k}]", picture)
        for k, claim in enumerate(figure.claims):
            at = f"figures[{i}].claims[{k}]"
            if claim.measure not in MEASURES:
                problems.append(f"{at}.measure: {unknown_name('measure', claim.measure, MEASURES)}")
            if claim.least > claim.most:
                problems.append(f"{at}: least = {claim.least:g} is more than most = {claim.most:g}.")
    return problems


def _plot_problems(at: str, picture: PictureTable) -> list[str]:
    if picture.figure not in FIGURES:
        return [f"{at}.figure: {unknown_name('figure', picture.figure, FIGURES)}"]
    problems = []
    for product, table in ((FIGURES[picture.figure], "options"), (ANALYSES["branches"], "branches")):
        try:
            validated(product.options, getattr(picture, table), f"{at}.{table}")
        except SpecError as error:
            problems += error.problems
    return problems


Echo = Callable[[str], None]


class Results:
    """Results of a study in a folder; each is computed when it is first needed, in small sizes if `smoke`.

    Runs lie in ``runs/`` and are completed, not repeated. Other inputs take seconds and are computed again, with the
    same numbers; their files lie in a folder named by their key.
    """

    def __init__(self, study: Study, folder: Path, *, smoke: bool, workers: int | None, echo: Echo) -> None:
        self.study, self.folder, self.smoke = study, folder, smoke
        self._workers, self._echo = workers, echo
        self._runs: dict[str, AnalysedRun] = {}
        self._computed: dict[str, Any] = {}

    def prepare(self, names: set[str]) -> None:
        """Check the inputs of the results that are needed, then compute the runs among them.

        Raise SpecError with all problems of specifications and other inputs, before anything is computed.
        """
        self._check(names)
        for name in self.study.table.runs:
            if name in names:
                self.run(name)

    def _check(self, names: set[str]) -> None:
        """Read all needed specifications and inputs; raise a SpecError that lists all problems."""
        table, problems = self.study.table, []
        checks: list[tuple[str, Callable[[str], Any]]] = [
            *((name, lambda name: Spec.read(self.spec(name), smoke=self.smoke)) for name in table.runs),
            *((name, self.read) for name in table.given()),
        ]
        for name, check in checks:
            if name in names:
                try:
                    check(name)
                except SpecError as error:
                    problems += [f"{name}: {problem}" for problem in error.problems]
        if problems:
            raise SpecError(problems)

    def spec(self, name: str) -> Path:
        """Return the path of the specification of one of the study's runs."""
        given = self.study.table.runs[name].spec
        return self.study.file(given) if given.endswith(".toml") else find_spec(given)

    def run(self, name: str) -> AnalysedRun:
        """Compute the missing cells of one of the study's runs, and return the run."""
        if name not in self._runs:
            place = self.folder / "runs" / name
            place.parent.mkdir(parents=True, exist_ok=True)
            self._echo(f"{name}: {self.spec(name).name}")
            run(self.spec(name), place, workers=self._workers, smoke=self.smoke, echo=self._echo)
            self._runs[name] = AnalysedRun.of(place, self._echo)
        return self._runs[name]

    def runs(self) -> dict[str, AnalysedRun]:
        """Return the runs of the study that are computed so far, by name."""
        return dict(self._runs)

    def read(self, name: str) -> Any:
        """Return what an input of the study is computed from; raise SpecError if it cannot be read."""
        kind, table = self.study.table.given()[name]
        return kind.read(table, self.study.path.parent)

    def computed(self, name: str) -> Any:
        """Return the result of an input of the study by name; it is computed at the first call."""
        if name not in self._computed:
            kind, table = self.study.table.given()[name]
            self._echo(f"{name}: {kind.title}")
            key = next(key for key, other in INPUTS.items() if other is kind)
            self._computed[name] = kind.compute(kind.read(table, self.study.path.parent), self.folder / key / name)
        return self._computed[name]
