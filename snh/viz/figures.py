"""Drawn pictures: the path with its error, the map on its three planes, several pictures on one sheet."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

_INK, _FAINT, _GRID, _ACCENT = "#222222", "#b8b8b8", "#e9e9e9", "#1f6fb2"
_PLANES = (("x", "y"), ("y", "z"), ("z", "x"))
_DPI = 100


def path_picture(
    T_est: np.ndarray,
    T_ref: np.ndarray | None = None,
    errors_cm: np.ndarray | None = None,
    up: np.ndarray | None = None,
    title: str = "",
) -> np.ndarray:
    """Picture [H, W, 3] uint8 of a path [N, 4, 4]: seen from above and, with `errors_cm`, its error per frame.

    T_est and T_ref [M, 4, 4] are in one world (apply the alignment of `ate` first); poses that are not finite leave
    gaps. errors_cm [N]: as from `ate`; colours the path. up [3]: direction to look from, by default the one in which
    the path is flattest.
    """
    places = T_est[:, :3, 3]
    axes = _ground_axes(places, up)
    with_error = errors_cm is not None
    figure = _figure(12.8 if with_error else 7.2, 5.6)
    grid = figure.add_gridspec(1, 2, width_ratios=(1, 1)) if with_error else figure.add_gridspec(1, 1)
    plan = figure.add_subplot(grid[0])
    if T_ref is not None:
        plan.plot(*(T_ref[:, :3, 3] @ axes.T).T, color=_FAINT, linewidth=3, label="reference", zorder=1)
    _draw_path(figure, plan, places @ axes.T, errors_cm)
    plan.set(xlabel="m", ylabel="m", title=title or ("path" if up is None else "path, seen from above"))
    plan.grid(color=_GRID)
    plan.set_axisbelow(True)
    plan.set_aspect("equal", adjustable="datalim")
    plan.legend(loc="best", frameon=False)
    _open_frame(plan)
    if errors_cm is not None:
        _draw_error(figure.add_subplot(grid[1]), errors_cm)
    return _picture(figure)


def map_picture(
    vertices: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    cell_sizes: Sequence[float],
    hulls: Sequence[np.ndarray] | None = None,
) -> np.ndarray:
    """Picture [H, W, 3] uint8 of the occupied vertices of a map on its three planes, one colour per level.

    vertices: (level [V], plane [V], (i, j) [V, 2]) as from `occupied_vertices`, in any number of parts. cell_sizes:
    edge of a cell per level, m. hulls: three polygons [M, 2] m to draw on top.
    """
    from matplotlib import colormaps
    from matplotlib.patches import Patch, Polygon

    figure = _figure(13.2, 5.0)
    level, plane, place = (np.concatenate(parts) for parts in zip(*vertices, strict=True))
    colors = colormaps["viridis"](np.linspace(0.15, 0.95, len(cell_sizes)))
    for k, (name_u, name_v) in enumerate(_PLANES):
        axes = figure.add_subplot(1, 3, k + 1)
        for fine in reversed(range(len(cell_sizes))):
            _draw_level(axes, place[(plane == k) & (level == fine)], cell_sizes[fine], colors[fine])
        if hulls is not None:
            axes.add_patch(Polygon(hulls[k], closed=True, fill=False, edgecolor=_INK, linewidth=1.5))
        axes.autoscale_view()
        axes.set(xlabel=f"{name_u}, m", ylabel=f"{name_v}, m", title=f"plane {name_u}{name_v}")
        axes.set_aspect("equal", adjustable="datalim")
        _open_frame(axes)
    labels = [f"{100 * size:.1f} cm: {int((level == n).sum()):,}" for n, size in enumerate(cell_sizes)]
    patches = [Patch(color=color, label=label) for color, label in zip(colors, labels, strict=True)]
    figure.legend(handles=patches, title="cells: vertices", loc="outside right upper", frameon=False)
    return _picture(figure)


def occupied_vertices(brick_keys: np.ndarray, masks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(level [V], plane [V], (i, j) [V, 2]) of the vertices of bricks [B] with masks [B], as in csrc/common/key.h."""
    from snh.mesh.extract import unpack_keys

    level, plane, bricks = unpack_keys(brick_keys)
    row, local = np.nonzero((np.asarray(masks, dtype=np.int64)[:, None] >> np.arange(64)) & 1)
    return level[row], plane[row], 8 * bricks[row] + np.stack([local & 7, local >> 3], axis=-1)


