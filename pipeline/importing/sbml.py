"""Read kinetic models in SBML: species, parameters, reactions, rules and events become equations of concentrations.

Species are concentrations, or amounts where the file says so (``hasOnlySubstanceUnits``); a reaction changes them by
its stoichiometry times its rate, over the size of the compartment (SBML Level 3 Version 2, Section 4.11).
"""

from __future__ import annotations

from collections.abc import Iterable
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from magpend_core.models.text.grammar import Tree
from pipeline.importing.expressions import RefusedError, names_in, replaced
from pipeline.importing.numbers import constant
from pipeline.importing.source import Reset, Source, text_of
from pipeline.specification.problems import import_extra


def read(path: Path) -> Source:
    """Read a file of SBML. What cannot be carried over stands in `Source.problems`.

    Raises
    ------
    SpecError
        If the library that reads SBML is not installed.
    """
    libsbml = import_extra("libsbml", "sbml", str(path))
    source = Source(path, "SBML")
    document = libsbml.readSBMLFromString(text_of(path))
    errors = [document.getError(i) for i in range(document.getNumErrors())]
    for error in errors:
        if error.getSeverity() >= libsbml.LIBSBML_SEV_ERROR:
            source.refuse(error.getLine() or 1, error.getShortMessage() or error.getMessage())
    model = document.getModel()
    if model is None:
        source.refuse(1, "there is no model")
    if source.problems:
        return source
    for i in range(document.getNumPlugins()):
        package = document.getPlugin(i)
        if document.getPackageRequired(package.getPackageName()):
            source.refuse(1, f"the package {package.getPackageName()} of SBML changes the equations")
    _Reader(source, model).read()
    return source


