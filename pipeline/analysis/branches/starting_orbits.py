"""Find orbits from which to start branches: a run's attractors, and orbits that its trajectories come near."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from magpend_core.engine.system import System
from magpend_core.equilibria import is_held
from magpend_core.models.model import Parameters
from magpend_core.orbits import scaled_distance
from pipeline.analysis.branches.deflation import search_orbits
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.problems import FREQUENCY, Family
from pipeline.layout.own_words import place_in_words, rate_of
from pipeline.layout.vocabulary import BOUNDED, EQUILIBRIUM, PERIODIC_ORBIT, frequency_of, split_dims
from pipeline.results.ragged import points_of_rows
from pipeline.results.tabular import sets_of
from pipeline.results.tolerances import RECURRENCE


@dataclass(frozen=True)
class Listed:
    """An attractor of a run at one parameter point: its id, its parameter values and its period (0: none)."""

    identity: int
    where: Mapping[str, float]
    period: int
    start: Start | None
    is_rest: bool = False
    is_cycle: bool = False


def listed(attractors: xr.Dataset, parameters: Parameters, parameter: str, scale: float) -> Iterator[Listed]:
    """Yield the attractors of a run. An attractor that Newton's method has refined comes with a starting orbit for a
    branch.

    Parameters
    ----------
    attractors
        From `pipeline.analysis.attractors.attractors`.
    parameters
        Parameters of the run, apart from those on the cube's axes.
    parameter
        Parameter to continue.
    scale
        Change of the parameter that counts as 1.
    """
    for (where, one), points in zip(sets_of(attractors), points_of_rows(attractors), strict=True):
        frequency, packed = parameters_at(one, parameters)
        number, kind, period = (int(one[name]) for name in ("attractor", "kind", "orbit_period"))
        start = None
        system, is_rest = parameters.model.system, kind == EQUILIBRIUM
        if is_rest and system.section is None and is_held(system, points[0], packed):
            period = 1  # its rates do not vanish, but the map at instants leaves it in place
        if int(one["is_polished"]) and (period >= 1 or is_rest):
            family = family_of(system, period, frequency, packed, parameter, scale)
            start = Start(family, points[0], value_of(family, frequency, packed), number)
        yield Listed(number, where, period, start, is_rest, kind == PERIODIC_ORBIT and not period)


def attracting(
    attractors: xr.Dataset,
    parameters: Parameters,
    parameter: str,
    interval: tuple[float, float],
    max_period: int = 0,
    scale: float | None = None,
) -> tuple[list[Start], list[str]]:
    """Return the starting orbits of branches from a run's attractors, and a text line for each attractor left out.

    Parameters
    ----------
    attractors
        From `pipeline.analysis.attractors.attractors`.
    parameters
        Parameters of the run, apart from those on the cube's axes.
    parameter
        Parameter to continue.
    interval
        Interval of the parameter.
    max_period
        Longest period taken [drive periods]; 0 takes all.
    scale
        Change of the parameter that counts as 1; by default the length of the interval.

    Returns
    -------
    starts : list of Start
        In the order of the cube's points and attractors.
    left_out : list of str
        A line for each attractor, and each reason, with the points where it is and how to get it.
    """
    (low, high), word = interval, rate_of(attractors)
    starts: list[Start] = []
    reasons: dict[tuple[int, str], list[Mapping[str, float]]] = {}
    for one in listed(attractors, parameters, parameter, high - low if scale is None else scale):
        why = _why_not(one, interval, max_period, word)
        if why:
            reasons.setdefault((one.identity, why), []).append(one.where)
        elif one.start is not None:
            starts.append(one.start)
    lines = [f"attractor {i}{_places(where, word)}: {why}" for (i, why), where in reasons.items()]
    return starts, lines


def _why_not(one: Listed, interval: tuple[float, float], max_period: int, word: str) -> str:
    """Return the reason why no branch can start from an attractor; an empty text if one can."""
    if one.is_cycle:
        return "a limit cycle seen at even times; see it at crossings: [section] of a new run"
    if not one.period and not one.is_rest:
        return "a set that does not close; --recurrences P starts from orbits that it comes near"
    if one.start is None:
        return f"Newton's method found no orbit of period {one.period} there"
    if max_period and one.period > max_period:
        return f"its period is {one.period}; take it with --period {one.period}"
    if not interval[0] <= one.start.value <= interval[1]:
        bounds = place_in_words(one.start.family.free[0], word, *interval, between=" to ")
        return f"outside of {bounds}; widen it with --from and --to"
    return ""


def _places(where: Sequence[Mapping[str, float]], word: str) -> str:
    if not where[0]:
        return ""
    ranges = []
    for name in where[0]:
        values = {at[name] for at in where}
        ranges.append(place_in_words(name, word, *{min(values), max(values)}, between=" to "))
    points = f" ({len(where)} points)" if len(where) > 1 else ""
    return f" at {', '.join(ranges)}{points}"


def family_of(
    system: System, period: int, frequency_hz: float, packed: np.ndarray, parameter: str, scale: float
) -> Family:
    """Make a family of periodic orbits with a given period and one free parameter."""
    return Family(system, period, frequency_hz, packed, (parameter,), (scale,))


def value_of(family: Family, frequency_hz: float, packed: np.ndarray) -> float:
    """Return the value of a family's free parameter, from the drive frequency [Hz] and the packed parameters."""
    name = family.free[0]
    if name == FREQUENCY:
        return frequency_hz
    return float(packed[family.system.parameter_names.index(name)])


