"""A study: what is computed, which figures are drawn of it, what is claimed of them; read from TOML."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from pipeline.products.registry import FIGURES
from pipeline.spec.files import read_toml
from pipeline.spec.problems import SpecError, problems_of, unknown_name, validated
from pipeline.spec.tables import Table

STUDY = "study.toml"
"""File of a study that ships, in a folder of its name."""


class RunTable(Table):
    """``[runs.NAME]``."""

    spec: str = Field(
        description="Specification: a file, seen from the study, or the name of one that ships."
    )


class RecordingTable(Table):
    """``[recordings.NAME]``."""

    rig: str = Field(description="Virtual rig: a file, seen from the study.")


class TorqueTable(Table):
    """``[torques.NAME]``."""

    header: str = Field(description="Header of torque readings: a file, or the name of one that ships.")


class PictureTable(Table):
    """``[[figures.pictures]]``."""

    kind: Literal["plot", "quantities", "recording", "series", "torques"] = Field(
        description="plot: a figure of a run, by the name of its command; quantities: quantities of the "
        "model over a drive period; recording, series: a recording, and with the model from the same state; "
        "torques: a figure of a fit of torque readings."
    )
    of: str = Field(description="Name of the run, the recording or the torque readings.")
    figure: str = Field("", description="Which figure of a run or of torque readings.")
    quantities: Annotated[tuple[str, ...], Field(strict=False)] = Field((), description="Which quantities.")
    frequency_hz: Annotated[float, Field(gt=0)] | None = Field(None, description="Drive frequency [Hz].")
    caption: str = Field(description="A sentence below it.")
    options: dict[str, Any] = Field({}, description="Options of the figure, as its command has them.")


class ClaimTable(Table):
    """``[[figures.claims]]``."""

    statement: str = Field(description="What is claimed, in words of one's own.")
    source: str = Field(description="Who claims it, and where.")
    measure: str = Field(description="What measures it, see pipeline.report.measures.")
    of: Annotated[tuple[str, ...], Field(strict=False, min_length=1)] = Field(
        description="What is measured: names of runs, recordings or torque readings."
    )
    options: dict[str, Any] = Field({}, description="Options of the measure.")
    least: float = Field(-math.inf, allow_inf_nan=True, description="Least value that meets the claim.")
    most: float = Field(math.inf, allow_inf_nan=True, description="Largest value that meets the claim.")
    unit: str = Field("", description="Unit of these.")
    step: Annotated[float, Field(gt=0)] | None = Field(
        None, description="Coarsest step of the axis that can decide; with a coarser one it is undecided."
    )
    n: Annotated[int, Field(ge=1)] | None = Field(
        None, description="Fewest cells (or curves, or periods) that can decide."
    )
    calibrated: bool = Field(
        False, description="Whether parameters were calibrated on it: it is no test then."
    )
    required: bool = Field(False, description="Whether the command fails where it is contradicted.")


class FigureTable(Table):
    """``[[figures]]``."""

    number: str = Field(description="Its number, or several.")
    title: str = Field(description="What it is.")
    says: str = Field("", description="What the text says of it, in words of one's own, with the place.")
    note: str = Field("", description="What differs here.")
    pictures: Annotated[tuple[PictureTable, ...], Field(strict=False)] = Field(
        (), description="What is drawn."
    )
    claims: Annotated[tuple[ClaimTable, ...], Field(strict=False)] = Field((), description="What is claimed.")

    @property
    def numbers(self) -> list[str]:
        """Numbers of the figures that it stands for."""
        return self.number.replace(",", " ").split()

    @property
    def needs(self) -> set[str]:
        """Names of all that it is made from."""
        return {p.of for p in self.pictures} | {name for claim in self.claims for name in claim.of}


class StudyTable(Table):
    """A study, whole."""

    title: str = Field(description="Title of the report.")
    source: str = Field(description="What is reproduced: the citation.")
    about: Annotated[tuple[str, ...], Field(strict=False)] = Field((), description="What a reader must know.")
    runs: dict[str, RunTable] = Field({}, description="What is computed.")
    recordings: dict[str, RecordingTable] = Field({}, description="What virtual rigs record.")
    torques: dict[str, TorqueTable] = Field({}, description="Torque readings that are fitted.")
    figures: Annotated[tuple[FigureTable, ...], Field(strict=False, min_length=1)] = Field(
        description="The figures, in order."
    )


class Study:
    """A study and where it stands.

    Parameters
    ----------
    name
        By which it was asked for.
    path
        Its file.
    table
        What it says.
    """

    def __init__(self, name: str, path: Path, table: StudyTable) -> None:
        self.name, self.path, self.table = name, path, table

    def file(self, name: str) -> Path:
        """Return a file that the study names, seen from it."""
        return self.path.parent / name


def shipped_studies() -> dict[str, Path]:
    """Paths of the studies that ship, by name."""
    try:
        folder = Path(str(resources.files("workflows")))
    except ModuleNotFoundError:
        return {}
    return {path.parent.name: path for path in sorted(folder.glob(f"*/{STUDY}"))}


def load_study(name: str | Path) -> Study:
    """Read a study: a file, or the name of one that ships.

    Raises
    ------
    SpecError
        Naming all that is wrong with it: keys, names of what it is made from, measures.
    """
    path, shipped = Path(name), shipped_studies()
    if not path.suffix and str(name) in shipped:
        path = shipped[str(name)]
    elif not path.suffix:
        raise SpecError([unknown_name("study", str(name), shipped)])
    try:
        table = StudyTable.model_validate(read_toml(path))
    except ValidationError as error:
        raise SpecError(problems_of(error, StudyTable, "")) from None
    problems = _problems(table)
    if problems:
        raise SpecError(problems)
    return Study(path.parent.name if path.name == STUDY else path.stem, path, table)


def _problems(table: StudyTable) -> list[str]:
    """Sentences on names that nothing has."""
    from pipeline.report.measures import MEASURES

    known = [*table.runs, *table.recordings, *table.torques]
    twice = {name for name in known if known.count(name) > 1}
    problems = [f"{name}: names two things of the study; give one another name." for name in sorted(twice)]
    for i, figure in enumerate(table.figures):
        problems += [
            f"figures[{i}]: {unknown_name('input', name, known)}"
            for name in sorted(figure.needs - set(known))
        ]
        for k, picture in enumerate(figure.pictures):
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
    """Sentences on the figure of a run that nobody draws, and on options that it does not have."""
    if picture.figure not in FIGURES:
        return [f"{at}.figure: {unknown_name('figure', picture.figure, FIGURES)}"]
    try:
        validated(FIGURES[picture.figure].options, picture.options, f"{at}.options")
    except SpecError as error:
        return error.problems
    return []
