"""Cut the unit square into regions along lines that are known up to tolerances.

Lines are joined where they come within their tolerances of each other, noded on a grid (snap rounding: Hobby,
Computational Geometry 13, 1999), and polygonised; faces thinner than the tolerance are merged into a neighbour.
Segments are sorted by their coordinates before anything depends on their order, so that neither the order of the lines
nor that of their points matters.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

SNAPPING_GRID = 2.0**-36
"""Spacing of the grid on which all nodes lie; the sides of the square are on it."""


@dataclass(frozen=True, eq=False)
class Region:
    """A region of the plane."""

    area: float  # share of the plane
    label: np.ndarray  # (2,): centre of the largest inscribed circle, to some percent of its radius
    rings: tuple[np.ndarray, ...]  # each (n, 2), closed; the outer one first, then holes


@dataclass(frozen=True)
class Border:
    """The border of two regions along a line; where lines run within their tolerances, it is listed for each."""

    regions: tuple[int, int]  # rising
    line: int
    length: float
    middle: tuple[float, float]  # half way along its longest part


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Regions of the unit square, by falling area, and their borders."""

    regions: tuple[Region, ...]
    borders: tuple[Border, ...]
    n_slivers: int  # faces that were merged as thinner than the tolerance
    dangling: tuple[int, ...]  # lines of which a part bounds no region

    def region_of(self, points: np.ndarray) -> np.ndarray:
        """Return the region of each point, shape (n,): -1 outside the square, on a border one of its regions."""
        import shapely

        found = np.full(len(points), -1)
        polygons = [shapely.Polygon(region.rings[0], region.rings[1:]) for region in self.regions]
        region, point = shapely.STRtree(shapely.points(points)).query(polygons, predicate="intersects")
        found[point] = region
        return found


