"""Define a method of a run for every analysis.

Generated from the options of `pipeline.products` by ``python -m pipeline.cli.reference``; do not edit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Literal

from magpend._bases import AnalysingRun

if TYPE_CHECKING:
    import xarray as xr

AnalysisName = Literal[
    "attractors",
    "basins",
    "hysteresis",
    "settling",
    "chaos",
    "dimension",
    "branches",
    "bands",
    "curves",
    "orbits",
    "tongues",
    "manifolds",
    "tangency",
    "tipping",
    "delay",
    "overlaps",
    "resilience",
    "edge",
    "escapes",
    "density",
]
"""Names of the analyses."""


class Analyses(AnalysingRun):
    """An opened run with a method for every analysis."""

    def attractors(
        self,
        *,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Find the attractors at every parameter point, show that they attract, and follow them along the axes.

        Cells on no known orbit are integrated further, at most as long as in the run itself. Basin fractions are
        fractions of the cells that end on attractors, with 95 % intervals.

        Parameters
        ----------
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("attractors", locals())

    def basins(
        self,
        *,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        interval: Literal["wilson", "clopper-pearson"] = "wilson",
        confidence: float = 0.95,
        box: int = 5,
        block: int = 1,
        scaling: Literal["perturbation", "boxes", "entropy"] = "perturbation",
        radius: int = 1,
        metric: Literal["taxicab", "chessboard"] = "taxicab",
        resamples: int = 200,
        seed: int = 0,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Measure the basins of a sweep: fractions with intervals, entropy, uncertainty exponent, Wada test.

        The last three need starts on a grid.

        Parameters
        ----------
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        interval
            Confidence interval of the fractions.
        confidence
            Level of all intervals (above 0, below 1).
        box
            Basin entropy: side of the boxes [cells] (2 or more).
        block
            Basin entropy: side of the bootstrap's blocks, in boxes (1 or more).
        scaling
            Uncertainty exponent: scaling that is fitted.
        radius
            Wada test: radius of the fattened boundary [cells] (1 or more).
        metric
            Wada test: distance between cells.
        resamples
            Samples of each bootstrap (2 or more).
        seed
            Seed of the bootstraps (0 or more).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("basins", locals())

    def hysteresis(
        self,
        *,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """List where a continuation follows different attractors upwards and downwards, and where it jumps.

        Parameters
        ----------
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("hysteresis", locals())

    def settling(
        self,
        *,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """List each set that does not close: whether its cells stay or leave, and where they go.

        With `budget` a larger sample is integrated for longer; the result then counts for all analyses of the run.
        Transient lifetimes are in drive periods or returns.

        Parameters
        ----------
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("settling", locals())

    def chaos(
        self,
        *,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        n_sigma: float = 3.0,
        least: float = 0.005,
        n_frequencies: int = 100,
        stride: int = 1,
        seed: int = 0,
        n_max: int = 2000,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Tell regular from chaotic attractors: exponents, multipliers, dimensions, 0-1 test.

        Exponents of orbits follow from their multipliers. Exponents of other sets need [products] lyapunov in the run's
        specification. The 0-1 test needs 200 sections.

        Parameters
        ----------
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        n_sigma
            Number of standard errors by which an exponent must differ from 0 (above 0).
        least
            Least modulus of an exponent that counts as nonzero [1/s] (0 or more).
        n_frequencies
            0-1 test: number of frequencies (10 or more).
        stride
            0-1 test: step between the sections that are used (1 or more).
        seed
            0-1 test: seed of the frequencies (0 or more).
        n_max
            Most section points for the correlation dimension; 0 computes none (0 or more).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("chaos", locals())

    def dimension(
        self,
        *,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        at: Mapping[str, float] = {},
        theiler: int = 1,
        n_max: int = 10000,
        floor: float = 1e-06,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Measure the correlation dimension of each set that attracts and does not close.

        A sample of each set is integrated further first, as in `settling`, since transients and motions that are still
        closing have no dimension. This takes seconds per parameter point. Two digits need thousands of sections.

        Parameters
        ----------
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        at
            Value of a swept parameter; by default all values.
        theiler
            Theiler window: pairs of sections at most so far apart in time are left out (0 or more).
        n_max
            Most section points of an attractor (100 or more).
        floor
            Smallest resolved distance, in units of the states' scales (above 0).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("dimension", locals())

    def branches(
        self,
        *,
        parameter: str = "",
        low: float | None = None,
        high: float | None = None,
        max_period: int = 0,
        generations: int = 3,
        recurrences: int = 0,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Follow periodic orbits and equilibria along a parameter, stable or not; locate and name their bifurcations.

        Starts from the closed orbits and equilibria on which cells of the run end. Those left out are listed, with the
        option that includes them.

        Parameters
        ----------
        parameter
            Continuation parameter: a parameter, or frequency_hz; by default the swept one.
        low
            Least value; by default the run's [SI].
        high
            Largest value; by default the run's [SI].
        max_period
            Longest orbit period of a branch; 0 follows all orbits that attract cells, and doublings up to the longest
            of them, at least up to 4 [drive periods or returns] (0 or more).
        generations
            Number of generations of bifurcating branches that are followed (0 or more).
        recurrences
            Also start from orbits up to this period, near close recurrences of bounded cells (0 or more).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("branches", locals())

    def bands(
        self,
        *,
        posterior: str,
        parameter: str = "",
        low: float | None = None,
        high: float | None = None,
        max_period: int = 0,
        generations: int = 3,
        recurrences: int = 0,
        draws: int = 0,
        digest: str = "",
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Carry draws of identified parameters through the branches: 95 % intervals of bifurcations, bands about
        orbits.

        Newton's method carries each orbit and each bifurcation from the run's parameters to those of a draw. The
        columns median, low and high are those of the draws that have the bifurcation.

        Parameters
        ----------
        posterior
            Directory of magpend identify posterior, or a file of its draws.
        parameter
            Continuation parameter: a parameter, or frequency_hz; by default the swept one.
        low
            Least value; by default the run's [SI].
        high
            Largest value; by default the run's [SI].
        max_period
            Longest orbit period of a branch; 0 follows all orbits that attract cells, and doublings up to the longest
            of them, at least up to 4 [drive periods or returns] (0 or more).
        generations
            Number of generations of bifurcating branches that are followed (0 or more).
        recurrences
            Also start from orbits up to this period, near close recurrences of bounded cells (0 or more).
        draws
            Number of draws that are carried; 0 takes all (0 or more).
        digest
            Digest of the file of draws; found by itself.
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("bands", locals())

    def curves(
        self,
        *,
        second: str,
        second_low: float,
        second_high: float,
        parameter: str = "",
        low: float | None = None,
        high: float | None = None,
        max_period: int = 0,
        generations: int = 3,
        recurrences: int = 0,
        curve_period: int = 0,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Continue folds, period doublings and Neimark-Sacker points in the plane of two parameters.

        Starts from the bifurcations that `branches` locates.

        Parameters
        ----------
        second
            Second parameter: its name, such as q, or frequency_hz.
        second_low
            Least value of the second parameter [SI].
        second_high
            Largest value of the second parameter [SI].
        parameter
            Continuation parameter: a parameter, or frequency_hz; by default the swept one.
        low
            Least value; by default the run's [SI].
        high
            Largest value; by default the run's [SI].
        max_period
            Longest orbit period of a branch; 0 follows all orbits that attract cells, and doublings up to the longest
            of them, at least up to 4 [drive periods or returns] (0 or more).
        generations
            Number of generations of bifurcating branches that are followed (0 or more).
        recurrences
            Also start from orbits up to this period, near close recurrences of bounded cells (0 or more).
        curve_period
            Longest orbit period; 0 takes all periods of the branches [drive periods or returns] (0 or more).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("curves", locals())

    def orbits(
        self,
        *,
        at: Mapping[str, float] = {},
        max_period: int = 2,
        starts: int = 400,
        rounds: int = 6,
        seed: int = 0,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Search all periodic orbits up to a period at a parameter point, stable or not, from many starts.

        Counts how many starts lead to each orbit, estimates how many orbits are missing, and checks the sum of the
        indices.

        Parameters
        ----------
        at
            Value of an axis of the run, for the parameter point.
        max_period
            Longest orbit period [drive periods or returns] (1 or more).
        starts
            Number of starts for each period: half of them sections of cells, half random (2 or more).
        rounds
            Most rounds in which known orbits are deflated (0 or more).
        seed
            Seed of the random starts (0 or more).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("orbits", locals())

    def tongues(
        self,
        *,
        second: str,
        second_low: float,
        second_high: float,
        parameter: str = "",
        low: float | None = None,
        high: float | None = None,
        max_period: int = 0,
        generations: int = 3,
        recurrences: int = 0,
        curve_period: int = 0,
        max_denominator: int = 5,
        at: Mapping[str, float] = {},
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Find the Arnold tongues p/q of a plane: where motions lock to the drive, p turns in q drive periods.

        Searches one row of cells with rotation numbers for all fractions up to a denominator. Continues the folds at
        the edges of each tongue in the plane of two parameters.

        Parameters
        ----------
        second
            Second parameter: its name, such as q, or frequency_hz.
        second_low
            Least value of the second parameter [SI].
        second_high
            Largest value of the second parameter [SI].
        parameter
            Continuation parameter: a parameter, or frequency_hz; by default the swept one.
        low
            Least value; by default the run's [SI].
        high
            Largest value; by default the run's [SI].
        max_period
            Longest orbit period of a branch; 0 follows all orbits that attract cells, and doublings up to the longest
            of them, at least up to 4 [drive periods or returns] (0 or more).
        generations
            Number of generations of bifurcating branches that are followed (0 or more).
        recurrences
            Also start from orbits up to this period, near close recurrences of bounded cells (0 or more).
        curve_period
            Longest orbit period; 0 takes all periods of the branches [drive periods or returns] (0 or more).
        max_denominator
            Largest q of the tongues p/q (1 or more, at most 64).
        at
            Value of a further axis of the run: the row on which tongues are searched.
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("tongues", locals())

    def manifolds(
        self,
        *,
        at: Mapping[str, float] = {},
        max_period: int = 1,
        starts: int = 400,
        rounds: int = 6,
        seed: int = 0,
        length: float = 20.0,
        chord: float = 0.02,
        most: int = 20000,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Grow the stable and unstable manifolds of the saddle orbits at a parameter point, as curves.

        Saddles come from `orbits`. An unstable manifold is a curve if the orbit has one unstable multiplier, a stable
        one if it has one stable multiplier.

        Parameters
        ----------
        at
            Value of an axis of the run, for the parameter point.
        max_period
            Longest orbit period [drive periods or returns] (1 or more).
        starts
            Number of starts for each period: half of them sections of cells, half random (2 or more).
        rounds
            Most rounds in which known orbits are deflated (0 or more).
        seed
            Seed of the random starts (0 or more).
        length
            Length of each side, in units of the states' scales (above 0).
        chord
            Longest chord, in units of the states' scales (above 0).
        most
            Most points of each side (10 or more).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("manifolds", locals())

    def tangency(
        self,
        *,
        parameter: str,
        low: float,
        high: float,
        at: Mapping[str, float] = {},
        max_period: int = 1,
        starts: int = 400,
        rounds: int = 6,
        seed: int = 0,
        length: float = 6.0,
        chord: float = 0.01,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Locate the first homoclinic tangencies of the saddle orbits along a parameter, to 1e-8.

        For section maps with two states. Each pair of sides of the unstable and the stable manifold is examined.

        Parameters
        ----------
        parameter
            Parameter along which the manifolds begin to touch: its name, or frequency_hz.
        low
            Least value of the parameter [SI].
        high
            Largest value of the parameter [SI].
        at
            Value of an axis of the run, for the parameter point.
        max_period
            Longest orbit period [drive periods or returns] (1 or more).
        starts
            Number of starts for each period: half of them sections of cells, half random (2 or more).
        rounds
            Most rounds in which known orbits are deflated (0 or more).
        seed
            Seed of the random starts (0 or more).
        length
            Length of each side, in units of the states' scales (above 0).
        chord
            Longest chord, in units of the states' scales (above 0).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("tangency", locals())

    def tipping(
        self,
        *,
        parameter: str = "",
        settle: int = 300,
        keep: int = 64,
        width: float = 1e-06,
        brackets: int = 64,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Find which attractor each trajectory reaches after its parameters have moved, and the critical rates.

        For runs with a table [drift]. Every trajectory is integrated on at the final parameters, where attractors are
        found as by `attractors`. Where neighbouring values of the swept number lead to different attractors, it is
        bisected.

        Parameters
        ----------
        parameter
            Swept number along which critical values are bisected; by default the only axis.
        settle
            Integration at the final parameters before attractors are told [periods] (1 or more).
        keep
            Sections kept after that (16 or more).
        width
            Width of a critical value's interval, as a part of the axis' range (above 0, below 1).
        brackets
            Most critical values that are bisected (0 or more).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("tipping", locals())

    def delay(
        self,
        *,
        moving: str = "",
        period: int = 1,
        distance: float = 0.01,
        static: float | None = None,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Find the value of a moving parameter at which trajectories leave a periodic orbit, such as a delayed
        doubling.

        A trajectory has left an orbit of period p when two of its sections p apart differ by more than a distance. With
        `static` the delay behind the bifurcation at a constant parameter is listed.

        Parameters
        ----------
        moving
            Moving parameter; by default the only one.
        period
            Period of the orbit that is left [drive periods] (1 or more).
        distance
            Largest distance between sections one period of the orbit apart, in units of the states' scales (above 0).
        static
            Value of the bifurcation at a parameter that does not move [SI].
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("delay", locals())

    def overlaps(
        self,
        *,
        before: float,
        after: float,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        parameter: str = "",
        at: Mapping[str, float] = {},
        confidence: float = 0.95,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Compute tipping probabilities between two parameter values from the overlaps of their basins.

        If the parameter jumps from the first value to the second, a start of the basin i before ends on attractor j
        after with the fraction of the basin that lies in basin j. Nothing is integrated for it.

        Parameters
        ----------
        before
            Value of the parameter before the change, on its axis.
        after
            Value of the parameter after the change, on its axis.
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        parameter
            Swept parameter; by default the only axis.
        at
            Value of another axis of the run.
        confidence
            Level of the intervals (above 0, below 1).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("overlaps", locals())

    def resilience(
        self,
        *,
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        at: Mapping[str, float] = {},
        states: str = "",
        phases: int = 8,
        largest: float = 2.0,
        norm: Literal["euclidean", "largest"] = "euclidean",
        directions: int = 64,
        confirmations: int = 256,
        within: int = 20,
        near: float = 0.01,
        timed: int = 256,
        interval: Literal["wilson", "clopper-pearson"] = "wilson",
        confidence: float = 0.95,
        seed: int = 0,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Measure how attractors respond to shocks: critical shocks, distances to the boundary, arrival times.

        The smallest shock that leads away is searched at phases of the drive, and the boundary of the basin along each
        state and in any direction. All sizes are in units of the states' scales. Undecided trajectories make an
        interval of a size.

        Parameters
        ----------
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        at
            Value of an axis of the run; by default all parameter points.
        states
            States that a shock changes, separated by commas; by default the rates.
        phases
            Phases of a drive period, or of a flow's orbit, at which shocks are tried (1 or more).
        largest
            Largest shock that is tried, in units of the states' scales (above 0).
        norm
            Size of a shock: root of the sum of squares of the scaled jumps, or the largest of them.
        directions
            Directions of shocks that change several states (4 or more).
        confirmations
            Random smaller shocks that are tried against each minimum (0 or more).
        within
            Time of the finite-time basin stability [drive periods or returns] (0 or more).
        near
            Distance from its attractor within which a trajectory has arrived, in units of the scales (above 0).
        timed
            Initial states of each parameter point whose arrival is timed (0 or more).
        interval
            Confidence interval of the shares.
        confidence
            Level of the intervals (above 0, below 1).
        seed
            Seed of directions, random shocks and timed initial states (0 or more).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("resilience", locals())

    def edge(
        self,
        *,
        between: tuple[str, str],
        tolerance: float = 0.0,
        polish: bool = True,
        residual: float = 1e-10,
        max_orbit_period: int = 32,
        n_points: int = 64,
        mirror_threshold: float = 0.3,
        extend: bool = True,
        budget: float = 1.0,
        n_sample: int = 24,
        lifetime_confidence: float = 0.95,
        threshold: float = 0.3,
        look_back: int = 3,
        connect: bool = True,
        at: Mapping[str, float] = {},
        pairs: int = 4,
        closest: float = 1e-08,
        farthest: float = 0.0001,
        max_period: int = 1,
        returns: int = 200,
        seed: int = 0,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Track the edge states between two attractors: the saddle sets on the boundary of their basins.

        A pair of states, one in each basin, is bisected and integrated in turns. Where it settles on an orbit or an
        equilibrium, Newton's method refines it.

        Parameters
        ----------
        between
            The two attractors: their letters or ids in the table of attractors.
        tolerance
            Largest distance of a closed cell from its orbit, in units of the states' scales; 0 stands for ten times the
            run's closure tolerance, at least 1e-4 (0 or more).
        polish
            Refine orbits by Newton's method, which integrates a point per orbit.
        residual
            Scaled residual at which Newton's method has converged (above 0).
        max_orbit_period
            Longest orbit period that is sought in cells that are not closed [drive periods or returns] (1 or more).
        n_points
            Section points stored per attractor (1 or more).
        mirror_threshold
            Largest distance of a mirror partner from the image (above 0).
        extend
            Extend the integration of sample cells that are on no known orbit, to find their sets.
        budget
            Longest extension at a parameter point, in units of the run's own integration there (0 or more).
        n_sample
            Number of cells in the first sample that is extended (1 or more).
        lifetime_confidence
            Level of the intervals of lifetimes (above 0, below 1).
        threshold
            Matching: largest distance between sets with one id (above 0).
        look_back
            Matching: steps over which an id is remembered (1 or more).
        connect
            Matching: follow closed orbits along the axes by integration; otherwise match by distance.
        at
            Value of an axis of the run, for the parameter point.
        pairs
            Pairs of initial states that are tracked (1 or more).
        closest
            Scaled distance to which a pair is bisected (1e-12 or more).
        farthest
            Scaled distance beyond which a pair is bisected again (above 0).
        max_period
            Longest period of the orbits that are sought on a path that does not settle; 0 seeks none [drive periods or
            returns] (0 or more).
        returns
            Most drive periods or returns for which a pair is tracked (16 or more).
        seed
            Seed that chooses the pairs (0 or more).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("edge", locals())

    def escapes(
        self,
        *,
        low: Mapping[str, float] = {},
        high: Mapping[str, float] = {},
        radius: float | None = None,
        centre: Mapping[str, float] = {},
        skip: int = 0,
        stretch: int = 20,
        confidence: float = 0.95,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Measure how cells with noise leave a set: rates with intervals, where they go, and their last stretch.

        The set is a box (`low`, `high`), a ball (`radius`), or, without these, the class of motion that a cell begins
        in, by the model's classifier. Over an axis of a strength, rates are fitted by Kramers' law.

        Parameters
        ----------
        low
            Box: least value of a state, such as x=-0.5; a cell below it has left.
        high
            Box: largest value of a state; a cell above it has left.
        radius
            Ball: distance in units of the states' scales beyond which a cell has left (above 0).
        centre
            Ball: its centre by state; by default each cell's first section.
        skip
            Sections at the begin of the record that are not counted (0 or more).
        stretch
            Sections before leaving of which mean and spread are kept (1 or more, at most 1000).
        confidence
            Level of all intervals (above 0, below 1).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("escapes", locals())

    def density(
        self,
        *,
        state: str = "",
        bins: int = 200,
        bandwidth: float = 1.0,
        prominence: float = 0.05,
        skip: int = 0,
        workers: int | None = None,
        scheduler: str | None = None,
        echo: Callable[[str], None] | None = None,
    ) -> xr.Dataset:
        """Estimate the density of the section points of a run with noise: histogram, moments, number of peaks.

        Over an axis this is a stochastic bifurcation diagram.

        Parameters
        ----------
        state
            State whose density is estimated; by default the model's first.
        bins
            Bins of the histogram (10 or more, at most 10000).
        bandwidth
            Factor of the bandwidth that Silverman's rule gives (above 0, at most 100).
        prominence
            Least height of a peak above the higher of its valleys, as a share of the highest peak (above 0, below 1).
        skip
            Sections at the begin of the record that are not counted (0 or more).
        workers
            Number of processes or threads; 0: the calling thread alone.
        scheduler
            Where blocks of parameter points are analysed, as for `magpend.run`.
        echo
            Function that prints a line about each computation.

        Returns
        -------
        Dataset
            Result, which is also kept in the run directory; ``.magpend.table()`` makes a pandas table of it.

        Raises
        ------
        SpecError
            If an option is out of bounds, or if the run does not suit; before anything is computed.
        """
        return self._analysed("density", locals())
