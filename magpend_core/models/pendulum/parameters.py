"""Parameters of the pendulum: validated, named, packed into one flat vector for the kernels.

All quantities are in SI units. The names are those of the paper (Wojna et al., J. Sound Vib. 430,
2018) and are unique over all groups, so that an override or a sweep axis needs the bare name only.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from importlib import resources
from typing import Any, Self

import numpy as np

POSITIVE = "greater than 0"
NON_NEGATIVE = "0 or greater"
FRACTION = "between 0 and 1, both excluded"
FINITE = "a finite number"

_BOUNDS: dict[str, Callable[[float], bool]] = {
    POSITIVE: lambda x: x > 0.0,
    NON_NEGATIVE: lambda x: x >= 0.0,
    FRACTION: lambda x: 0.0 < x < 1.0,
    FINITE: lambda x: True,
}


class ParameterError(ValueError):
    """One or more parameters are unknown or out of bounds.

    Attributes
    ----------
    problems : list of str
        A sentence for each problem: the name, the value, the bound and what to do.
    """

    def __init__(self, problems: list[str]) -> None:
        self.problems = problems
        super().__init__("\n".join(problems))


def _quantity(unit: str, meaning: str, bound: str) -> Any:
    return field(metadata={"unit": unit, "meaning": meaning, "bound": bound})


def _wanted(bound: str) -> str:
    return bound if bound == FINITE else f"a number {bound}"


def _problem(name: str, value: Any, bound: str) -> str | None:
    """Return the sentence for a bad value, or None."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        return f"{name} = {value!r} is not a number; give {_wanted(bound)}."
    if not math.isfinite(value):
        return f"{name} = {value!r} is not finite; give {_wanted(bound)}."
    if not _BOUNDS[bound](float(value)):
        return f"{name} = {value!r} is out of bounds: it must be {bound}."
    return None


class _Group:
    """Shared behaviour of the parameter groups."""

    def __post_init__(self) -> None:
        problems = []
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            problem = _problem(f.name, value, f.metadata["bound"])
            if problem:
                problems.append(problem)
            else:
                object.__setattr__(self, f.name, float(value))
        problems += [] if problems else self._relations()
        if problems:
            raise ParameterError(problems)

    def _relations(self) -> list[str]:
        """Problems between the values of the group."""
        return []


@dataclass(frozen=True, kw_only=True)
class Pendulum(_Group):
    """Masses and lengths of the two links (Table 1)."""

    g: float = _quantity("m/s2", "gravitational acceleration", NON_NEGATIVE)
    l1: float = _quantity("m", "distance between the joints", POSITIVE)
    m1: float = _quantity("kg", "mass of link 1", POSITIVE)
    m2: float = _quantity("kg", "mass of link 2", POSITIVE)
    e1: float = _quantity("m", "joint 1 to the centre of mass of link 1", NON_NEGATIVE)
    e2: float = _quantity("m", "joint 2 to the centre of mass of link 2", NON_NEGATIVE)
    J1: float = _quantity("kg m2", "moment of inertia of link 1 about its centre of mass", POSITIVE)
    J2: float = _quantity("kg m2", "moment of inertia of link 2 about its centre of mass", POSITIVE)


@dataclass(frozen=True, kw_only=True)
class Friction(_Group):
    """Friction in the joints with Stribeck effect and load dependence (Eq. 7-11, Table 1)."""

    T1: float = _quantity("N m", "load-independent dry friction torque of joint 1", NON_NEGATIVE)
    T2: float = _quantity("N m", "load-independent dry friction torque of joint 2", NON_NEGATIVE)
    c: float = _quantity("N m s", "viscous coefficient of joint 2; joint 1 has twice this", NON_NEGATIVE)
    mu: float = _quantity("m", "friction torque per bearing load", NON_NEGATIVE)
    mu0: float = _quantity("1", "kinetic over static friction", NON_NEGATIVE)
    c0: float = _quantity("s/rad", "Stribeck constant", NON_NEGATIVE)
    eps: float = _quantity("s/rad", "steepness of the friction's sign function", POSITIVE)