def contact_sheet(
    pictures: Sequence[np.ndarray], captions: Sequence[str] | None = None, columns: int = 2
) -> np.ndarray:
    """Pictures [H, W, 3] uint8 of any sizes on one sheet, row by row, pixel for pixel, captions under them."""
    gap, line = 12, 26 if captions is not None else 0
    height = max(picture.shape[0] for picture in pictures)
    width = max(picture.shape[1] for picture in pictures)
    rows = -(-len(pictures) // columns)
    sheet_width, sheet_height = columns * (width + gap) + gap, rows * (height + line + gap) + gap
    figure = _figure(sheet_width / _DPI, sheet_height / _DPI)
    for n, picture in enumerate(pictures):
        left = gap + n % columns * (width + gap)
        bottom = sheet_height - (n // columns + 1) * (height + line + gap) + line  # figures count from below
        middle = left + width // 2, bottom + height // 2
        figure.figimage(picture, middle[0] - picture.shape[1] // 2, middle[1] - picture.shape[0] // 2, origin="upper")
        if captions is not None:
            figure.text(middle[0] / sheet_width, (bottom - line + 8) / sheet_height, captions[n], ha="center")
    return _picture(figure)


def _ground_axes(places: np.ndarray, up: np.ndarray | None) -> np.ndarray:
    """Two unit vectors [2, 3] of the plane to draw on, the longer side of the path first."""
    finite = places[np.isfinite(places).all(axis=1)]
    spread = finite - finite.mean(axis=0)
    if up is not None:
        spread = spread - np.outer(spread @ up, up)
    _, _, directions = np.linalg.svd(spread, full_matrices=True)
    first = directions[0]
    third = directions[2] if up is None else np.asarray(up, dtype=np.float64)
    return np.stack([first, np.cross(third, first)])


def _draw_path(figure, axes, points: np.ndarray, errors_cm: np.ndarray | None) -> None:
    """The estimated path [N, 2], coloured by its error where it is known."""
    from matplotlib.collections import LineCollection

    axes.plot(*points[0], "o", color=_INK, markersize=6, label="start", zorder=3)
    if errors_cm is None:
        axes.plot(*points.T, color=_ACCENT, linewidth=1.6, label="estimate", zorder=2)
        return
    segments = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), cmap="plasma", linewidth=1.8, zorder=2)
    segments.set_array(errors_cm[1:])
    segments.set_clim(0, np.nanmax(errors_cm))
    axes.add_collection(segments, autolim=True)
    axes.plot([], [], color="#cc4778", linewidth=1.8, label="estimate")
    figure.colorbar(segments, ax=axes, label="error, cm", shrink=0.8)


def _draw_error(axes, errors_cm: np.ndarray) -> None:
    """Error per frame and its RMSE."""
    rmse = float(np.sqrt(np.nanmean(errors_cm**2)))
    axes.fill_between(np.arange(len(errors_cm)), errors_cm, color=_ACCENT, alpha=0.18, linewidth=0)
    axes.plot(errors_cm, color=_ACCENT, linewidth=1.1)
    axes.axhline(rmse, color=_INK, linewidth=1, linestyle="--")
    title = f"error per frame: RMSE {rmse:.2f} cm, largest {np.nanmax(errors_cm):.2f} cm"
    axes.set(xlabel="frame", ylabel="error after rigid alignment, cm", title=title)
    axes.set_xlim(0, max(len(errors_cm) - 1, 1))
    axes.set_ylim(0, 1.15 * max(np.nanmax(errors_cm), rmse))
    axes.grid(color=_GRID)
    axes.set_axisbelow(True)
    _open_frame(axes)


def _draw_level(axes, vertices: np.ndarray, cell: float, color: np.ndarray) -> None:
    """Occupied vertices [V, 2] of one level as squares of a cell around them."""
    if len(vertices) == 0:
        return
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    image = np.zeros((*(high - low + 1)[::-1], 4))
    image[vertices[:, 1] - low[1], vertices[:, 0] - low[0]] = color
    (left, bottom), (right, top) = (low - 0.5) * cell, (high + 0.5) * cell
    axes.imshow(image, extent=(left, right, bottom, top), origin="lower", interpolation="nearest")


def _figure(width: float, height: float):
    """A figure of width x height inches that needs no window and no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width, height), dpi=_DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _open_frame(axes) -> None:
    """Leave the axes' box open above and at the right."""
    axes.spines[["top", "right"]].set_visible(False)


def _picture(figure) -> np.ndarray:
    """The drawn figure [H, W, 3] uint8."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="rgba", dpi=_DPI)
    width, height = (round(size) for size in figure.bbox.size)
    return np.frombuffer(buffer.getvalue(), dtype=np.uint8).reshape(height, width, 4)[..., :3].copy()
