"""Define the class of the models that are given as text."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from magpend_core.expressions.graph import GraphError
from magpend_core.models.model import Model, ModelError
from magpend_core.models.text.circles import angle_remark, undeclared_angles
from magpend_core.models.text.definition import Definition
from magpend_core.models.text.derive import Derived, derive
from magpend_core.models.text.generate import Source, source_of
from magpend_core.models.text.scene import classifier_of, drawing_of
from magpend_core.versions import IMPACTS, TEXT, written

if TYPE_CHECKING:
    from magpend_core.engine.system import System


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class TextModel(Model):
    """A model given as text; its system for the engine is derived when it is first needed.

    Attributes
    ----------
    shipped : bool
        Whether `load_model` finds it by name.
    """

    definition: Definition
    shipped: bool = False

    def __repr__(self) -> str:
        parts = [f"  {name} = {right}" for name, right in self.definition.table.get("define", {}).items()]
        rates = [f"  {name}' = {right}" for name, right in self.definition.table["equations"].items()]
        return "\n".join([super().__repr__(), *rates, *parts])

    @property
    def reference(self) -> str | Mapping[str, Any]:
        """Return the model's name if it ships, else its text."""
        return self.name if self.shipped else self.definition.table

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """Warnings about parameters and definitions that no expression uses, and about undeclared angles."""
        return (*self.definition.remarks(), *self.angle_remarks)

    @cached_property
    def angle_remarks(self) -> tuple[str, ...]:
        """Warnings about states that are angles but not declared as such."""
        return tuple(map(angle_remark, undeclared_angles(self.definition)))

    @cached_property
    def derived(self) -> Derived:
        """Expressions derived from the text: rates, Jacobian, boundary layers, edges, switches. Needs no compiler.

        Raises
        ------
        ModelError
            If there is too much of something.
        """
        try:
            return derive(self.definition)
        except GraphError as error:
            raise ModelError([f"model: {error}; simplify them, or write the model in Python."]) from None

    @cached_property
    def source(self) -> Source:
        """Generated source code of the engine's functions."""
        return source_of(self.derived)

    @cached_property
    def digest(self) -> str:
        """Digest of a text model: of its equations in normal form, and of the code that translates them for the
        engine.
        """
        # the source, too: what is found at the default parameters, edges say, is in it
        numbers = [written("text", TEXT)] + [f"impacts {IMPACTS}"] * bool(self.definition.impacts)
        parts = (*numbers, self.definition.meaning(), self.source.text)
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]

    @cached_property
    def system(self) -> System:
        """Return the system that the engine integrates; imports the compiler."""
        from magpend_core.models.text.compiled import system_of

        return replace(system_of(self.definition, self.derived, self.source), method=self.method)


def model_of(definition: Definition, shipped: bool = False) -> TextModel:
    """Make a model from the validated definition of a model's text."""
    return TextModel(
        name=definition.name,
        title=definition.title or definition.name,
        states=definition.states,
        parameters=definition.parameters,
        presets=definition.presets,
        system_path="",
        section=definition.section or definition.clock.instant,
        quantities=definition.described,
        classifier=classifier_of(definition),
        mirror=definition.mirror,
        drawing=drawing_of(definition),
        clock=definition.clock,
        text=None if shipped else definition.table,
        definition=definition,
        shipped=shipped,
    )
