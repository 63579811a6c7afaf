"""Hold what a reader has found in the file of another program, before it becomes a specification."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from magpend_core.models.text.grammar import Tree
from pipeline.specification.problems import SpecError

MOST_FILE_BYTES = 1_000_000
"""Size of the largest file that is read."""
MOST_PROBLEMS = 20
"""Most problems that are told."""


@dataclass
class Reset:
    """An event: where `of` passes zero in `direction`, names get new values, one after the other."""

    of: Tree
    direction: int
    set: dict[str, Tree]
    line: int


@dataclass
class Source:
    """A model as a file of another program gives it. Trees use the names of the file.

    Attributes
    ----------
    program : str
        Program whose file it is.
    states, parts, quantities : dict
        Rates (of a map: next values) by state; named parts of the equations; other quantities.
    starts, parameters : dict
        Initial values; values of parameters, in their order.
    functions : dict
        Arguments and right side by name.
    resets, presets, noises, circles
        Events; values by name of a set; names that are white noise of unit strength; angles modulo 2 pi.
    lines, comments, spelling : dict
        Line of the file, comments before it, and how the file writes a name, by name.
    settings : dict
        Options of the program that decide numbers: section, range, times.
    head : list
        Comments at the beginning of the file.
    notes, problems : list
        Sentences for the user; and what cannot be carried over.
    """

    path: Path
    program: str
    is_map: bool = False
    states: dict[str, Tree] = field(default_factory=dict)
    starts: dict[str, float] = field(default_factory=dict)
    parameters: dict[str, float] = field(default_factory=dict)
    parts: dict[str, Tree] = field(default_factory=dict)
    functions: dict[str, tuple[tuple[str, ...], Tree]] = field(default_factory=dict)
    quantities: dict[str, Tree] = field(default_factory=dict)
    resets: list[Reset] = field(default_factory=list)
    presets: dict[str, dict[str, float]] = field(default_factory=dict)
    noises: list[str] = field(default_factory=list)
    circles: set[str] = field(default_factory=set)
    lines: dict[str, int] = field(default_factory=dict)
    comments: dict[str, list[str]] = field(default_factory=dict)
    spelling: dict[str, str] = field(default_factory=dict)
    settings: dict[str, str] = field(default_factory=dict)
    first_parameter: str = ""
    head: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def refuse(self, line: int, reason: str) -> None:
        """Add a problem with its line."""
        problem = f"line {line}: {reason.rstrip('.')}."
        if problem not in self.problems[-MOST_PROBLEMS:]:
            self.problems.append(problem)

    def line_of(self, name: str) -> int:
        """Return the line in which a name is defined."""
        return self.lines.get(name, 1)

    def spelled(self, name: str) -> str:
        """Return a name as the file writes it."""
        return self.spelling.get(name, name)

    def rewrite(self, change: Callable[[Tree], Tree]) -> None:
        """Replace each expression of the equations, parts, quantities and events by what `change` makes of it."""
        for table in (self.states, self.parts, self.quantities):
            table.update({name: change(tree) for name, tree in table.items()})
        for reset in self.resets:
            reset.of = change(reset.of)
            reset.set = {name: change(tree) for name, tree in reset.set.items()}

    def check(self) -> None:
        """Raise all problems.

        Raises
        ------
        SpecError
            If there are any.
        """
        if self.problems:
            more = len(self.problems) - MOST_PROBLEMS
            told = self.problems[:MOST_PROBLEMS] + ([f"{more} more problems."] if more > 0 else [])
            raise SpecError([f"{self.path.name}{', ' if p.startswith('line ') else ': '}{p}" for p in told])


def text_of(path: Path) -> str:
    """Return the text of a file; bytes that are no UTF-8 are read as Latin-1.

    Raises
    ------
    SpecError
        If it cannot be read, is too large, or is not text.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SpecError(f"{path}: cannot be read ({error.strerror or error}).") from None
    if len(data) > MOST_FILE_BYTES:
        raise SpecError(f"{path}: has {len(data)} bytes; {MOST_FILE_BYTES} are the most for a model.")
    if b"\0" in data:
        raise SpecError(f"{path}: is not a text file.")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")