@dataclass(frozen=True, kw_only=True)
class Drive(_Group):
    """Square-wave torque on joint 1 (Eq. 12-15)."""

    duty_cycle: float = _quantity("1", "fraction of the period in the high state", FRACTION)
    q: float = _quantity("N m", "amplitude of the driving torque", FINITE)
    eps_drive: float = _quantity("1", "steepness of the square wave's edges", POSITIVE)


@dataclass(frozen=True, kw_only=True)
class FittedMagnet(_Group):
    """Magnet torque fitted by two bumps (Eq. 18-19), turned into joint torques (Eq. 20)."""

    alpha1: float = _quantity("N m", "height of the bump right of the magnet", FINITE)
    alpha2: float = _quantity("N m", "height of the bump left of the magnet", FINITE)
    beta1: float = _quantity("rad", "offset of bump 1 in psi_rel", FINITE)
    beta2: float = _quantity("rad", "offset of bump 2 in psi_rel", FINITE)
    gamma1: float = _quantity("rad", "width of bump 1 in psi_rel", POSITIVE)
    gamma2: float = _quantity("rad", "width of bump 2 in psi_rel", POSITIVE)
    p1: float = _quantity("1", "slope of the position of bump 1 over psi_rel", FINITE)
    p2: float = _quantity("1", "slope of the position of bump 2 over psi_rel", FINITE)
    r1: float = _quantity("rad", "position of bump 1 at psi_rel = 0, negated", FINITE)
    r2: float = _quantity("rad", "position of bump 2 at psi_rel = 0, negated", FINITE)
    c1: float = _quantity("rad", "width of bump 1 in psi1", POSITIVE)
    c2: float = _quantity("rad", "width of bump 2 in psi1", POSITIVE)
    eps_mag: float = _quantity("1/rad", "steepness of the change between the bumps", POSITIVE)
    l2: float = _quantity("m", "joint 2 to the centre of the moving magnet", POSITIVE)
    h: float = _quantity("m", "joint 1 to the centre of the fixed magnet", POSITIVE)
    delta: float = _quantity("m", "regularisation of dy/dx where the magnets are in line", POSITIVE)


@dataclass(frozen=True, kw_only=True)
class DipoleMagnet(_Group):
    """Point dipoles (Eq. 16): the baseline that the paper's authors rejected.

    The force mu_0 pole1 pole2/(4 pi r**2) acts along the line between the magnets.
    """

    pole1: float = _quantity("A m", "pole strength of the fixed magnet", FINITE)
    pole2: float = _quantity("A m", "pole strength of the moving magnet", FINITE)
    l2: float = _quantity("m", "joint 2 to the centre of the moving magnet", POSITIVE)
    h: float = _quantity("m", "joint 1 to the centre of the fixed magnet", POSITIVE)


