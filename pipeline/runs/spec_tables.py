"""Methods of `magpend.Spec`, one for each table of a specification.

Made by ``python -m pipeline.cli.reference``; change `pipeline.cli.reference_spec` instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, Self

from pipeline.runs.arguments import knows_its_keys

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Numbers = Sequence[float] | npt.NDArray[np.float64]
    Rows = Sequence[Numbers] | npt.NDArray[np.float64]


class SpecTables:
    """Base class of `magpend.Spec` with a method for each table. Each method returns a changed copy."""

    def _updated(self, path: str, keys: Mapping[str, Any]) -> Self:
        raise NotImplementedError

    def _replaced(self, path: str, keys: Mapping[str, Any]) -> Self:
        raise NotImplementedError

    @knows_its_keys
    def parameters(
        self,
        *,
        preset: str | Mapping[str, Any] | None = None,
        overrides: Mapping[str, float] | None = None,
        frequency_hz: float | None = None,
    ) -> Self:
        """Set values of the model's parameters.

        Parameters
        ----------
        preset
            Preset of the model, by default the first; or a preset's file, FILE.toml, relative to the specification.
        overrides
            Values by parameter name, in SI units.
        frequency_hz
            Drive frequency [Hz], unless it is an axis; above 0.
        """
        return self._updated("parameters", {"preset": preset, "overrides": overrides, "frequency_hz": frequency_hz})

    @knows_its_keys
    def axis(
        self,
        name: str,
        start: float | None = None,
        stop: float | None = None,
        num: int | None = None,
        step: float | None = None,
        values: Numbers | None = None,
    ) -> Self:
        """Sweep a parameter.

        Parameters
        ----------
        name
            ``frequency_hz`` or a parameter of the model.
        start
            First value.
        stop
            Last value; with step, an upper bound.
        num
            Number of evenly spaced values, both ends included; 2 or more, at most 1e+07.
        step
            Spacing, instead of num; above 0.
        values
            All values, instead of the other keys.
        """
        return self._replaced(
            f"axes.{name}", {"start": start, "stop": stop, "num": num, "step": step, "values": values}
        )

    @knows_its_keys
    def start_grid(
        self, *, refine: int | None = None, **states: float | tuple[float, float, int] | Numbers | Mapping[str, Any]
    ) -> Self:
        """Start on a grid of initial states.

        Parameters
        ----------
        refine
            Stride of the cells that are computed first: 2, 4, 8, 16, 32, 64.
        states
            States by name; for an angle or its rate ``NAME_deg`` takes degrees. Each is a number, ``(start, stop,
            num)``, a list of values, or a table with the keys of `axis`. States not given are 0.
        """
        return self._replaced("initial_conditions", {"kind": "grid", "refine": refine, **states})

    @knows_its_keys
    def start_list(self, points: Rows | None = None, points_deg: Rows | None = None) -> Self:
        """Start from a list of initial states.

        Parameters
        ----------
        points
            Rows of states in their units.
        points_deg
            Rows in degrees and degrees/s.
        """
        return self._replaced("initial_conditions", {"kind": "list", "points": points, "points_deg": points_deg})

    @knows_its_keys
    def start_random(self, *, n: int, seed: int | None = None, **states: float | tuple[float, float]) -> Self:
        """Start from random initial states in a box.

        Parameters
        ----------
        n
            Number of samples; 1 or more, at most 1e+07.
        seed
            Seed of the samples; 0 or more; default 0.
        states
            States by name; for an angle or its rate ``NAME_deg`` takes degrees. Each is a number or ``(low, high)``.
        """
        return self._replaced("initial_conditions", {"kind": "random", "n": n, "seed": seed, **states})

    @knows_its_keys
    def section(
        self,
        *,
        of: str,
        value: float | None = None,
        direction: Literal["up", "down"] | None = None,
        longest: float | None = None,
    ) -> Self:
        """Take sections where a state crosses a level.

        Parameters
        ----------
        of
            State that crosses the level.
        value
            Level in the state's unit; for an angle, modulo 2 pi; default 0.0.
        direction
            Whether the state rises or falls there; default 'up'.
        longest
            Longest time between crossings [s]; a cell that takes longer does not return; above 0; default 100.0.
        """
        return self._replaced("section", {"of": of, "value": value, "direction": direction, "longest": longest})

    @knows_its_keys
    def continuation(self, *, path: str | None = None, direction: Literal["up", "down", "both"] | None = None) -> Self:
        """Choose the axis that branches follow.

        Parameters
        ----------
        path
            Axis that the branches follow: the continuation parameter; default 'frequency_hz'.
        direction
            Direction in which the branches follow it; default 'up'.
        """
        return self._updated("continuation", {"path": path, "direction": direction})

    @knows_its_keys
    def drive(self, *, file: str, section_hz: float | None = None) -> Self:
        """Replace the model's drive by a recorded one.

        Parameters
        ----------
        file
            Drive file (CSV), relative to the specification.
        section_hz
            Sections per second of a torque; by default sections lie at its rising edges; above 0.
        """
        return self._replaced("drive", {"file": file, "section_hz": section_hz})

    @knows_its_keys
    def drift(
        self,
        name: str,
        *,
        from_: float | None = None,
        to: float | None = None,
        rate_per_s: float | None = None,
        rate_per_period: float | None = None,
        start_s: float | None = None,
        start_periods: float | None = None,
        duration_s: float | None = None,
        duration_periods: float | None = None,
        shape: Literal["linear", "tanh"] | None = None,
        file: str | None = None,
    ) -> Self:
        """Move a parameter while the run integrates.

        Parameters
        ----------
        name
            Parameter of the model.
        from_
            Value before the ramp; by default the parameter's.
        to
            Value after the ramp. Give two of to, a rate and a duration.
        rate_per_s
            Mean change per second on the ramp.
        rate_per_period
            Mean change per drive period, instead of rate_per_s.
        start_s
            Start of the ramp or of the file's time [s]; by default 0; 0 or more.
        start_periods
            Start in drive periods, instead of start_s; 0 or more.
        duration_s
            Duration of the ramp [s]; above 0.
        duration_periods
            Duration in drive periods, instead of duration_s; above 0.
        shape
            linear, or tanh: smooth, five times as steep in the middle as on average; default 'linear'.
        file
            Instead of a ramp: CSV file with the columns time_s,value, joined by lines.
        """
        return self._replaced(
            f"drift.{name}",
            {
                "from": from_,
                "to": to,
                "rate_per_s": rate_per_s,
                "rate_per_period": rate_per_period,
                "start_s": start_s,
                "start_periods": start_periods,
                "duration_s": duration_s,
                "duration_periods": duration_periods,
                "shape": shape,
                "file": file,
            },
        )

    @knows_its_keys
    def noise(
        self,
        *,
        strengths: Mapping[str, float | str],
        interpretation: Literal["ito", "stratonovich"] | None = None,
        seed: int | None = None,
        steps_per_period: int | None = None,
        step: float | None = None,
        tolerance: float | None = None,
    ) -> Self:
        """Add white noise to equations.

        Parameters
        ----------
        strengths
            Strength by state: a number, or an expression of states and parameters in quotes. Its unit is that of the
            state over the square root of a second.
        interpretation
            Stochastic integral; required where a strength depends on its own state.
        seed
            Seed of the noise; 0 or more, at most 9.22337e+18; default 0.
        steps_per_period
            Equal steps per period; 256 by default; 1 or more, at most 1e+07.
        step
            Largest step [s], instead of their number: the next shorter one that divides the period; above 0.
        tolerance
            Largest change of the states within a period when the steps are halved, in units of their scales; a run is
            refused if a sample of its cells exceeds it; above 0; default 0.01.
        """
        return self._replaced(
            "noise",
            {
                "strengths": strengths,
                "interpretation": interpretation,
                "seed": seed,
                "steps_per_period": steps_per_period,
                "step": step,
                "tolerance": tolerance,
            },
        )

    @knows_its_keys
    def integration(
        self,
        *,
        rtol: float | None = None,
        atol: float | None = None,
        method: Literal["dopri5", "dop853"] | None = None,
        n_transient: int | None = None,
        n_keep: int | None = None,
        max_steps_per_period: int | None = None,
        stop_when_closed: bool | None = None,
        closure_tolerance: float | None = None,
        max_orbit_period: int | None = None,
    ) -> Self:
        """Set tolerances, transient and kept sections.

        Parameters
        ----------
        rtol
            Relative tolerance of a step; 1e-13 or more, below 1; default 1e-08.
        atol
            Absolute tolerance of a step, in the states' units; or in units of the sizes that the motion gave them;
            above 0, below 1; default 1e-08.
        method
            Runge-Kutta method: dopri5 of order 5, or dop853 of order 8 for smooth equations; default 'dopri5'.
        n_transient
            Drive periods or returns before sections are kept; 0 or more, at most 1e+08; default 300.
        n_keep
            Sections kept, one per drive period or return; 1 or more, at most 1e+06; default 60.
        max_steps_per_period
            Attempted steps after which a cell is given up; 1 or more, at most 1e+09; default 20000.
        stop_when_closed
            Keep sections as soon as the orbit has closed, without waiting for n_transient; default false.
        closure_tolerance
            Scaled distance to a closed orbit below which a cell counts as closed; above 0, below 1; default 1e-06.
        max_orbit_period
            Longest orbit period that is detected [drive periods or returns]; 1 or more, at most 32000; default 16.
        """
        return self._updated(
            "integration",
            {
                "rtol": rtol,
                "atol": atol,
                "method": method,
                "n_transient": n_transient,
                "n_keep": n_keep,
                "max_steps_per_period": max_steps_per_period,
                "stop_when_closed": stop_when_closed,
                "closure_tolerance": closure_tolerance,
                "max_orbit_period": max_orbit_period,
            },
        )

    @knows_its_keys
    def execution(self, *, trajectories_per_task: int | None = None, points_per_task: int | None = None) -> Self:
        """Set the sizes of tasks, which change no number.

        Parameters
        ----------
        trajectories_per_task
            Cells or branches of a task; by default chosen by chunk size and time; 1 or more, at most 1e+07.
        points_per_task
            Points of the continuation that a task covers; by default chosen by time; 1 or more, at most 1e+07.
        """
        return self._updated(
            "execution", {"trajectories_per_task": trajectories_per_task, "points_per_task": points_per_task}
        )

    @knows_its_keys
    def lyapunov(
        self,
        *,
        n_exponents: int | None = None,
        n_transient: int | None = None,
        n_periods: int | None = None,
        n_blocks: int | None = None,
    ) -> Self:
        """Compute a product of every cell.

        Lyapunov exponents along each cell's attractor, with errors, convergence and an audit.

        Parameters
        ----------
        n_exponents
            Number of exponents, from the largest on; by default one for each state; 1 or more.
        n_transient
            Time in which the tangent vectors align [drive periods or returns]; 0 or more, at most 1e+06; default 200.
        n_periods
            Time over which growth is averaged, rounded up to blocks of equal length [drive periods or returns]; 2 or
            more, at most 1e+08; default 400.
        n_blocks
            Number of blocks of that time, for standard errors; 2 or more, at most 1000; default 16.
        """
        return self._updated(
            "products.lyapunov",
            {"n_exponents": n_exponents, "n_transient": n_transient, "n_periods": n_periods, "n_blocks": n_blocks},
        )

    @knows_its_keys
    def extremes(self, *, quantities: Sequence[str]) -> Self:
        """Compute a product of every cell.

        Least and largest value and mean of named quantities over each kept drive period.

        Parameters
        ----------
        quantities
            Names of quantities and states of the model, such as an energy.
        """
        return self._replaced("products.extremes", {"quantities": quantities})

    @knows_its_keys
    def rotation(
        self,
        *,
        of: Sequence[str] | None = None,
        center: Numbers | None = None,
        section: bool | None = None,
        n_periods: int | None = None,
    ) -> Self:
        """Compute a product of every cell.

        Rotation number of each cell's attractor: mean turns per drive period, with an error.

        Parameters
        ----------
        of
            What turns: an angle, or two states whose plane a trajectory turns in, clockwise; by default the model's
            only angle, or its two states.
        center
            Point of the plane about which turns are counted; default (0.0, 0.0).
        section
            Count the turns of the section points about their mean, in [0, 1): for tori around an orbit; default false.
        n_periods
            Time over which the turns of orbits that are not closed are averaged [drive periods]; 8 or more; default
            400.
        """
        return self._updated(
            "products.rotation", {"of": of, "center": center, "section": section, "n_periods": n_periods}
        )
