"""Write the atlas of a plane as GeoJSON: regions, curves, lines, and the changes that are not explained."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.analysis.atlas.plane import Array
from pipeline.analysis.atlas.shapes import line_places, pieces_of, rings_of
from pipeline.analysis.atlas.table import audit_of, open_changes
from pipeline.analysis.branches.kinds import CURVE_KINDS
from pipeline.layout.conventions import shown_unit
from pipeline.layout.own_words import in_own_words
from pipeline.layout.vocabulary import parameter_name
from pipeline.results.tabular import words_of
from pipeline.specification.problems import SpecError

if TYPE_CHECKING:
    import xarray as xr


def geojson_text(ds: xr.Dataset) -> str:
    """Return an atlas as GeoJSON, whose coordinates are values of both parameters in the units of its `properties`.

    Curves are cut to the plane, and where the stability of their orbits changes. SpecError for another result.
    """
    if ds.attrs.get("derived_product") != "atlas":
        raise SpecError("*.geojson: only an atlas (magpend analyse atlas) has regions; write .csv, .nc or .mat.")
    ds = in_own_words(ds)
    parameters = [
        {"name": parameter_name(str(ds.attrs[f"{which}_parameter"])), "unit": shown_unit(ds[f"corner_{which}"].attrs)}
        for which in ("first", "second")
    ]
    features = [*_regions(ds), *_curves(ds), *_lines(ds), *_not_explained(ds)]
    properties = {"coordinates": parameters, "changes": audit_of(ds)}
    found = {"type": "FeatureCollection", "properties": properties, "features": features}
    return json.dumps(found, allow_nan=False, indent=1) + "\n"


def _feature(what: str, geometry: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    shape = {"type": geometry, "coordinates": coordinates}
    return {"type": "Feature", "properties": {"what": what, **properties}, "geometry": shape}


def _regions(ds: xr.Dataset) -> Iterator[dict[str, Any]]:
    for number, rings in enumerate(rings_of(ds)):
        one = ds.isel(region=number)
        yield _feature(
            "region",
            "Polygon",
            [_turned(ring, k > 0).tolist() for k, ring in enumerate(rings)],
            number=number,
            area=float(one["area"]),
            label=str(one["region_label"].values),
            label_point=[float(one["label_first"]), float(one["label_second"])],
            points=int(one["region_points"]),
            cells=int(one["region_cells"]),
            thin=bool(one["is_thin"]),
            attractors=[_member(ds, k) for k in np.flatnonzero(ds["of_region"].values == number).tolist()],
        )


def _turned(ring: Array, is_hole: bool) -> Array:
    """Return a closed ring counterclockwise, or clockwise if it bounds a hole (RFC 7946, section 3.1.6)."""
    x, y = (ring - ring[0]).T
    is_left = float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) > 0.0
    return ring if is_left != is_hole else ring[::-1]


def _member(ds: xr.Dataset, row: int) -> dict[str, Any]:
    one = ds.isel(member=row)
    return {
        "id": int(one["member_attractor"]),
        "kind": words_of(ds["member_set"])[int(one["member_set"])],
        "period": int(one["member_period"]),
        "share": float(one["member_share"]),
        "low": float(one["member_share_low"]),
        "high": float(one["member_share_high"]),
    }


def _curves(ds: xr.Dataset) -> Iterator[dict[str, Any]]:
    for number, places, is_stable in pieces_of(ds):
        one = ds.isel(curve=number)
        yield _feature(
            "curve",
            "LineString",
            places.tolist(),
            number=number,
            kind=CURVE_KINDS[int(one["kind"])],
            period=int(one["orbit_period"]),
            stable=is_stable,
            changes=int(one["n_effects"]),
            no_effect=str(one["effect"].values),
        )


def _lines(ds: xr.Dataset) -> Iterator[dict[str, Any]]:
    words = words_of(ds["line_what"])
    for number in range(ds.sizes["line"]):
        places, kind = line_places(ds, number).tolist(), words[int(ds["line_what"][number])]
        shape = ("LineString", places) if len(places) > 1 else ("Point", places[0])
        yield _feature("line", *shape, number=number, kind=kind, period=int(ds["line_period"][number]))


def _not_explained(ds: xr.Dataset) -> Iterator[dict[str, Any]]:
    sets = words_of(ds["change_set"])
    for k in open_changes(ds):
        one = ds.isel(change=k)
        yield _feature(
            "not explained",
            "Point",
            [float(one["change_first"]), float(one["change_second"])],
            attractor=int(one["change_attractor"]),
            kind=sets[int(one["change_set"])],
            period=int(one["change_period"]),
            why=str(one["why"].values),
        )
