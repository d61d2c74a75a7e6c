"""The dumb oracle: each op again in plain Python, with no structure in common with csrc/. Slow on purpose."""

from fractions import Fraction
from math import floor

# --- hash_table -------------------------------------------------------------------------------------------------------


def vertex_key(level: int, plane: int, i: int, j: int) -> tuple[int, int]:
    """(key of the brick, bit of the vertex in its mask), by division with remainder instead of shifts."""
    brick_i, local_i = divmod(i, 8)
    brick_j, local_j = divmod(j, 8)
    key = ((level * 4 + plane) * 2**28 + brick_i + 2**27) * 2**28 + brick_j + 2**27
    return key, local_i + 8 * local_j


def brick_masks(vertices) -> dict[int, int]:
    """Mask (an unsigned number) of each brick that holds one of the vertices (level, plane, i, j), keys ascending."""
    masks: dict[int, int] = {}
    for vertex in vertices:
        key, bit = vertex_key(*vertex)
        masks[key] = masks.get(key, 0) | 1 << bit
    return dict(sorted(masks.items()))


def signed(mask: int) -> int:
    """The same 64 bits as a signed number, as tensors hold them."""
    return mask - 2**64 if mask >= 2**63 else mask


class DictTable:
    """Hash table by a dict from brick key to [number, mask]."""

    def __init__(self):
        self.bricks: dict[int, list[int]] = {}

    def insert(self, masks: dict[int, int]) -> int:
        before = len(self.bricks)
        for key in sorted(masks):
            self.bricks.setdefault(key, [len(self.bricks), 0])[1] |= masks[key]
        return len(self.bricks) - before

    def find(self, vertex) -> int:
        key, bit = vertex_key(*vertex)
        number, mask = self.bricks.get(key, (0, 0))
        return number * 64 + bit if mask >> bit & 1 else -1


# --- hull_cells -------------------------------------------------------------------------------------------------------


def turn(a, b, c):
    """Twice the signed area of a triangle; exact for integers and fractions."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def hull_corners(points) -> list:
    """Corners of the convex hull by gift wrapping, counter-clockwise from the lowest (u, v); exact."""
    points = sorted(set(points))
    hull = [points[0]]
    while True:
        at, following = hull[-1], None
        for p in points:
            if p == at:
                continue
            side = turn(at, following, p) if following else -1
            further = following and max(abs(p[0] - at[0]), abs(p[1] - at[1])) > max(
                abs(following[0] - at[0]), abs(following[1] - at[1])
            )
            if side < 0 or (side == 0 and further):
                following = p
        if following is None or following == hull[0]:
            return hull
        hull.append(following)


def scaled_hull(corners, scale) -> list:
    """Eq. 2: scaled about the centroid of the area by the shoelace formula; without area about the mean corner."""
    sides = list(zip(corners, corners[1:] + corners[:1], strict=True))
    cross = [a[0] * b[1] - a[1] * b[0] for a, b in sides]
    if sum(cross) == 0:
        centre = [sum(c[axis] for c in corners) / Fraction(len(corners)) for axis in (0, 1)]
    else:
        centre = [
            sum(k * (a[axis] + b[axis]) for k, (a, b) in zip(cross, sides, strict=True)) / (3 * Fraction(sum(cross)))
            for axis in (0, 1)
        ]
    return [tuple(m + scale * (c[axis] - m) for axis, m in enumerate(centre)) for c in corners]


def clip(polygon, axis, bound, keep_above) -> list:
    """The part of a convex polygon on one side of a line (closed): Sutherland and Hodgman."""
    sign = 1 if keep_above else -1
    result = []
    for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        da, db = sign * (a[axis] - bound), sign * (b[axis] - bound)
        if da >= 0:
            result.append(a)
        if da * db < 0:
            t = Fraction(da) / (da - db)
            result.append(tuple(p + t * (q - p) for p, q in zip(a, b, strict=True)))
    return result


def touches(polygon, i, j) -> bool:
    """Whether some point of the closed polygon has floor(u) = i and floor(v) = j. By convexity it has one if it has a
    point of the closed cell left of its right side and another one below its upper side: their midpoint."""
    for axis, bound, above in ((0, i, True), (0, i + 1, False), (1, j, True), (1, j + 1, False)):
        polygon = clip(polygon, axis, bound, above)
        if not polygon:
            return False
    return min(p[0] for p in polygon) < i + 1 and min(p[1] for p in polygon) < j + 1


def polygon_vertices(polygon) -> set:
    """Vertices (i, j) of all cells that touch a polygon given in cells: every cell of its bounding box is tried."""
    columns = range(floor(min(p[0] for p in polygon)), floor(max(p[0] for p in polygon)) + 1)
    rows = range(floor(min(p[1] for p in polygon)), floor(max(p[1] for p in polygon)) + 1)
    touched = [(i, j) for i in columns for j in rows if touches(polygon, i, j)]
    return {(i + di, j + dj) for i, j in touched for di in (0, 1) for dj in (0, 1)}


AXES = ((0, 1), (1, 2), (2, 0))  # xy, yz, zx


def plane_hulls(points, origin, scale) -> list:
    """Exact scaled hulls of points (rows of three numbers) on the three planes."""
    exact = [[Fraction(x) for x in p] for p in [*points, origin]]
    return [scaled_hull(hull_corners([(p[a], p[b]) for p in exact]), Fraction(scale)) for a, b in AXES]


def hull_bricks(hulls, cell_sizes) -> dict[int, int]:
    """Mask of every brick for hulls in metres."""
    vertices = [
        (level, plane, i, j)
        for level, size in enumerate(cell_sizes)
        for plane, hull in enumerate(hulls)
        for i, j in polygon_vertices([tuple(x / Fraction(size) for x in corner) for corner in hull])
    ]
    return brick_masks(vertices)