Magnet = FittedMagnet | DipoleMagnet
_GROUPS: dict[str, tuple[type[_Group], ...]] = {
    "pendulum": (Pendulum,),
    "friction": (Friction,),
    "drive": (Drive,),
    "magnet": (FittedMagnet, DipoleMagnet),
}


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """Everything the model needs besides the drive's frequency.

    Attributes
    ----------
    pendulum : Pendulum
    friction : Friction
    drive : Drive
    magnet : FittedMagnet or DipoleMagnet
    """

    pendulum: Pendulum
    friction: Friction
    drive: Drive
    magnet: Magnet

    def __post_init__(self) -> None:
        magnet = self.magnet
        if isinstance(magnet, DipoleMagnet) and magnet.h <= self.pendulum.l1 + magnet.l2:
            raise ParameterError(
                [
                    f"h = {magnet.h!r} is out of bounds: with point dipoles it must be greater than "
                    f"l1 + l2 = {self.pendulum.l1 + magnet.l2!r}, or the magnets can meet."
                ]
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters in the order of `pack`."""
        return tuple(name for group in self._groups() for name in _names(type(group)))

    def _groups(self) -> tuple[Any, ...]:
        return self.pendulum, self.friction, self.drive, self.magnet

    def as_dict(self) -> dict[str, float]:
        """All values by name, in the order of `pack`."""
        return {name: getattr(group, name) for group in self._groups() for name in _names(type(group))}

    def pack(self) -> np.ndarray:
        """Return all values as a float64 vector of shape ``(len(names),)``, SI units."""
        return np.array(list(self.as_dict().values()), dtype=np.float64)

    def replace(self, **overrides: float) -> Self:
        """Return a copy with some values replaced.

        Parameters
        ----------
        overrides
            New values by parameter name [SI].

        Raises
        ------
        ParameterError
            With all problems at once: unknown names, values that are not numbers, NaN or infinite
            values, values out of bounds.
        """
        problems = [unknown_name_problem(n, self.names) for n in overrides if n not in self.names]
        groups = {}
        for key, group in zip(_GROUPS, self._groups(), strict=True):
            own = {n: v for n, v in overrides.items() if n in _names(type(group))}
            try:
                groups[key] = dataclasses.replace(group, **own)
            except ParameterError as error:
                problems += error.problems
        if problems:
            raise ParameterError(problems)
        return type(self)(**groups)


def _names(group: type[_Group]) -> tuple[str, ...]:
    return tuple(f.name for f in fields(group))  # type: ignore[arg-type]


def describe(parameters: Parameters) -> dict[str, dict[str, str]]:
    """Unit, meaning and bound of every parameter, by name."""
    return {f.name: dict(f.metadata) for group in parameters._groups() for f in fields(group)}


def unknown_name_problem(name: str, known: tuple[str, ...]) -> str:
    """Sentence for an unknown parameter name, with the nearest known names."""
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"known names: {', '.join(known)}."
    return f"{name!r} is not a parameter; {hint}"


def preset_names() -> tuple[str, ...]:
    """Names of the presets that ship with the package."""
    folder = resources.files("magpend_core.models.pendulum") / "presets"
    return tuple(sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml")))


def _read_preset(name: str) -> dict[str, Any]:
    known = preset_names()
    if name not in known:
        near = difflib.get_close_matches(str(name), known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known presets: {', '.join(known)}."
        raise ParameterError([f"preset {name!r} does not exist; {hint}"])
    text = (resources.files("magpend_core.models.pendulum") / "presets" / f"{name}.toml").read_text("utf-8")
    return tomllib.loads(text)


def preset_provenance(name: str = "wojna2018") -> dict[str, str]:
    """Where each parameter of a preset comes from: the paper, or a calibration.

    Returns
    -------
    dict
        Parameter name to a phrase.
    """
    table = _read_preset(name)
    origin: Mapping[str, str] = table["provenance"]
    return {p: origin.get(p, origin.get(group, "")) for group in _GROUPS for p in table[group]}


def load_preset(name: str = "wojna2018", **overrides: float) -> Parameters:
    """Return the parameters of a preset, some of them replaced.

    Parameters
    ----------
    name
        Preset: ``"wojna2018"`` holds the constants of Wojna et al. (2018); those that the paper
        gives only in figures (drive, magnets) are calibrated, see `preset_provenance`.
    overrides
        Values by parameter name [SI], for example ``q=1.6, duty_cycle=0.5``.

    Raises
    ------
    ParameterError
        If the preset or a name is unknown or a value is out of bounds; all problems at once.

    Examples
    --------
    >>> load_preset(duty_cycle=0.5).drive.duty_cycle
    0.5
    """
    table = _read_preset(name)
    groups = {key: _group_of(table[key], kinds) for key, kinds in _GROUPS.items()}
    return Parameters(**groups).replace(**overrides)


def _group_of(values: Mapping[str, float], kinds: tuple[type[_Group], ...]) -> Any:
    """Build the group whose names are those of `values`."""
    for kind in kinds:
        if set(_names(kind)) == set(values):
            return kind(**values)
    raise ParameterError([f"no group of parameters has exactly the names {', '.join(values)}."])
