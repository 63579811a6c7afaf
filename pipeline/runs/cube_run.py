"""Draw figures of a cube that is in memory, or of a part of one, without its run directory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NoReturn

from pipeline.layout.vocabulary import model_of
from pipeline.products.product import FigureOptions
from pipeline.products.registry import FIGURES
from pipeline.runs.derive import AnalysedRun, Echo
from pipeline.runs.naming import named
from pipeline.specification.problems import SpecError

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Model

_REMEDY = "Analyses are of whole runs: open the run with magpend.Run.open(DIR), and use run.plot."


@dataclass(frozen=True)
class CubeRun:
    """A cube in the place of a run, for figures that use nothing but cells.

    Attributes
    ----------
    ds : Dataset
        A cube from `pipeline.open_run`, or a part of it.
    echo : callable
        Function that prints a line.
    """

    ds: xr.Dataset
    echo: Echo

    digest = ""
    name = "the cube"

    @property
    def info(self) -> Any:
        """Return what the cube's attributes tell of its run."""
        attrs = self.ds.attrs
        provenance = {key: attrs[key] for key in ("created", "host", "git_commit") if key in attrs}
        return SimpleNamespace(
            title=attrs.get("title", ""), digest=attrs.get("digest", ""), versions={}, provenance=provenance
        )

    @property
    def model(self) -> Model:
        """Model that was integrated."""
        return model_of(self.ds)

    def of(self, source: str) -> AnalysedRun:
        """Open another run by its directory."""
        return AnalysedRun.of(source)

    def cube(self, chunks: Any = None) -> xr.Dataset:
        """Return the cube."""
        return self.ds

    def derive(self, name: str, **options: Any) -> NoReturn:
        """Raise ValueError: an analysis needs the whole run."""
        raise ValueError(f"this figure needs the analysis {name}. {_REMEDY}")


def ready_cube(
    ds: xr.Dataset, name: str, options: FigureOptions, echo: Callable[[str], None] | None
) -> tuple[CubeRun, FigureOptions]:
    """Return a cube to draw a figure of, with the figure's completed options.

    Raises
    ------
    SpecError
        If the figure needs an analysis, or an option names what the cube does not have.
    """
    run: Any = CubeRun(ds, echo or _silent)
    options_of_analyses = {"parameter", "second"} & type(options).model_fields.keys()
    if FIGURES[name].needs or options_of_analyses:
        raise SpecError(f"the cube: {name} needs an analysis. {_REMEDY}")
    completed: Any = named(run, options)
    return run, completed


def _silent(_: str) -> None:
    pass
