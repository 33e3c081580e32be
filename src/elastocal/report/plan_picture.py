"""The poses of a plan as a picture: the arm in all of them, the cell, the tracker."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from elastocal.cell.work_cell import Cell
from elastocal.cell.workspace_rules import Solid
from elastocal.errors import require
from elastocal.files import atomic_writer
from elastocal.model.chain import Chain
from elastocal.planning.bodies import CORNERS, mesh_hull
from elastocal.report.arm_view import frames_at
from elastocal.units import Array, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROUND = 49  # points of a full circle; a multiple of 4, and the first again
LENGTHWISE = 4  # lines along a cylinder or capsule


def wireframe(solid: Solid) -> list[Array]:
    """Polylines (k, 3) in m in the carrier's frame that show the solid's edges or outline."""
    if solid.shape == "mesh":
        points, triangles = mesh_hull(solid)
        lines = [points[[*r_factor, r_factor[0]]] for r_factor in triangles]
    else:
        lines = {"box": _box, "sphere": _sphere, "cylinder": _cylinder, "capsule": _capsule}[
            solid.shape
        ](solid.size)
    R, p = solid.placement[:3, :3], solid.placement[:3, 3]
    return [line @ R.T + p for line in lines]


def _box(size: Array) -> list[Array]:
    corners = CORNERS * size
    apart = (CORNERS[:, None] != CORNERS[None]).sum(axis=2)
    return [corners[[i, j]] for i, j in np.argwhere(np.triu(apart == 1))]


def _circle(radius: float, first: int, second: int, part: float = 1.0) -> Array:
    """The circle, or that part of it, from axis `first` towards axis `second`."""
    angle = np.linspace(0.0, 2 * np.pi * part, int((ROUND - 1) * part) + 1)
    points = np.zeros((len(angle), 3))
    points[:, first], points[:, second] = radius * np.cos(angle), radius * np.sin(angle)
    return points


def _sphere(size: Array) -> list[Array]:
    return [_circle(float(size[0]), *axes) for axes in ((0, 1), (1, 2), (2, 0))]


def _cylinder(size: Array) -> list[Array]:
    radius, half = float(size[0]), np.array([0.0, 0.0, size[1] / 2])
    ring = _circle(radius, 0, 1)
    feet = ring[: ROUND - 1 : (ROUND - 1) // LENGTHWISE]
    return [ring - half, ring + half, *(np.stack([p - half, p + half]) for p in feet)]


def _capsule(size: Array) -> list[Array]:
    radius, half = float(size[0]), np.array([0.0, 0.0, size[1] / 2])
    caps = [_circle(radius, axis, 2, 0.5) for axis in (0, 1)]
    up = [arc + half for arc in caps]
    down = [arc * [1.0, 1.0, -1.0] - half for arc in caps]
    return [*_cylinder(size), *up, *down]


SUFFIXES = (".png", ".svg")
# Okabe and Ito's colours: told apart by colour-blind readers; each group has its own sign too.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
SIGNS = ("o", "s", "^", "D", "v", "P")
INK, SOLID = "#1a1a1a", "#7f7f7f"
MOST_NUMBERED, MOST_IN_SPACE = 80, 30  # beyond that numbers hide each other
STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "text.parse_math": False,  # names from files are not formulas
    "svg.hashsalt": "elastocal",
    "axes.titlelocation": "left",
    "axes.titlesize": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e2e2e2",
    "grid.linewidth": 0.6,
}
VIEWS = ((0, 1, "top view"), (0, 2, "side view"))
AXES = ("x", "y", "z")


def write_plan_picture(
    path: str | Path,
    cell: Cell,
    chain: Chain,
    q: Array,
    *,
    names: Sequence[str],
    group: IntArray,
    group_names: Sequence[str],
) -> None:
    """Draw the arm at `q` (N, n) in space, from above and from the side; PNG or SVG by suffix.

    `names`: one per pose, written at its flange; `group` (N,) colours it: the level of a joint,
    or the load, named by `group_names`.  Lengths in m in the data's frame; the arm is rigid.
    Raises InputError for another suffix and an unwritable place.
    """
    suffix = Path(path).suffix.lower()
    require(suffix in SUFFIXES, f"{path}: a picture of poses is written as .png or .svg")
    from matplotlib.style import context

    with context(["default", STYLE]):
        figure = draw_plan(cell, chain, q, names=names, group=group, group_names=group_names)
        picture = BytesIO()
        # No date, no version: the same plan gives the same file.
        nothing = {"Date": None, "Creator": None} if suffix == ".svg" else {"Software": None}
        figure.savefig(picture, format=suffix[1:], dpi=150, metadata=nothing)
    with atomic_writer(path) as handle:
        handle.buffer.write(picture.getvalue())


def draw_plan(
    cell: Cell,
    chain: Chain,
    q: Array,
    *,
    names: Sequence[str],
    group: IntArray,
    group_names: Sequence[str],
) -> Figure:
    """The figure of `write_plan_picture`."""
    from matplotlib.figure import Figure

    arms, markers = pose_lines(cell, chain, np.asarray(q, dtype=float))
    figure = Figure(figsize=(13.0, 7.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
    space: Any = figure.add_subplot(grid[:, 0], projection="3d")
    views = [figure.add_subplot(grid[k, 1]) for k in range(len(VIEWS))]
    _draw_cell(cell, space, views)
    for k, label in enumerate(group_names):
        chosen = np.flatnonzero(np.asarray(group) == k)
        if len(chosen):
            _draw_poses(space, views, arms[chosen], markers[chosen], k, f"{label} ({len(chosen)})")
    if len(q) <= MOST_NUMBERED:
        _number(space, views, arms[:, -1], names)
    _finish(space, views, arms, markers, cell)
    handles, labels = space.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 7),
                  frameon=False)  # fmt: skip
    return figure


def pose_lines(cell: Cell, chain: Chain, q: Array) -> tuple[Array, Array]:
    """Polylines (N, n + 2, 3) base – joints – flange, and markers (N, M, 3), of the data."""
    frames, flange = frames_at(cell, chain, q)
    arms = np.concatenate([frames[:, :, :3, 3], flange[:, None, :3, 3]], axis=1)
    local = np.array(list(cell.tool.markers.values())).reshape(-1, 3)
    at = local @ flange[:, :3, :3].transpose(0, 2, 1) + flange[:, None, :3, 3]
    return arms, at


def _draw_poses(
    space: Any, views: list[Axes], arms: Array, markers: Array, k: int, label: str
) -> None:
    colour, sign = COLOURS[k % len(COLOURS)], SIGNS[(k + k // len(COLOURS)) % len(SIGNS)]
    # NaN between poses: one line per group instead of one per pose.
    gap = np.full((len(arms), 1, 3), np.nan)
    lines = np.concatenate([arms, gap], axis=1).reshape(-1, 3)
    spokes = np.stack([np.broadcast_to(arms[:, -1:], markers.shape), markers,
                       np.full(markers.shape, np.nan)], axis=2).reshape(-1, 3)  # fmt: skip
    tips, dots = arms[:, -1], markers.reshape(-1, 3)
    for axes, pick in _all(space, views):
        axes.plot(*pick(lines), color=colour, linewidth=1.3, alpha=0.55, solid_joinstyle="round")
        axes.plot(*pick(spokes), color=colour, linewidth=0.6, alpha=0.6)
        axes.plot(*pick(dots), ".", color=colour, markersize=2.5)
        axes.plot(*pick(tips), sign, color=colour, markersize=5.5, markeredgecolor="white",
                  markeredgewidth=0.5, label=label)  # fmt: skip


def _draw_cell(cell: Cell, space: Any, views: list[Axes]) -> None:
    """Obstacles, boundaries of keep-out half-spaces that stand upright in a view, the tracker."""
    from scipy.spatial import ConvexHull

    for solid in cell.workspace.obstacles:
        lines = wireframe(solid)
        for axes, pick in _all(space, views):
            for line in lines:
                axes.plot(*pick(line), color=SOLID, linewidth=0.7)
        for axes, (first, second, _) in zip(views, VIEWS, strict=True):
            flat = np.concatenate(lines)[:, [first, second]]
            outline = flat[ConvexHull(flat).vertices]
            axes.fill(*outline.T, color=SOLID, alpha=0.15, linewidth=0)
            top = (float(outline[:, 0].mean()), float(outline[:, 1].max()))
            axes.annotate(solid.name, top, (0, 2), textcoords="offset points", color=INK,
                          fontsize=7.5, ha="center")  # fmt: skip
    for wall in cell.workspace.keep_out:
        for axes, (first, second, _) in zip(views, VIEWS, strict=True):
            across = np.array([-wall.normal[second], wall.normal[first]])
            if abs(float(np.linalg.norm(across)) - 1) < 1e-6:
                x, y = (float(v) for v in wall.point[[first, second]])
                beyond = (x + float(across[0]), y + float(across[1]))
                axes.axline((x, y), beyond, color=SOLID, linewidth=1.0, linestyle="--")
    for axes, pick in _all(space, views):
        axes.plot(*pick(cell.tracker.position[None]), "*", color=INK, markersize=11,
                  label="tracker", linestyle="none")  # fmt: skip


def _number(space: Any, views: list[Axes], tips: Array, names: Sequence[str]) -> None:
    from matplotlib.patheffects import withStroke

    few = len(names) <= MOST_IN_SPACE
    look: dict[str, Any] = {
        "fontsize": 7.5 if few else 6.0,
        "color": INK,
        "path_effects": [withStroke(linewidth=1.5, foreground="white")],
    }
    for tip, name in zip(tips, names, strict=True):
        if few:
            space.text(*tip, f" {name}", **look)
        for axes, (first, second, _) in zip(views, VIEWS, strict=True):
            at = (float(tip[first]), float(tip[second]))
            axes.annotate(name, at, (4, 3), textcoords="offset points", **look)


def _finish(space: Any, views: list[Axes], arms: Array, markers: Array, cell: Cell) -> None:
    """Equal scales, titles, and limits that hold arm, markers and tracker."""
    points = np.concatenate(
        [arms.reshape(-1, 3), markers.reshape(-1, 3), cell.tracker.position[None],
         *(line for solid in cell.workspace.obstacles for line in wireframe(solid))]
    )  # fmt: skip
    low, high = points.min(axis=0), points.max(axis=0)
    low, high = low - 0.05 * (high - low).max(), high + 0.05 * (high - low).max()
    space.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    space.set_box_aspect(high - low)
    space.set(xlabel="x in m", ylabel="y in m", zlabel="z in m")
    for axes, (first, second, title) in zip(views, VIEWS, strict=True):
        axes.set(xlim=(low[first], high[first]), ylim=(low[second], high[second]), title=title)
        axes.set(xlabel=f"{AXES[first]} in m", ylabel=f"{AXES[second]} in m")
        axes.set_aspect("equal")
        axes.grid(True)
        axes.set_axisbelow(True)


def _all(space: Any, views: list[Axes]) -> list[tuple[Any, Any]]:
    """Every panel with what it shows of points (k, 3)."""
    flat = [(a, lambda p, v=v: (p[:, v[0]], p[:, v[1]])) for a, v in zip(views, VIEWS, strict=True)]
    return [(space, lambda p: tuple(p.T)), *flat]
