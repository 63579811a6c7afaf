"""Tell which analyses and figures suit a run, by its clock and its kind of motion, and what to do about the others."""

from __future__ import annotations

from pipeline.motion.steady import Steady
from pipeline.products.product import Analysis, Figure
from pipeline.products.registry import ANALYSES, FIGURES

NEEDS = {
    "drifting": "whose parameters move; add a table [drift.NAME] to its specification",
    "noisy": "with noise; add a table [noise] to its specification",
}
"""What a run at constant parameters lacks for each other kind of motion."""


def unsuited(motion: Steady, product: Analysis | Figure) -> str:
    """Return the sentences that refuse an analysis or a figure of a run with some motion; empty if it suits."""
    model = motion.model
    if product.follows_motion and not model.clock.is_continuous:
        return (
            f"{product.name} follows the motion between section points, and {model.name} is a map, of iterates alone; "
            "draw its section."
        )
    if motion.kind in product.motions:
        return ""
    if not motion.obstacle:
        return f"{product.name} needs a run {NEEDS[product.motions[0]]}."
    own = [f"analyse {name}" for name, other in ANALYSES.items() if motion.kind in other.motions]
    commands = ", ".join([*own, f"plot {overview(motion, is_swept=True)}", "plot section"])
    return f"{motion.refusal(product.name)} Of this run: magpend {commands}."


def overview(motion: Steady, *, is_swept: bool) -> str:
    """Return the figure that gives the best overview of cells that cannot be integrated further: one for their kind of
    motion alone, else of their sections. Empty if they can: it then depends on the run's results.
    """
    if not motion.obstacle:
        return ""
    own = [name for name, figure in FIGURES.items() if figure.motions == (motion.kind,)]
    return own[0] if own else "bifurcation" if is_swept else "section"
