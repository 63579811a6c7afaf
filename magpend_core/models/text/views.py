"""Read the optional tables of a model given as text: drawing, mirror symmetry, classes of motion, presets."""

from __future__ import annotations

from typing import Any

from magpend_core.models.model import Mirror, Preset
from magpend_core.models.parameters import Parameter, near_names
from magpend_core.models.text.definition import ClassifierText, DrawingText, needed
from magpend_core.models.text.grammar import BUILT_IN, TIMED, Tree
from magpend_core.models.text.keys import Line, flat
from magpend_core.models.text.tables import Reader, shown
from magpend_core.sizes import MOST_STATES

MAX_PARAMETERS, MAX_OTHERS = 120, 60
BUILT_IN_NAME = "built-in name"
"""Meaning of the names of `BUILT_IN`."""
DEFAULT_PRESET = "default"
"""Name of the preset with the values that stand in the table of parameters."""


class ViewsReader(Reader):
    """Reader of the optional tables; `place` is their key path, `known` maps each defined name to its kind, and `lines`
    the names of definitions, functions and states to their lines.
    """

    def __init__(self, place: str) -> None:
        super().__init__()
        self.place = place
        self.known: dict[str, str] = dict.fromkeys(BUILT_IN, BUILT_IN_NAME)
        self.lines: dict[str, Line] = {}

    def at(self, *keys: str) -> str:
        """Return the full path of a key within the model's tables, for messages."""
        return ".".join((self.place, *(k[:60] for k in keys)))

    def _timeless(self, tree: Tree | None, place: str, define: dict[str, Tree], only: set[str] | None = None) -> bool:
        """Return whether an expression is free of time and, if `only` is given, of all states not in `only`; report
        offenders.
        """
        if tree is None:
            return False
        wanted = list(needed(tree, define))
        for name in wanted:
            if name in TIMED and self.known.get(name) == BUILT_IN_NAME:
                self.report(place, f"needs {name!r}, which is not known here; use states and parameters.")
                return False
            if only is not None and self.known.get(name) == "state" and name not in only:
                self.report(place, f"needs the state {name!r}; a fixed point knows parameters alone.")
                return False
        return True

    def _places(
        self, given: Any, place: str, define: dict[str, Tree], only: set[str] | None
    ) -> dict[str, tuple[Tree, Tree]]:
        found = {}
        for name, value in self.table(given, place, MAX_OTHERS, "points").items():
            own = f"{place}.{name[:60]}"
            if not isinstance(value, (list, tuple)) or len(value) != 2:
                self.report(own, 'must be two expressions, such as ["l*sin(th)", "-l*cos(th)"].')
                continue
            trees = [self.expression(v, own, self.known) for v in value]
            if all([self._timeless(tree, own, define, only) for tree in trees]):
                found[name] = (trees[0], trees[1])
        return found  # type: ignore[return-value]

    def _drawing(self, given: Any, define: dict[str, Tree]) -> DrawingText | None:
        if given is None:
            return None
        place = self.at("drawing")
        table = self.table(given, place, 10, "keys")
        self.keys(table, place, ("points", "fixed", "lines", "trace", "unit"))
        points = self._places(table.get("points", {}), f"{place}.points", define, None)
        fixed = self._places(table.get("fixed", {}), f"{place}.fixed", define, set())
        for name in fixed:
            if name in points:
                self.report(f"{place}.fixed.{name}", "is one of the moving points, too; keep one of the two.")
        known = (*points, *fixed)
        lines = table.get("lines", [])
        good = isinstance(lines, (list, tuple)) and all(
            isinstance(line, (list, tuple)) and all(isinstance(n, str) for n in line) for line in lines
        )
        if not good:
            self.report(f"{place}.lines", 'must be a list of lists of points, such as [["pivot", "bob"]].')
            lines = []
        for name in dict.fromkeys(n for line in lines for n in line if n not in known):
            self.report(f"{place}.lines", f"{shown(name)} is no point; {near_names(name[:60], known, 'points')}")
        trace = self.text(table, "trace", place, next(iter(points), ""))
        if trace not in points:
            self.report(
                f"{place}.trace", f"{shown(trace)} is no moving point; {near_names(trace[:60], points, 'points')}"
            )
        unit = self.text(table, "unit", place, "m")
        return DrawingText(points, fixed, tuple(tuple(line) for line in lines), trace, unit)

    def _mirror(self, given: Any, states: tuple[str, ...]) -> Mirror | None:
        if given is None:
            return None
        place = self.at("mirror")
        table = self.table(given, place, 10, "keys")
        self.keys(table, place, ("signs", "half_period"))
        signs = flat(self.table(table.get("signs", {}), f"{place}.signs", MOST_STATES, "states"))
        for name, sign in signs.items():
            if name not in states:
                self.report(
                    f"{place}.signs.{name[:60]}", f"there is no such state; {near_names(name, states, 'states')}"
                )
            elif isinstance(sign, bool) or sign not in (1, -1):
                self.report(f"{place}.signs.{name}", f"{shown(sign)} must be 1 or -1.")
        if self.problems:
            return None
        return Mirror(tuple(int(signs.get(n, 1)) for n in states), self.flag(table, "half_period", place))

    def _classifier(self, given: Any, define: dict[str, Tree]) -> ClassifierText | None:
        if given is None:
            return None
        place = self.at("classifier")
        table = self.table(given, place, 10, "keys")
        self.keys(table, place, ("meaning", "words"))
        words = {}
        for name, value in self.table(table.get("words", {}), f"{place}.words", 20, "words").items():
            own = f"{place}.words.{name[:60]}"
            if name == "unknown":
                self.report(own, "stands for sections of which nothing is known; choose another word.")
            tree = self.condition(value, own, self.known)
            if tree is not None and self._timeless(tree, own, define):
                words[name] = tree
        return ClassifierText(self.text(table, "meaning", place) or "kind of motion", words)

    def _presets(
        self, given: Any, parameters: tuple[Parameter, ...], values: dict[str, float], source: str
    ) -> tuple[Preset, ...]:
        origin = source or "the text of the model"
        found = [Preset(DEFAULT_PRESET, values, dict.fromkeys(values, origin))]
        own = {p.name: p for p in parameters}
        for name, entry in self.table(given, self.at("presets"), MAX_OTHERS, "presets").items():
            place = self.at("presets", name)
            table = self.table(entry, place, MAX_PARAMETERS + 1, "values")
            phrase = self.text(table, "source", place) or origin
            changed = {key: value for key, value in table.items() if key != "source"}
            for key, value in changed.items():
                problem = own[key].problem(value) if key in own else None
                if key not in own:
                    problem = f"is no parameter; {near_names(key[:60], own, 'parameters')}"
                if problem is not None:
                    self.report(f"{place}.{key[:60]}", problem)
            if not self.problems:
                numbers = {key: float(value) for key, value in changed.items()}
                provenance = {**dict.fromkeys(values, origin), **dict.fromkeys(numbers, phrase)}
                found.append(Preset(name, {**values, **numbers}, provenance))
        names_given = [p.name for p in found]
        if len(set(names_given)) < len(names_given):
            self.report(self.at("presets", DEFAULT_PRESET), "is that of the table of parameters; choose another name.")
        return tuple(found)
