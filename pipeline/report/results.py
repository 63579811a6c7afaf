"""Compute the results of a study, each once: runs, simulated recordings, and fits of torque readings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.layout.writing import write_atomically
from pipeline.report.study import Study
from pipeline.runs.derive import AnalysedRun
from pipeline.runs.run import run
from pipeline.specification.files import find_spec
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec

if TYPE_CHECKING:
    import xarray as xr

    from pipeline.rig.simulation import Rig

Echo = Callable[[str], None]


class Results:
    """Results of a study in a folder; each is computed when it is first needed.

    Runs lie in ``runs/`` and are completed, not repeated. Recordings and fits take seconds and are computed
    again, with the same numbers.

    Parameters
    ----------
    study
        Study to compute.
    folder
        Folder of the results, which is made if necessary.
    smoke
        Whether to use the small sizes of the specifications.
    workers
        See `pipeline.runs.run.run`.
    echo
        Function that prints a line.
    """

    def __init__(self, study: Study, folder: Path, *, smoke: bool, workers: int | None, echo: Echo) -> None:
        self.study, self.folder, self.smoke = study, folder, smoke
        self._workers, self._echo = workers, echo
        self._runs: dict[str, AnalysedRun] = {}
        self._recordings: dict[str, xr.Dataset] = {}
        self._torques: dict[str, Any] = {}

    def prepare(self, names: set[str]) -> None:
        """Check the inputs of the results that are needed, then compute the runs among them.

        Raises
        ------
        SpecError
            If specifications, rigs or headers are wrong; before anything is computed, with all problems.
        """
        self._check(names)
        for name in self.study.table.runs:
            if name in names:
                self.run(name)

    def _check(self, names: set[str]) -> None:
        """Read all needed specifications and headers; raise a SpecError that lists all problems."""
        table, problems = self.study.table, []
        checks: list[tuple[str, Callable[[str], Any]]] = [
            *((name, lambda name: Spec.read(self.spec(name), smoke=self.smoke)) for name in table.runs),
            *((name, self.rig) for name in table.recordings),
            *((name, self._measurement) for name in table.torques),
        ]
        for name, check in checks:
            if name in names:
                try:
                    check(name)
                except SpecError as error:
                    problems += [f"{name}: {problem}" for problem in error.problems]
        if problems:
            raise SpecError(problems)

    def spec(self, name: str) -> Path:
        """Return the path of the specification of one of the study's runs."""
        given = self.study.table.runs[name].spec
        return self.study.file(given) if given.endswith(".toml") else find_spec(given)

    def _measurement(self, name: str) -> Any:
        from pipeline.report.torque_curves import measured

        return measured(self.study.table.torques[name].header, self.study.path.parent)

    def run(self, name: str) -> AnalysedRun:
        """Compute the missing cells of one of the study's runs, and return the run."""
        if name not in self._runs:
            place = self.folder / "runs" / name
            place.parent.mkdir(parents=True, exist_ok=True)
            self._echo(f"{name}: {self.spec(name).name}")
            run(self.spec(name), place, workers=self._workers, smoke=self.smoke, echo=self._echo)
            self._runs[name] = AnalysedRun.of(place, self._echo)
        return self._runs[name]

    def computed(self) -> dict[str, AnalysedRun]:
        """Return the runs of the study that are computed so far, by name."""
        return dict(self._runs)

    def rig(self, name: str) -> Rig:
        """Return the simulated test rig that makes a recording of the study."""
        from pipeline.rig.simulation import load_rig

        return load_rig(self.study.file(self.study.table.recordings[name].rig))

    def recording(self, name: str) -> xr.Dataset:
        """Return a recording of a simulated test rig by name; it is computed at the first call."""
        if name not in self._recordings:
            from pipeline.rig.recordings import read_recording
            from pipeline.rig.recordings.writing import write_raw
            from pipeline.rig.simulation import simulated

            self._echo(f"{name}: recording of a virtual rig")
            raw, mapping = simulated(self.rig(name), is_csv=True)
            place = self.folder / "recordings" / f"{name}.csv"
            place.parent.mkdir(parents=True, exist_ok=True)
            write_raw(raw, place)
            write_atomically(place.with_suffix(".toml"), mapping.toml())
            self._recordings[name] = read_recording(place, mapping)
        return self._recordings[name]

    def series(self, name: str, n_periods: int) -> xr.Dataset:
        """Return a recording's time series, and that of the model integrated from the same state."""
        from pipeline.rig.measured.series import series_of

        return series_of(self.recording(name), self.rig(name).parameters, n_periods=n_periods)

    def torques(self, name: str) -> Any:
        """Return a fit of the study's torque readings by name; it is computed at the first call."""
        if name not in self._torques:
            from pipeline.report.torque_curves import fitted

            self._echo(f"{name}: fit of torque readings")
            self._torques[name] = fitted(self._measurement(name))
        return self._torques[name]