class _Reader:
    """Reader of one model: what it finds goes into the source."""

    def __init__(self, source: Source, model: Any) -> None:
        from pipeline.importing import mathml  # imports libsbml

        self.source, self.model, self.math = source, model, mathml
        self.species = {s.getId(): s for s in model.getListOfSpecies()}
        self.ruled = {rule.getVariable(): rule for rule in model.getListOfRules() if not rule.isAlgebraic()}
        self.initial = {one.getSymbol(): one for one in model.getListOfInitialAssignments()}

    def read(self) -> None:
        """Read all parts of the model in the order in which they need each other."""
        title = self.model.getName() or self.model.getId()
        self.source.head = [title] if title else []
        for function in self.model.getListOfFunctionDefinitions():
            self._try(function, self._function)
        changes = self._changes()
        for parameter in self.model.getListOfParameters():
            self._try(parameter, self._parameter)
        for compartment in self.model.getListOfCompartments():
            self._try(compartment, self._compartment)
        for rule in self.model.getListOfRules():
            self._try(rule, self._rule)
        for name, one in self.species.items():
            self._try(one, lambda s, n=name: self._species(s, changes.get(n, [])))
        self._initial_values()
        for event in self.model.getListOfEvents():
            self._try(event, self._event)
        if self.model.getNumConstraints():
            self.source.notes.append("constraints are left out: they stop a simulation, and change no equation.")

    def _try(self, element: Any, read: Any) -> None:
        try:
            read(element)
        except RefusedError as error:
            self.source.refuse(element.getLine() or 1, str(error))

    def _tree(self, element: Any, what: str) -> Tree:
        if element is None or element.getMath() is None:
            raise RefusedError(f"{what} has no formula")
        return self.math.tree_of(element.getMath())

    def _named(self, element: Any) -> str:
        """Return the name of an element in the source, and note its line, its spelling and what it is."""
        name = self.math.own_name(element.getId())
        self.source.lines[name], self.source.spelling[name] = element.getLine() or 1, element.getId()
        if element.getName() and element.getName() != element.getId():
            self.source.comments[name] = [element.getName()]
        return str(name)

    def _function(self, function: Any) -> None:
        if function.getBody() is None:
            raise RefusedError(f"{function.getId()} has no formula")
        names = (function.getArgument(i).getName() for i in range(function.getNumArguments()))
        arguments = tuple(map(self.math.own_name, names))
        self.source.functions[self._named(function)] = arguments, self.math.tree_of(function.getBody())

    def _parameter(self, parameter: Any) -> None:
        self._value(parameter, parameter.getValue() if parameter.isSetValue() else None)

    def _compartment(self, compartment: Any) -> None:
        name = compartment.getId()
        held = [s for s in self.species.values() if s.getCompartment() == name and not s.getHasOnlySubstanceUnits()]
        if name in self.ruled and held:
            raise RefusedError(f"the compartment {name} changes its size, and holds concentrations")
        self._value(compartment, compartment.getSize() if compartment.isSetSize() else 1.0)

    def _value(self, element: Any, value: float | None) -> None:
        """Add a parameter with its value, unless a rule or an initial assignment gives it."""
        name = self._named(element)
        if element.getId() in self.ruled:
            self.source.starts[name] = value or 0.0
            return
        if element.getId() in self.initial:
            return
        if value is None or value != value:
            raise RefusedError(f"{element.getId()} has no value")
        self.source.parameters[name] = float(value)

    def _rule(self, rule: Any) -> None:
        if rule.isAlgebraic():
            raise RefusedError("an algebraic rule defines a quantity by an equation; solve it for the quantity")
        name = self.math.own_name(rule.getVariable())
        tree = self._tree(rule, f"the rule of {rule.getVariable()}")
        if rule.isRate():
            self.source.states[name] = tree
            self.source.starts.setdefault(name, 0.0)
        else:
            self.source.parts[name] = tree
        self.source.lines.setdefault(name, rule.getLine() or 1)

    def _changes(self) -> dict[str, list[Tree]]:
        """Make each reaction a part; return the terms by which reactions change the amount of each species."""
        changes: dict[str, list[Tree]] = {}
        for reaction in self.model.getListOfReactions():
            self._try(reaction, lambda one: self._reaction(one, changes))
        return changes

    def _reaction(self, reaction: Any, changes: dict[str, list[Tree]]) -> None:
        name, law = self._named(reaction), reaction.getKineticLaw()
        if reaction.isSetFast() and reaction.getFast():
            raise RefusedError(f"the reaction {reaction.getId()} is fast: its balance is an algebraic equation")
        if law is None:
            raise RefusedError(f"the reaction {reaction.getId()} has no kinetic law")
        own: dict[str, Tree] = {}
        for local in [*law.getListOfParameters(), *law.getListOfLocalParameters()]:
            inner = f"{name}_{local.getId()}"
            while inner in self.source.lines:
                inner += "_"
            self.source.lines[inner] = local.getLine() or 1
            if not local.isSetValue():
                raise RefusedError(f"{local.getId()} of the reaction {reaction.getId()} has no value")
            self.source.parameters[inner] = float(local.getValue())
            own[self.math.own_name(local.getId())] = Tree("name", 1, inner)
        self.source.parts[name] = replaced(self._tree(law, f"the reaction {reaction.getId()}"), own)
        for sign, references in ((-1.0, reaction.getListOfReactants()), (1.0, reaction.getListOfProducts())):
            for reference in references:
                changes.setdefault(reference.getSpecies(), []).append(self._term(name, sign * _count(reference, self)))

    def _term(self, reaction: str, count: float) -> Tree:
        rate = Tree("name", 1, reaction)
        size = rate if abs(count) == 1.0 else Tree("product", 1, "", (Tree("number", 1, abs(count)), rate))
        return size if count > 0.0 else Tree("negative", 1, "", (size,))

    def _species(self, species: Any, terms: list[Tree]) -> None:
        name, given = self._named(species), species.getId()
        compartment = self.math.own_name(species.getCompartment())
        of_amount = species.getHasOnlySubstanceUnits()
        if species.isSetConversionFactor() or self.model.isSetConversionFactor():
            raise RefusedError(f"the conversion factor of {given} has no place in a model as text")
        start = self._start(species, of_amount)
        if given in self.ruled:
            if start is not None and name in self.source.states:
                self.source.starts[name] = start
            return
        if start is None and given not in self.initial:
            self.source.notes.append(f"{given} has no initial value: 0 is taken.")
        if species.getBoundaryCondition() or species.getConstant() or not terms:
            if given not in self.initial:
                self.source.parameters[name] = start or 0.0
            return
        change = terms[0] if len(terms) == 1 else Tree("sum", 1, "", tuple(terms))
        if not of_amount:
            change = Tree("product", 1, "", (change, Tree("inverse", 1, "", (Tree("name", 1, compartment),))))
        self.source.states[name] = change
        self.source.starts[name] = start or 0.0

    def _start(self, species: Any, of_amount: bool) -> float | None:
        """Return the initial value in the unit in which formulas have the species."""
        size = self.source.parameters.get(self.math.own_name(species.getCompartment()), 0.0)
        given_amount = species.isSetInitialAmount()
        if not given_amount and not species.isSetInitialConcentration():
            return None
        value = float(species.getInitialAmount() if given_amount else species.getInitialConcentration())
        if given_amount == of_amount:
            return value
        if size == 0.0:
            raise RefusedError(f"the initial value of {species.getId()} needs the size of its compartment")
        return value * size if of_amount else value / size

    def _initial_values(self) -> None:
        """Give initial assignments to states, and make those of constants parts, which follow their parameters."""
        left, n_left = dict(self.initial), len(self.initial) + 1
        reasons: dict[str, str] = {}
        while len(left) < n_left:  # each may need others
            n_left = len(left)
            for symbol, one in list(left.items()):
                try:
                    self._assign(self.math.own_name(symbol), self._tree(one, "it"))
                    del left[symbol]
                except RefusedError as error:
                    reasons[symbol] = str(error)
        for symbol, one in left.items():
            self.source.refuse(one.getLine() or 1, f"the initial assignment of {symbol}: {reasons[symbol]}")

    def _assign(self, name: str, tree: Tree) -> None:
        source = self.source
        if name in source.states:
            source.starts[name] = constant(source, tree, {"t": 0.0, **source.starts})
        elif names_in(tree) <= {*source.parameters, *source.parts}:
            source.parts[name] = tree
        else:
            source.parameters[name] = constant(source, tree, {"t": 0.0, **source.starts})

    def _event(self, event: Any) -> None:
        name = event.getId() or event.getName() or "an event"
        if event.getDelay() is not None:
            raise RefusedError(f"{name} has a delay; impacts act at once")
        condition = self._tree(event.getTrigger(), f"the trigger of {name}")
        if condition.kind != "compare":
            raise RefusedError(f"the trigger of {name} must be one comparison, such as x > 1")
        rising = condition.value in (">", ">=")
        of = Tree("sum", 1, "", (condition.args[0], Tree("negative", 1, "", (condition.args[1],))))
        sets = {}
        for one in event.getListOfEventAssignments():
            sets[self.math.own_name(one.getVariable())] = self._tree(one, f"an assignment of {name}")
        for target in sets:
            if target in self.source.parts:
                raise RefusedError(f"{name} sets {self.source.spelled(target)}, which a formula gives")
        ordered = {target: sets[target] for target in _order(sets, name)}
        self.source.resets.append(Reset(of, 1 if rising else -1, ordered, event.getLine() or 1))


def _count(reference: Any, reader: _Reader) -> float:
    """Return the stoichiometry of a species in a reaction."""
    name = reference.getId()
    if reference.isSetStoichiometryMath() or name in reader.ruled or name in reader.initial:
        raise RefusedError(f"the stoichiometry of {reference.getSpecies()} is a formula")
    if reader.model.getLevel() > 2 and not reference.isSetStoichiometry():
        raise RefusedError(f"the stoichiometry of {reference.getSpecies()} is not given")
    return float(reference.getStoichiometry())


def _order(sets: dict[str, Tree], name: str) -> Iterable[str]:
    """Return an order in which each assignment of an event still finds the values before the event."""
    before = {target: {n for n, tree in sets.items() if target in names_in(tree) and n != target} for target in sets}
    try:
        return list(TopologicalSorter(before).static_order())
    except CycleError:
        raise RefusedError(f"the assignments of {name} exchange values") from None
