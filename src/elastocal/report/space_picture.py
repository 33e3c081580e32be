"""The still picture of a 3-D view: for print, and for readers without script or WebGL."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from elastocal.report.space import Posed, Space
from elastocal.report.svg import ARM, FAINT, INK, SERIES, drawn
from elastocal.report.words import short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

WIDTH = 9.9
MOST_NUMBERED = 40
# Rows: to the right and upwards on paper, and towards the reader.
_TURN, _TILT = np.radians(-50.0), np.radians(22.0)
OBLIQUE = np.array(
    [
        [-np.sin(_TURN), np.cos(_TURN), 0.0],
        [-np.sin(_TILT) * np.cos(_TURN), -np.sin(_TILT) * np.sin(_TURN), np.cos(_TILT)],
        [np.cos(_TILT) * np.cos(_TURN), np.cos(_TILT) * np.sin(_TURN), np.sin(_TILT)],
    ]
)
TOP = np.eye(3)
SIDE = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])


def space_picture(space: Space, title: str) -> str:
    """SVG: the first pose seen obliquely, and all poses from above and from the side.

    `title` says what it shows to those who cannot see it; it is not user text.
    """

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
        large = figure.add_subplot(grid[:, 0])
        _draw(large, space, OBLIQUE, whole=False)
        large.set_axis_off()
        for k, (view, name, up) in enumerate(((TOP, "from above", "y"), (SIDE, "side", "z"))):
            axes = figure.add_subplot(grid[k, 1])
            _draw(axes, space, view, whole=True)
            axes.set_title(name)
            axes.set_xlabel("x in m")
            axes.set_ylabel(f"{up} in m")

    return drawn(draw, WIDTH, 5.6, title)


def _draw(axes: Axes, space: Space, view: Array, whole: bool) -> None:
    """`whole`: all poses as lines; else the first as bodies, and with arrows it alone."""
    shown = space.poses[space.first]
    for shell in space.shells.around:
        _fill(axes, shell.points @ view.T, FAINT, 0.25)
    if whole or not space.has_arrows:
        for pose in space.poses:
            line = pose.line @ view.T
            axes.plot(line[:, 0], line[:, 1], color=SERIES[0], linewidth=0.9, alpha=0.5)
    if whole:
        for pose in space.poses:
            if not space.has_arrows and len(space.poses) <= MOST_NUMBERED:
                tip = pose.line[-1] @ view.T
                axes.annotate(short_name(pose.name, 6), (tip[0], tip[1]), (3, 2),
                              textcoords="offset points", fontsize=7)  # fmt: skip
    else:
        _bodies(axes, space, view)
    for pose in space.poses if whole else (shown,):
        _markers(axes, pose, view, spokes=not whole)
        if pose.arrows is not None:
            _arrows(axes, pose, space.scale, view)
    if space.tracker is not None:
        at = view @ space.tracker
        axes.plot([at[0]], [at[1]], "D", color=SERIES[2], markersize=6)
        axes.annotate("tracker", (at[0], at[1]), (6, 3), textcoords="offset points", fontsize=8)
    axes.set_aspect("equal")
    drawn_poses = space.poses if whole or not space.has_arrows else (shown,)
    _limit(axes, space, view, drawn_poses, [] if whole else space.bodies)


def _limit(
    axes: Axes, space: Space, view: Array, poses: Sequence[Posed], bodies: list[Array]
) -> None:
    """Limits that hold arms, arrows and tracker; of what stands around, what lies within."""
    points = list(bodies)
    points += [points for p in poses for points in (p.line, p.markers)]
    points += [p.markers + space.scale * p.arrows for p in poses if p.arrows is not None]
    points += [] if space.tracker is None else [space.tracker[None]]
    flat = np.vstack(points) @ view.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = 0.09 * float((high - low)[:2].max())
    axes.set_xlim(float(low[0]) - room, float(high[0]) + room)
    axes.set_ylim(float(low[1]) - room, float(high[1]) + room)


def _bodies(axes: Axes, space: Space, view: Array) -> None:
    """Silhouettes of the first pose's bodies, the furthest first."""
    placed = [points @ view.T for points in space.bodies]
    for points in sorted(placed, key=lambda p: float(p[:, 2].mean())):
        _fill(axes, points, ARM, 1.0)


def _fill(axes: Axes, points: Array, colour: str, alpha: float) -> None:
    from scipy.spatial import ConvexHull, QhullError

    try:
        outline = points[ConvexHull(points[:, :2]).vertices]
    except QhullError:
        return  # seen edge on
    axes.fill(outline[:, 0], outline[:, 1], facecolor=colour, edgecolor=INK, linewidth=0.5,
              alpha=alpha)  # fmt: skip


def _markers(axes: Axes, pose: Posed, view: Array, spokes: bool) -> None:
    at, tip = pose.markers @ view.T, pose.line[-1] @ view.T
    if spokes:
        for marker in at:
            axes.plot([tip[0], marker[0]], [tip[1], marker[1]], color=INK, linewidth=0.8)
    axes.plot(at[:, 0], at[:, 1], ".", color=INK, markersize=5 if spokes else 2)


def _arrows(axes: Axes, pose: Posed, scale: float, view: Array) -> None:
    assert pose.arrows is not None
    at, step = pose.markers @ view.T, scale * pose.arrows @ view.T
    axes.quiver(at[:, 0], at[:, 1], step[:, 0], step[:, 1], angles="xy", scale_units="xy", scale=1,
                color=SERIES[1], width=0.004, headwidth=3.5, headlength=4, zorder=3)  # fmt: skip
