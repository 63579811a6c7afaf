"""Define the status codes of a computed trajectory, each with a sentence that explains it."""

from __future__ import annotations

from enum import IntEnum

from magpend_core.troubleshooting import see


class Status(IntEnum):
    """Outcome of one trajectory (one parameter set and initial condition), as a code."""

    PENDING = 0
    PERIODIC = 1
    BOUNDED = 2
    DIVERGED = 3
    STEP_LIMIT = 4
    STEP_UNDERFLOW = 5
    UNREACHED = 6
    INFERRED = 7
    NO_RETURN = 8
    CHATTER = 9

    @property
    def sentence(self) -> str:
        """Return the code's meaning and, for a failure, the remedy."""
        return _SENTENCES[self]

    @property
    def advice(self) -> str:
        """Return the sentence, and for all but known orbits the section of the page of troubleshooting."""
        if self in (Status.PERIODIC, Status.INFERRED):
            return self.sentence
        return f"{self.sentence} {see(self.name.lower().replace('_', '-'))}"

    def advice_for(self, method: str) -> str:
        """Return the advice to a run by a method, which that on the step limit names."""
        if self != Status.STEP_LIMIT:
            return self.advice
        words = self.advice if method != "rodas5p" else self.advice.replace(_IF_STIFF, "")
        return words.replace("more steps than", f"more steps of {method} than")


_IF_STIFF = 'if the equations are stiff, set method = "rodas5p"; else '

_SENTENCES = {
    Status.PENDING: "not computed yet; run the same command again to complete it",
    Status.PERIODIC: "the kept sections close on themselves: an orbit of period orbit_period",
    Status.BOUNDED: "bounded, and not closed within the periods integrated and the longest period looked "
    "for: chaotic, quasi-periodic, or still on the way to an orbit",
    Status.DIVERGED: "a state left the bounds of the system or is not a number",
    Status.STEP_LIMIT: f"one period needed more steps than max_steps_per_period; {_IF_STIFF}raise it, or loosen rtol; "
    "neither helps where impacts or switches follow one another without end: change these",
    Status.STEP_UNDERFLOW: "the step size fell below the resolution of time; loosen rtol and atol",
    Status.UNREACHED: "the branch ended at an earlier point of its path, so this point was not computed",
    Status.INFERRED: "not integrated: in a refined grid all integrated cells around it closed on one orbit, "
    "and it carries the section, orbit_period and turns of one of them",
    Status.NO_RETURN: "the trajectory did not come back to the section within the longest time waited for; "
    "it may rest at an equilibrium; raise section.longest, or move the section",
    Status.CHATTER: "impacts follow one another ever faster, infinitely many within a finite time; write "
    "stick = true in [[model.impacts]] to let the state rest on the surface from then on (on one at a time)",
}
