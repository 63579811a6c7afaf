"""Read Lyapunov exponents from a run's result cube, for the figures that show them."""

from __future__ import annotations

import xarray as xr

from pipeline.analysis.chaos.lyapunov import period_seconds
from pipeline.layout.vocabulary import model_of, period_of
from pipeline.plots import style
from pipeline.plots.motions import motion_codes, motions_of
from pipeline.plots.points import ABSENT, DRAWN

UNITS = ("s", "period")
"""Units of time that exponents are given per."""


def left_out(part: xr.Dataset) -> str:
    """Return a text on how many cells have no Lyapunov exponent, and why; an empty text if all have one."""
    status = part["status"]
    missing = part["lyapunov"].isel(exponent=0, drop=True).isnull().transpose(*status.dims)
    counts = {name: int((missing & status.isin(codes)).sum()) for name, codes in ABSENT.items()}
    counts["without exponent"] = int((missing & status.isin(DRAWN)).sum())
    listed = style.join(f"{n} {name}" for name, n in counts.items() if n)
    return f"left out of {status.size} cells: {listed}" if listed else ""


def exponent_values(part: xr.Dataset, per: str, spectrum: bool) -> xr.Dataset:
    """Return the Lyapunov exponents and their errors per second or per period, with flags and classes of motion."""
    scale = period_seconds(part) if per == "period" else xr.DataArray(1.0)
    chosen = part if spectrum else part.isel(exponent=slice(1))
    dims = chosen["lyapunov"].dims
    variables = {
        "exponent_value": (chosen["lyapunov"] * scale).transpose(*dims),
        "exponent_stderr": (chosen["lyapunov_stderr"] * scale).transpose(*dims),
        "lyapunov_flag": part["lyapunov_flag"],
    }
    if motions_of(part).told:
        variables["motion"] = motion_codes(part)
    data = xr.Dataset(variables).load()
    for name in ("exponent_value", "exponent_stderr"):
        data[name].attrs.update(
            units="1/s" if per == "s" else "1", per="unit time" if per == "s" else period_of(model_of(part))
        )
    # NetCDF cannot store object labels; the numbers of branches and starts suffice
    keep = {"exponent", *data["lyapunov_flag"].dims}
    keep |= {str(c) for c, v in data.coords.items() if not v.ndim and v.dtype.kind == "f"}
    return data.drop_vars([c for c in data.coords if c not in keep]).assign_attrs(title="Lyapunov exponents")


def rate_unit(data: xr.Dataset) -> str:
    """Return the unit of the Lyapunov exponents, for an axis label."""
    per = str(data["exponent_value"].attrs["per"])
    return "1/s" if per == "unit time" else f"1/{per.split()[-1]}"