@dataclass(frozen=True, eq=False)
class _Drawing:
    """The lines near the square, and its sides as the last line, with the tolerance 0.

    A line has several pieces if it leaves the surroundings of the square.
    """

    pieces: Any  # (piece,) geometries
    xy: np.ndarray  # (vertex, 2)
    piece: np.ndarray  # (vertex,)
    line: np.ndarray  # (vertex,)
    tolerances: np.ndarray  # (line,)
    begins: np.ndarray  # (segment,): the first vertex of each
    segments: Any  # (segment,) geometries

    def lines_at(self, ends: np.ndarray, tolerance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of a segment between `ends` and a line at its middle, up to both tolerances; NaN: exactly."""
        import shapely

        middles, exact = shapely.points(ends.mean(axis=1)), 2.0 * SNAPPING_GRID
        reach = np.nan_to_num(tolerance + self.tolerances.max()) + exact
        segment, hit = shapely.STRtree(self.segments).query(middles, predicate="dwithin", distance=reach)
        line, gap = self.line[self.begins[hit]], shapely.distance(middles[segment], self.segments[hit])
        is_at = gap <= np.nan_to_num(tolerance[segment] + self.tolerances[line]) + exact
        segment, line = np.unique(np.stack([segment, line])[:, is_at & (line < len(self.tolerances) - 1)], axis=1)
        return segment, line


def arranged(lines: Sequence[np.ndarray], tolerances: Sequence[float]) -> Arrangement:
    """Cut the unit square along polylines, each of shape (n, 2), with the largest distance of each from its curve.

    A face is a sliver if each of its points is within the tolerance of one of its lines. A contact of two regions
    shorter than four tolerances of its line is no border: three lines through one point can bound a sliver with sides
    of 3.5 tolerances.
    """
    import shapely

    joints, widths = _joints(_drawn(lines, tolerances))
    drawing = _drawn([*lines, *map(shapely.get_coordinates, joints)], [*tolerances, *widths])
    ends = _noded(drawing)
    polygons, sides = _faces(ends)
    segment, line = drawing.lines_at(ends, np.full(len(ends), np.nan))
    dangles = (sides[segment] < 0).all(axis=1) & (line < len(lines))
    dangling = _dangling(drawing, ends[segment[dangles]], line[dangles])
    if (thin := _thin(drawing, ends, polygons, sides, segment, line)).any():
        owner = _merged(ends, sides, thin, shapely.area(polygons))
        own = np.full(len(ends), np.nan)  # beside a sliver, the border is that of all lines within their tolerances
        near = np.append(thin, False)[sides[segment]].any(axis=1)
        np.fmax.at(own, segment[near], drawing.tolerances[line[near]])
        kept = owner[sides[:, 0]] != owner[sides[:, 1]]
        ends = ends[kept]
        polygons, sides = _faces(ends)
        segment, line = drawing.lines_at(ends, own[kept])
    regions, number = _regions(polygons)
    neighbours = np.sort(number[sides], axis=1)[segment]
    real = (line < len(lines)) & (neighbours[:, 0] >= 0)
    borders = _borders(drawing, ends[segment[real]], neighbours[real], line[real])
    return Arrangement(regions, borders, int(thin.sum()), dangling)


def _drawn(lines: Sequence[np.ndarray], tolerances: Sequence[float]) -> _Drawing:
    import shapely

    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
    clipped = shapely.clip_by_rect([shapely.linestrings(line) for line in (*lines, square)], -0.1, -0.1, 1.1, 1.1)
    pieces, of = shapely.get_parts(clipped, return_index=True)
    xy, piece = shapely.get_coordinates(pieces, return_index=True)
    begins = np.flatnonzero((piece[1:] == piece[:-1]) & (xy[1:] != xy[:-1]).any(axis=1))
    segments = shapely.linestrings(_between(xy, begins))
    return _Drawing(pieces, xy, piece, of[piece], np.array([*tolerances, 0.0]), begins, segments)


def _between(xy: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Return the segments from these points to the next, shape (segment, 2, 2), each from its lesser end."""
    ends = np.stack([xy[begins], xy[begins + 1]], axis=1)
    (x, y), (u, v) = ends[:, 0].T, ends[:, 1].T
    return np.where(((x > u) | ((x == u) & (y > v)))[:, None, None], ends[:, ::-1], ends)


def _joints(drawing: _Drawing) -> tuple[Any, np.ndarray]:
    """Return segments that join lines within their tolerances of each other, and the mean of both tolerances.

    An end of a line is joined to the nearest other piece, and to those that end beside it. Elsewhere vertices in
    sequence that are near a piece are a run. If it does not cross the piece, its closest vertex is joined, for the
    distance of two polylines is that of a vertex of one.
    """
    import shapely

    near, hit, gap, reach = _near(drawing)
    xy, target = drawing.xy[near], drawing.piece[drawing.begins[hit]]
    is_first, is_last = np.diff(drawing.piece, prepend=-1) != 0, np.diff(drawing.piece, append=-1) != 0
    of_target = np.stack([drawing.xy[is_first][target], drawing.xy[is_last][target]])
    at_end = np.linalg.norm(of_target - xy, axis=2).min(axis=0) <= reach
    least = np.full(len(drawing.xy), np.inf)
    np.minimum.at(least, near, gap)
    is_end = (is_first | is_last)[near]
    joined = is_end & (at_end | (gap == least[near]))

    run = np.cumsum((np.diff(near, prepend=-1) != 1) | (np.diff(target, prepend=-1) != 0) | is_first[near])
    order = np.lexsort((*xy.T, gap, run))
    for members in np.split(order, np.flatnonzero(np.diff(run[order])) + 1):
        if len(members) and not is_end[members].any() and not at_end[closest := members[0]]:
            around = slice(near[members].min() - 1, near[members].max() + 2)
            stretch, other = shapely.linestrings(drawing.xy[around]), drawing.pieces[target[closest]]
            is_own = drawing.piece[around.start] == target[closest]
            joined[closest] = is_own or not shapely.intersects(stretch, other)
    joined &= gap > 0.0
    return shapely.shortest_line(shapely.points(xy[joined]), drawing.segments[hit[joined]]), 0.5 * reach[joined]


def _near(drawing: _Drawing) -> tuple[np.ndarray, ...]:
    """Return vertices within the tolerances of a piece, its closest segment, their distance, and both tolerances.

    Rows rise by piece, then by vertex. A vertex is near its own piece only if it is further from it along the piece.
    """
    import shapely

    points, begins, tolerance = shapely.points(drawing.xy), drawing.begins, drawing.tolerances[drawing.line]
    tree = shapely.STRtree(drawing.segments)
    vertex, hit = tree.query(points, predicate="dwithin", distance=tolerance + tolerance.max())
    arc = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(drawing.xy, axis=0), axis=1)))
    along = np.maximum(arc[begins[hit]] - arc[vertex], arc[vertex] - arc[begins[hit] + 1])
    target, gap = drawing.piece[begins[hit]], shapely.distance(points[vertex], drawing.segments[hit])
    reach = tolerance[vertex] + tolerance[begins[hit]]
    near = (gap <= reach) & ((drawing.piece[vertex] != target) | (along > 2.0 * reach))
    order = np.lexsort((gap, vertex, target))
    order = order[near[order]]
    order = order[(np.diff(vertex[order], prepend=-1) != 0) | (np.diff(target[order], prepend=-1) != 0)]
    return vertex[order], hit[order], gap[order], reach[order]