def parameters_at(point: xr.Dataset, base: Parameters) -> tuple[float, np.ndarray]:
    """Return the frequency [Hz] and the packed parameters at one parameter point of a run's result cube."""
    axes = {n: float(point.coords[n]) for n in base.names if n in point.coords and not point.coords[n].dims}
    return frequency_of(base.model, {str(k): v for k, v in point.coords.items()}), base.replace(**axes).pack()


def sections_of(cells: xr.Dataset) -> np.ndarray:
    """Return all finite section points of some cells, shape (any, n_states)."""
    section = cells["section"].transpose(..., "state").values
    section = section.reshape(-1, section.shape[-1])
    return np.asarray(section[np.isfinite(section).all(axis=1)])


def recurrent(cube: xr.Dataset, parameters: Parameters, parameter: str, scale: float, max_period: int) -> list[Start]:
    """Find the periodic orbits, mostly unstable, that trajectories of a run come near.

    Where two section points of a trajectory, p periods apart, are close, Newton's method from the first often
    leads to an orbit of period p (Auerbach et al., Phys. Rev. Lett. 58, 1987, 2387).

    Parameters
    ----------
    cube
        Cube with `section` and `status`; only cells of status bounded are used.
    parameters, parameter, scale, max_period
        Parameters of the run, free parameter, its scale (see `listed`), and longest period.

    Returns
    -------
    list of Start
        Different orbits, by rising period at each point of the cube.
    """
    system = parameters.model.system
    starts = []
    axes, _ = split_dims(cube["status"])
    for index in np.ndindex(*(cube.sizes[d] for d in axes)):
        point = cube.isel(dict(zip(axes, index, strict=True)))
        dims = point["status"].dims
        section = point["section"].transpose(*dims, "period_index", "state").values
        section = section.reshape(-1, *section.shape[len(dims) :])[point["status"].values.ravel() == BOUNDED]
        if not len(section):
            continue
        frequency, packed = parameters_at(point, parameters)
        for state, period in orbits_near(section, frequency, packed, max_period, system):
            family = family_of(system, period, frequency, packed, parameter, scale)
            starts.append(Start(family, state, value_of(family, frequency, packed)))
    return starts


def orbits_near(
    section: np.ndarray, frequency_hz: float, packed: np.ndarray, max_period: int, system: System
) -> list[tuple[np.ndarray, int]]:
    """Find periodic orbits where trajectories nearly return to an earlier section point.

    Parameters
    ----------
    section
        Sections of consecutive drive periods, shape (trajectory, period, n_states) [the model's units].
    frequency_hz
        Drive frequency [Hz].
    packed
        Packed parameters.
    max_period
        Longest period [drive periods].
    system
        System of equations to integrate.

    Returns
    -------
    list of (ndarray, int)
        A section point and the least period of each orbit found, no orbit twice, by rising period.
    """
    guesses, periods = [], []
    for period in range(1, min(max_period, section.shape[1] - 1) + 1):
        distance = scaled_distance(section[:, period:], section[:, :-period], system)
        order = np.argsort(distance, axis=None, kind="stable")
        chosen = _spread(section, [np.unravel_index(k, distance.shape) for k in order], distance, system)
        guesses += chosen
        periods += [period] * len(chosen)
    if not guesses:
        return []
    found = search_orbits(np.array(guesses), np.array(periods), frequency_hz, packed, system)
    return [(one.points[0], one.period) for one in found]


def _spread(
    section: np.ndarray, places: Sequence[tuple[np.intp, ...]], distance: np.ndarray, system: System
) -> list[np.ndarray]:
    """Choose section points to which a trajectory returns most closely, all more than `RECURRENCE` apart."""
    tries = 16  # most recurrences tried per period
    chosen: list[np.ndarray] = []
    for place in places:
        if len(chosen) == tries or not distance[place] <= RECURRENCE:
            break
        point = section[place]
        if all(scaled_distance(point, other, system) > RECURRENCE for other in chosen):
            chosen.append(point)
    return chosen
