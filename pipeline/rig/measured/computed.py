"""Read the attractors of a computed run at a rig's drive frequencies, with their section points, periods and classes of
motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from magpend_core.models import load_model
from magpend_core.models.model import Model, Parameters
from pipeline.layout.vocabulary import ABSENT, APERIODIC, FREQUENCY_DIM, PERIODIC_ORBIT, UNSTABLE, split_dims
from pipeline.results.ragged import dense
from pipeline.results.selection import choose, select_points, start_dims
from pipeline.results.sets import Geometry
from pipeline.runs.derive import AnalysedRun, refused
from pipeline.specification.problems import SpecError

Floats = npt.NDArray[np.float64]


def cube_and_parameters(
    run: AnalysedRun, model: str | Model, at: Mapping[str, float] | None = None
) -> tuple[xr.Dataset, Parameters]:
    """Return a run's cube over the drive frequency, at one value of every other axis, and the parameters there.

    Raise `SpecError` if the run is of another model, sweeps no frequency, or has another axis with several values.
    """
    where = run.name
    model = load_model(model)
    if run.model is not model:
        raise SpecError(
            f"{where}: a run of the model {run.model.name}, while the recordings' mapping says {model.name}: "
            "give a run of that model, or correct model in the mapping."
        )
    cube = run.cube()
    if FREQUENCY_DIM not in cube["status"].dims:
        raise SpecError(
            f"{where}: sweeps no drive frequency, so there is nothing to hold a measured sweep against: run "
            "a specification with axes.frequency_hz."
        )
    with refused(where):
        part = select_points(cube, at)
        long = [d for d in split_dims(part["status"])[0] if d != FREQUENCY_DIM and part.sizes[d] > 1]
        if long:
            axes = ", ".join(f"{d} ({part.sizes[d]} values)" for d in long)
            one = float(part[long[0]].values[part.sizes[long[0]] // 2])
            raise ValueError(f"also sweeps {axes}: choose a value of each, such as --at {long[0]}={one:g}")
    others = [d for d in split_dims(part["status"])[0] if d != FREQUENCY_DIM]
    part = part.isel(dict.fromkeys(others, 0))
    values = {d: float(part[d]) for d in others if d in run.parameters}
    return part, run.parameters.replace(**values)


@dataclass(frozen=True)
class Candidate:
    """Attractor of the model at one frequency, with its section points."""

    attractor: int
    orbit_period: int  # period of the orbit; 0 for a set that does not close
    side: int  # code of the model's classifier
    points: Floats  # (n, state): all points of a closed orbit, or a sample of a set that does not close


@dataclass(frozen=True)
class Computed:
    """Attractors of a run over the drive frequency, at one value of every other swept parameter."""

    # result of the analysis ``attractors``: dims frequency, cells, attractor, in rising frequency
    attractors: xr.Dataset
    cube: xr.Dataset  # cells of the run, for the points of sets that do not close and the diagram
    parameters: Parameters  # parameters at the chosen values of the other axes
    title: str
    digest: str

    @classmethod
    def of(cls, run: AnalysedRun, model: str | Model, at: Mapping[str, float] | None = None) -> Computed:
        """Read a run and its attractors, or compute these; see `cube_and_parameters` for errors."""
        cube, parameters = cube_and_parameters(run, model, at)
        with refused(run.name):
            found = run.derive("attractors")
            keep = (FREQUENCY_DIM, *start_dims(found))
            found = dense(
                choose(found, at, keep, "measured sweeps are compared at one value of the other axes"), points=True
            )
        found = found.isel({FREQUENCY_DIM: np.argsort(found[FREQUENCY_DIM].values)})
        return cls(found, cube, parameters, run.info.title, run.digest)

    @property
    def model(self) -> Model:
        """Model of the run."""
        return self.parameters.model

    @property
    def frequencies(self) -> Floats:
        """Drive frequencies of the run, in rising order [Hz]."""
        return np.asarray(self.attractors[FREQUENCY_DIM].values, np.float64)

    def place(self, frequency_hz: float) -> int:
        """Return the index of the nearest computed frequency; -1 if it lies over half a step outside of their range."""
        f = self.frequencies
        i = int(np.abs(f - frequency_hz).argmin())
        near = np.abs(np.delete(f, i) - f[i])
        reach = 0.51 * float(near.min()) if near.size else 1e-3 * float(f[i])
        return i if abs(f[i] - frequency_hz) <= reach or f[0] < frequency_hz < f[-1] else -1

    def regime(self, place: int, attractor: int) -> tuple[int, int] | None:
        """Return period and class of motion of an attractor at frequency index `place`. The period is 0 if the
        attractor is aperiodic.

        None if the set does not exist there or is unstable, since a rig does not show unstable sets.
        """
        one = self.attractors.isel({FREQUENCY_DIM: place}).sel(attractor=attractor)
        kind = int(one["kind"])
        if kind == ABSENT or int(one["stability"]) == UNSTABLE:
            return None
        period = int(one["orbit_period"]) if kind == PERIODIC_ORBIT else 0
        return period, int(one["side"]) if "side" in one else 0

    def candidates(self, frequency_hz: float, states: Sequence[str]) -> list[Candidate]:
        """Return the model's attractors at a frequency, with their section points. The points hold only the given
        states.

        Points of a closed orbit are interpolated between neighbouring frequencies if the attractor has the
        same period there. Otherwise, and for sets that do not close, they are those at the nearest frequency.
        """
        i = self.place(frequency_hz)
        if i < 0:
            return []
        here = self.attractors.isel({FREQUENCY_DIM: i})
        found = []
        for number in here["attractor"].values:
            regime = self.regime(i, int(number))
            if regime is None:
                continue
            if int(here["kind"].sel(attractor=number)) in APERIODIC:
                points = self._set(i, int(number))
            else:
                points = self._orbit(frequency_hz, i, int(number), regime[0])
            columns = [self.model.state_names.index(s) for s in states]
            found.append(Candidate(int(number), *regime, points[:, columns]))
        return found

    def _points(self, place: int, attractor: int) -> Floats:
        one = self.attractors["attractor_points"].isel({FREQUENCY_DIM: place}).sel(attractor=attractor)
        points = one.transpose("point", "state").values
        return np.asarray(points[np.isfinite(points).all(axis=1)], np.float64)

    def _set(self, place: int, attractor: int) -> Floats:
        """Return the section points of all trajectories on an aperiodic attractor at one frequency."""
        frequency = self.frequencies[place]
        dims = start_dims(self.attractors)
        ids = self.attractors["attractor_id"].isel({FREQUENCY_DIM: place}).transpose(*dims).values
        cells = self.cube["section"].sel({FREQUENCY_DIM: frequency}).transpose(*dims, "period_index", "state").values
        points = cells[ids == attractor].reshape(-1, cells.shape[-1])
        points = points[np.isfinite(points).all(axis=1)]
        return points if len(points) else self._points(place, attractor)

    def _orbit(self, frequency_hz: float, place: int, attractor: int, period: int) -> Floats:
        points, f = self._points(place, attractor), self.frequencies
        other = place + (1 if frequency_hz > f[place] else -1)
        if not 0 <= other < f.size or self.regime(other, attractor) != self.regime(place, attractor):
            return points
        there = self._points(other, attractor)
        if len(there) != len(points):
            return points
        geometry = Geometry.of(self.model)
        turned = [np.roll(there, k, axis=0) for k in range(period)]
        best = min(turned, key=lambda t: float(geometry.distance(t, points).mean()))
        share = (frequency_hz - f[place]) / (f[other] - f[place])
        return np.asarray(points + share * geometry.difference(best, points) * np.array(self.model.scales))