def _noded(drawing: _Drawing) -> np.ndarray:
    """Return the segments in the square between all nodes, shape (segment, 2, 2), sorted."""
    import shapely

    union = shapely.get_parts(shapely.union_all(drawing.pieces, grid_size=SNAPPING_GRID))
    xy, part = shapely.get_coordinates(union, return_index=True)
    ends = np.unique(_between(xy, np.flatnonzero(part[1:] == part[:-1])), axis=0)
    middles = ends.mean(axis=1)
    is_inside = ((middles >= 0.0) & (middles <= 1.0)).all(axis=1)
    return np.asarray(ends[is_inside])


def _faces(ends: np.ndarray) -> tuple[Any, np.ndarray]:
    """Return the polygons between sorted segments, and the two beside each segment, -1 for none."""
    import shapely

    polygons = shapely.get_parts(shapely.polygonize(shapely.linestrings(ends)))
    rings, of = shapely.get_rings(polygons, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    begins = np.flatnonzero(ring[1:] == ring[:-1])
    nodes = np.unique(ends @ [1.0, 1.0j])  # complex numbers are sorted by x, then by y

    def key(segments: np.ndarray) -> np.ndarray:
        first, second = np.searchsorted(nodes, segments @ [1.0, 1.0j]).T
        return np.asarray(first * len(nodes) + second)

    segment, face = np.searchsorted(key(ends), key(_between(xy, begins))), of[ring[begins]]
    order = np.argsort(segment, kind="stable")
    sides = np.full((len(ends), 2), -1)
    sides[segment[order], (np.diff(segment[order], prepend=-1) == 0).astype(int)] = face[order]
    return polygons, sides


def _thin(
    drawing: _Drawing, ends: np.ndarray, polygons: Any, sides: np.ndarray, segment: np.ndarray, line: np.ndarray
) -> np.ndarray:
    """Return which faces are slivers."""
    import shapely

    face = sides[segment].T.ravel()
    rows = np.stack([face, np.tile(line, 2), np.tile(segment, 2)])[:, face >= 0]
    widest = np.zeros(len(polygons))
    np.maximum.at(widest, rows[0], drawing.tolerances[rows[1]])
    # a disc of the radius area / perimeter fits into any face
    thin = shapely.area(polygons) < widest * shapely.length(polygons)
    rows = rows[:, thin[rows[0]]]
    rows = rows[:, np.lexsort(rows[::-1])]
    (face, line), of = np.unique(rows[:2], axis=1, return_inverse=True)
    bands = shapely.buffer(
        shapely.multilinestrings(shapely.linestrings(ends[rows[2]]), indices=of), drawing.tolerances[line]
    )
    rest = polygons.copy()
    for one, band in zip(face, bands, strict=True):
        rest[one] = shapely.difference(rest[one], band)
    return np.asarray(thin & shapely.is_empty(rest))


def _merged(ends: np.ndarray, sides: np.ndarray, thin: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Return the face that each face belongs to after its merger, and -1 for none (last).

    Slivers, the smallest first, are merged into the neighbour with which they share the longest border.
    """
    shared: dict[int, dict[int, float]] = defaultdict(lambda: defaultdict(float))
    beside = np.append(thin, False)[sides].any(axis=1) & (sides >= 0).all(axis=1)
    lengths = np.linalg.norm(ends[beside, 1] - ends[beside, 0], axis=1)
    for (one, other), length in zip(sides[beside].tolist(), lengths.tolist(), strict=True):
        shared[one][other] += length
        shared[other][one] += length
    into = {}
    slivers = np.flatnonzero(thin)
    for sliver in slivers[np.argsort(areas[slivers], kind="stable")].tolist():
        if neighbours := shared.pop(sliver, None):
            target = into[sliver] = max(neighbours, key=lambda face: (neighbours[face], face))
            for face, length in neighbours.items():
                del shared[face][sliver]
                if face != target:
                    shared[target][face] += length
                    shared[face][target] += length
    owner = np.append(np.arange(len(thin)), -1)
    for sliver in reversed(into):
        owner[sliver] = owner[into[sliver]]
    return owner


def _regions(polygons: Any) -> tuple[tuple[Region, ...], np.ndarray]:
    """Return the regions, and the number of each polygon, and of none (-1, last)."""
    import shapely

    polygons, areas, lengths = shapely.normalize(polygons), shapely.area(polygons), shapely.length(polygons)
    # the radius is at least area / length; the second bound keeps the search in long strips short
    tolerance = np.maximum(0.02 * areas / lengths, 1e-4 * lengths)
    circles = shapely.maximum_inscribed_circle(polygons, tolerance=tolerance)
    labels = shapely.get_coordinates(shapely.get_point(circles, 0))
    order = np.lexsort((*labels.T, -areas.round(12)))
    rings = [tuple(map(shapely.get_coordinates, shapely.get_rings(polygon))) for polygon in polygons]
    number = np.append(np.argsort(order), -1)
    return tuple(Region(float(areas[k]), labels[k], rings[k]) for k in order), number


def _chains(ends: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, Any]:
    """Return the length of the segments of each number in `of` (sorted), and the longest chain of them."""
    import shapely

    together = shapely.multilinestrings(shapely.linestrings(ends), indices=of)
    chains, number = shapely.get_parts(shapely.line_merge(together), return_index=True)
    order = np.lexsort((-shapely.length(chains), number))
    return shapely.length(together), chains[order[np.diff(number[order], prepend=-1) != 0]]


def _borders(drawing: _Drawing, ends: np.ndarray, regions: np.ndarray, line: np.ndarray) -> tuple[Border, ...]:
    import shapely

    rows, of = np.unique(np.column_stack([regions, line]), axis=0, return_inverse=True)
    order = np.argsort(of, kind="stable")
    lengths, longest = _chains(ends[order], of[order])
    middles = shapely.get_coordinates(shapely.line_interpolate_point(longest, 0.5, normalized=True)).tolist()
    return tuple(
        Border((one, other), k, length, (x, y))
        for (one, other, k), length, (x, y) in zip(rows.tolist(), lengths.tolist(), middles, strict=True)
        if length > 4.0 * drawing.tolerances[k]
    )


def _dangling(drawing: _Drawing, ends: np.ndarray, line: np.ndarray) -> tuple[int, ...]:
    """Return the lines with segments that bound no region and are longer than a line may run past another."""
    import shapely

    order = np.argsort(line, kind="stable")
    rows, of = np.unique(line[order], return_inverse=True)
    longest = shapely.length(_chains(ends[order], of)[1])
    return tuple(rows[longest > drawing.tolerances[rows] + drawing.tolerances.max()].tolist())
