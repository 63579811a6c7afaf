"""Keep in a run the options with which its attractors and its branches were last found.

Other analyses and all figures rest on these attractors and branches. The file is ``derived/chosen.json``.
"""

from __future__ import annotations

import contextlib
import json

from pydantic import Field

from pipeline.analysis.attractors.declaration import AttractorOptions
from pipeline.analysis.branches.declaration import BranchOptions
from pipeline.products.product import Options, as_flags
from pipeline.runs.naming import options_in_own_words
from pipeline.store.errors import DamagedError
from pipeline.store.files import DERIVED
from pipeline.store.run import RunDirectory

FILE = f"{DERIVED}/chosen.json"


class Choices(Options):
    """Options of a run's attractors, and of its branches along each parameter: those last given."""

    attractors: AttractorOptions = AttractorOptions()
    branches: dict[str, BranchOptions] = Field(default_factory=dict)

    @classmethod
    def of(cls, run: RunDirectory) -> Choices:
        """Read the choices of a run; raise DamagedError if they cannot be read."""
        try:
            return cls.model_validate_json(run.info.files.read(FILE))
        except FileNotFoundError:
            return cls()
        except ValueError:
            raise DamagedError(f"{run.name}: {FILE} is damaged; remove it.") from None

    def along(self, parameter: str) -> BranchOptions:
        """Return the options of the branches along a parameter: those last given, or the defaults."""
        return self.branches.get(parameter, BranchOptions(parameter=parameter))

    def having(self, options: Options) -> Choices:
        """Return the choices with other options of attractors, or of the branches along a parameter."""
        if isinstance(options, BranchOptions):
            return self.model_copy(update={"branches": {**self.branches, options.parameter: options}})
        return self.model_copy(update={"attractors": options})

    def keep(self, run: RunDirectory) -> None:
        """Write the choices to a run; a folder that is read alone keeps its own."""
        with contextlib.suppress(OSError):
            run.info.files.write(FILE, json.dumps(self.plain()).encode())


def is_choice(options: Options) -> bool:
    """Return whether these are options of attractors or branches, and some are given: they then hold for the run."""
    return type(options) in (AttractorOptions, BranchOptions) and bool(options.model_fields_set - {"parameter"})


def chosen_options(run: RunDirectory, options: Options) -> Options:
    """Return options of an analysis, and those of the run if they are of attractors or branches and none is given."""
    if is_choice(options):
        return options
    if type(options) is BranchOptions:
        return Choices.of(run).along(options.parameter)
    return Choices.of(run).attractors if type(options) is AttractorOptions else options


def changed_branches(run: RunDirectory, parameter: str | None) -> str:
    """Return as JSON the options that differ from the defaults, of the run's branches along one parameter, or all."""
    found = {
        name: {key: value for key, value in options.changed().items() if key != "parameter"}
        for name, options in Choices.of(run).branches.items()
        if parameter in (None, name)
    }
    return json.dumps({name: changed for name, changed in found.items() if changed}, sort_keys=True)


def branches_in_words(changed: str, word: str) -> list[str]:
    """Return a text line on each set of branches from `changed_branches`, with the drive's rate in a word for it."""
    lines = []
    for parameter, given in json.loads(changed).items():
        options = BranchOptions.model_validate_json(json.dumps({**given, "parameter": parameter}))
        told = options_in_own_words(options, word).changed()
        name = told.pop("parameter")
        lines.append(f"branches along {name}, found with {' '.join(as_flags(BranchOptions, told))}")
    return lines
