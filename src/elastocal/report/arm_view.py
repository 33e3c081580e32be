"""The arm in its poses with what is to be shown on it, in 3-D and as a still picture."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from elastocal.cell import Cell, Solid
from elastocal.files import atomic_write
from elastocal.measurements import numbered
from elastocal.messages import ElastocalError, load_text, printable, require
from elastocal.model.chain import Chain
from elastocal.model.manipulator import Model
from elastocal.model.observations import Observations
from elastocal.planning import collision
from elastocal.planning.plan import Plan
from elastocal.report import blocks as say
from elastocal.report.figures import ARM, FAINT, INK, SERIES, figure_of, style
from elastocal.units import Array, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MOST_TRIANGLES = 8000  # of all bodies together; more make the page slow and large
MERIDIANS, PARALLELS = 14, 3  # of a cap
# Radii of the first and the last link over the arm's length, where none are stated.
STOUT, SLIM = 0.038, 0.014


@dataclass(frozen=True)
class Shell:
    """A convex body as triangles: `points` (k, 3) m in its carrier's frame, `faces` (f, 3).
    `carrier`: 0 the base frame, i the frame of joint i after its motion; of what stands in the cell
    0 is the data's frame."""

    points: Array
    faces: IntArray
    carrier: int
    name: str = ""


def shells_of(cell: Cell, chain: Chain) -> tuple[tuple[Shell, ...], tuple[Shell, ...], str]:
    """What is drawn of a cell: the arm with what it carries, what stands around it, and how the arm
    is drawn; a geometry that cannot be had is replaced by capsules, and said so."""
    radii, drawn_from = cell.workspace.link_radius, "capsules between its joints"
    arm: tuple[Shell, ...] = ()
    if cell.robot.urdf is not None and not radii:
        with suppress(ElastocalError):  # no collision geometry, or without its files
            arm = _shells(collision.urdf_bodies(cell, chain))
    if 0 < sum(len(s.faces) for s in arm) <= MOST_TRIANGLES:
        drawn_from = "the convex hulls of the URDF's collision geometry"
    else:
        steps = [*(joint.placement for joint in chain.joints), chain.flange_placement]
        whole = float(sum(np.linalg.norm(T[:3, 3]) for T in steps)) or 1.0
        radii = radii or tuple((whole * np.linspace(STOUT, SLIM, chain.n_joints)).tolist())
        capsules = collision.skeleton(chain, radii, np.eye(4), f"{cell.source}: [workspace]")
        arm = _shells((body.solid, body.carrier) for body in capsules)
    bodies: Sequence[collision.Body] = ()
    with suppress(ElastocalError):  # a mesh that is not there stops no report
        bodies = collision.cell_bodies(cell, chain)
    carried = ((b.solid, b.carrier) for b in bodies if b.kind == "carried" and b.carrier >= 0)
    around = _shells((b.solid, b.carrier) for b in bodies if b.kind == "obstacle")
    return (*arm, *_shells(carried)), around, drawn_from


def _shells(solids: Iterable[tuple[Solid, int]]) -> tuple[Shell, ...]:
    """Of solids and their carriers as collisions have them: 0 the first joint's frame."""
    found = []
    for solid, carrier in solids:
        with suppress(ElastocalError):  # an unreadable mesh: the others are still worth drawing
            found.append(Shell(*triangles_of(solid), max(carrier, -1) + 1, solid.name))
    return tuple(found)


def triangles_of(solid: Solid) -> tuple[Array, IntArray]:
    """Points (k, 3) in m in the carrier's frame and triangles (f, 3), turned outwards; round shapes
    become inscribed polyhedra."""
    centres, radius = collision.hull(solid)
    if not radius:
        return collision.outward(centres)
    angle = np.linspace(0, 2 * np.pi, MERIDIANS, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(MERIDIANS)])
    # Heights on the unit sphere: poles, and rings of which one is the equator.
    heights = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 2 * PARALLELS + 1))
    heights = np.zeros(1) if solid.shape == "cylinder" else heights
    around = np.vstack([ring * np.sqrt(1 - h * h) + [0.0, 0.0, h] for h in heights])
    around = radius * around @ solid.placement[:3, :3].T
    return collision.outward((centres[:, None] + around).reshape(-1, 3))


ARROW = 0.12  # length of a long arrow over the reach of what is drawn
LONG = 95.0  # percentile of the residuals that is drawn so long
AROUND = 0.35  # of the arm's reach: how far obstacles are shown beyond it
FAR = 1.2  # a tracker further off than this many extents would shrink the arm to a dot


@dataclass(frozen=True)
class Posed:
    """The arm in one pose.  `frames` (n + 1, 4, 4): base and joints after their motion; `markers`
    (m, 3) m with their `names`; `arrows` (m, 3) m, what is shown at each marker, or None; `group`
    indexes the groups of the space."""

    name: str
    about: str
    frames: Array
    flange: Array
    markers: Array
    names: tuple[str, ...]
    arrows: Array | None = None
    group: int = 0

    @property
    def line(self) -> Array:
        return np.vstack([self.frames[:, :3, 3], self.flange[None, :3, 3]])


class Space:
    """The poses with the bodies of the cell, as of `shells_of`, and the tracker where it is known
    to stand near; `first` is shown first, and a legend names the `groups` of poses."""

    def __init__(
        self, cell: Cell, chain: Chain, poses: Sequence[Posed], first: int = 0,
        what: str = "pose", groups: tuple[str, ...] = (),
    ) -> None:  # fmt: skip
        self.poses, self.first, self.what, self.groups = poses, first, what, groups
        self.arm, self.around, self.drawn_from = shells_of(cell, chain)
        self.walls = cell.workspace.keep_out
        self.tracker: Array | None = None
        low, high = self.extent = self._box()
        at = cell.tracker.position
        away = float(np.linalg.norm(np.maximum(np.maximum(low - at, at - high), 0.0)))
        # At the origin of its own data: most likely nobody said where it stands.
        if at.any() and away < FAR * float((high - low).max()):
            self.tracker = at
            self.extent = self._box()

    @property
    def has_arrows(self) -> bool:
        return any(p.arrows is not None for p in self.poses)

    @property
    def bodies(self) -> list[Array]:
        """Points (k, 3) m of the arm's bodies in the first pose."""
        placed = [(s.points, self.poses[self.first].frames[s.carrier]) for s in self.arm]
        return [points @ T[:3, :3].T + T[:3, 3] for points, T in placed]

    def _box(self) -> Array:
        every = np.vstack([points for p in self.poses for points in (p.line, p.markers)])
        every = np.vstack([every, *self.bodies])
        low, high = every.min(axis=0), every.max(axis=0)
        room = AROUND * float((high - low).max())
        # A hall's floor would shrink the arm to a dot.
        near = [np.clip(s.points, low - room, high + room) for s in self.around]
        near += [] if self.tracker is None else [self.tracker[None]]
        every = np.vstack([every, *near])
        low, high = every.min(axis=0), every.max(axis=0)
        room = 0.07 * float((high - low).max()) + 1e-3
        return np.stack([low - room, high + room])

    @property
    def scale(self) -> float:
        """How many times as long as they are arrows are drawn: 1, 2 or 5 times a power of ten."""
        arrows = [p.arrows for p in self.poses if p.arrows is not None]
        size = np.linalg.norm(np.vstack(arrows), axis=1) if arrows else np.zeros(0)
        long = float(np.percentile(size, LONG)) if len(size) else 0.0
        if not long > 0:
            return 1.0
        wanted = ARROW * float(np.ptp(self.extent, axis=0).max()) / long
        power = 10.0 ** np.floor(np.log10(wanted))
        return float(max(f * power for f in (1, 2, 5) if f * power <= wanted))

    @property
    def json(self) -> str:
        """For the page's script: lengths in m, arrows in µm; safe within a script element."""

        def flat(points: Array | None, digits: int) -> list[Any] | None:
            return None if points is None else points.round(digits).tolist()

        def bodies(shells: Sequence[Shell]) -> list[dict[str, Any]]:
            return [
                {"carrier": s.carrier, "points": flat(s.points.ravel(), 4),
                 "faces": s.faces.ravel().tolist()}
                for s in shells
            ]  # fmt: skip

        return in_script({
            "what": self.what, "first": self.first, "scale": self.scale, "arrows": self.has_arrows,
            "range": flat(self.extent.T, 3), "tracker": flat(self.tracker, 3),
            "bodies": bodies(self.arm), "things": bodies(self.around),
            "poses": [
                {"name": printable(p.name), "about": printable(p.about),
                 "frames": flat(p.frames[:, :3].reshape(len(p.frames), 12), 5),
                 "line": flat(p.line, 4), "markers": flat(p.markers, 4),
                 "names": [*map(printable, p.names)],
                 "arrows": flat(None if p.arrows is None else p.arrows * 1e6, 2)}
                for p in self.poses
            ],
        })  # fmt: skip


def in_script(content: object) -> str:
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    for character in "<>&":  # so that nothing can end the element that holds it
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def frames_at(
    cell: Cell, chain: Chain, q: Array, flange: Array | None = None
) -> tuple[Array, Array]:
    """Frames (N, n + 1, 4, 4) of base and joints, and flanges (N, 4, 4), at joints q (N, n): of the
    nominal chain, moved as a whole to end at `flange` (N, 4, 4) where that is known; on a page, the
    millimetres between the two cannot be seen."""
    kinematics = collision.Kinematics(cell, chain)
    poses = kinematics.poses(q, np.zeros(3))
    base = np.broadcast_to(kinematics.T_data_base, (len(q), 1, 4, 4))
    frames = np.concatenate([base, poses.frames[:, : chain.n_joints]], axis=1)
    if flange is None:
        return frames, poses.flange
    T = np.where(np.isfinite(flange).all(axis=(1, 2), keepdims=True), flange, poses.flange)
    return (T @ np.linalg.inv(poses.flange))[:, None] @ frames, T


MOST_POSES = 80  # in the page; of more, those with the largest residuals and a random choice
WORST = 30


def residual_arm(model: Model, observed: Observations, x: Array, residual: Array) -> say.Figure:
    """The arm with its residuals as arrows: one pose per configuration and load, each arrow the
    mean residual of a marker; `residual` (rows,) at parameter values x (parameters,)."""
    table, marker = observed.table, observed.table.marker[observed.lead]
    force = np.round(table.force[observed.lead], 3)
    entry = numbered(observed.configuration, *force.T)
    first = np.unique(entry, return_index=True)[1]
    # Where markers were seen, or the model puts them if only a distance was; of a residual of a
    # pose the position's, of a distance's along the line from its anchor.
    vectors = residual.reshape(-1, observed.size)
    places = model.target_poses(table, x)[1] if table.position is None else table.position
    at = places[observed.lead]
    if observed.kind == "distance":
        anchor = model.cell.tracker.anchor
        line = at - (np.zeros(3) if anchor is None else anchor)
        vectors = vectors * line / np.linalg.norm(line, axis=1, keepdims=True)
    vectors = vectors[:, :3]
    rms = np.sqrt(np.bincount(entry, (vectors**2).sum(axis=1)) / np.bincount(entry))
    chosen = np.argsort(first)  # in the table's order
    if len(rms) > MOST_POSES:
        worst = np.argsort(-rms)[:WORST]
        rest = np.setdiff1d(chosen, worst)
        drawn = np.random.default_rng(0).choice(rest, MOST_POSES - WORST, replace=False)
        chosen = chosen[np.isin(chosen, np.concatenate([worst, drawn]))]
    rows = observed.lead[first[chosen]]
    frames, flange = frames_at(
        model.cell, model.chain, table.q[rows], model.flange_poses(table.take(rows), x)
    )
    several = len(np.unique(force, axis=0)) > 1
    poses = []
    for k, code in enumerate(chosen):
        own = np.flatnonzero(entry == code)
        markers = np.unique(marker[own])
        groups = [own[marker[own] == m] for m in markers]
        name = table.configuration_labels[table.configuration[rows[k]]]
        poses.append(Posed(
            f"{name}, {load_text(table.force[rows[k]])}" if several else name,
            f"rms residual {say.length(float(rms[code]))} of {len(own)} readings",
            frames[k], flange[k],
            np.array([at[g].mean(axis=0) for g in groups]),
            tuple(table.marker_names[m] for m in markers),
            np.array([vectors[g].mean(axis=0) for g in groups]),
        ))  # fmt: skip
    first_shown = int(np.argmax(rms[chosen]))
    space = Space(model.cell, model.chain, poses, first_shown, "configuration")
    text = (
        f"Mean residual of each marker as an arrow, {space.scale:g} times as long as it is, in "
        f"configuration {printable(poses[first_shown].name)}, which has the largest, and in all of "
        f"them. The arm is drawn as {space.drawn_from}."
    )
    if len(poses) < observed.n_configurations:
        text += f" {len(poses)} poses of {observed.n_configurations} configurations: those with "
        text += "the largest residuals, and a random choice."
    return posed("space", "Residuals as arrows on the posed arm", text, space)


def plan_arm(plan: Plan) -> say.Figure:
    cell, chain = plan.model.cell, plan.model.chain
    frames, flange = frames_at(cell, chain, plan.q)
    local = np.array(list(cell.tool.markers.values())).reshape(-1, 3)
    order, heads = say.first_stops(plan), say.joint_heads(chain.kinds)
    poses = []
    for k, T in enumerate(flange):
        joints = zip(map(str.split, heads), say.joint_texts(plan.q[k], chain.kinds), strict=True)
        told = ", ".join(f"{name} {text} {unit}" for (name, unit), text in joints)
        group = plan.group_names[plan.group[k]]
        about = [f"stop {order[k]}", *([group] if plan.level_joint else []), told]
        markers, names = local @ T[:3, :3].T + T[:3, 3], tuple(cell.tool.markers)
        poses.append(
            Posed(plan.names[k], "; ".join(about), frames[k], T, markers, names, None,
                  int(plan.group[k]))
        )  # fmt: skip
    space = Space(cell, chain, poses, groups=plan.group_names)
    title = "The arm in the poses of the plan"
    caption = f"{title}, numbered at the flange. The arm is drawn as {space.drawn_from}."
    return posed("poses", title, caption, space)


MOST_NUMBERED = 80  # beyond that numbers hide each other
LONGEST_NAME = 24
SIGNS = ("o", "s", "^", "D", "v", "P")  # of groups, which differ in more than colour
# Rows: to the right and upwards on paper, and towards the reader.
OBLIQUE = Rotation.from_euler("zy", [50.0, 22.0], degrees=True).as_matrix()[[1, 2, 0]]
TOP = np.eye(3)
SIDE = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])


def posed(name: str, title: str, caption: str, space: Space) -> say.Figure:
    """The first pose seen obliquely, and all poses from above and from the side."""

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.5, 1.0))
        large = figure.add_subplot(grid[0, :])
        _draw(large, space, OBLIQUE, whole=False)
        large.set_axis_off()
        for k, (view, told, up) in enumerate(((TOP, "from above", "y"), (SIDE, "side", "z"))):
            axes = figure.add_subplot(grid[1, k])
            _draw(axes, space, view, whole=True)
            axes.set_title(told)
            axes.set_xlabel("x in m")
            axes.set_ylabel(f"{up} in m")
        if space.groups:
            figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)

    return say.Figure(name, title, draw, 7.0, caption, space=space)


def write_plan_picture(path: str | Path, plan: Plan) -> None:
    """PNG or SVG by suffix; the same plan gives the same file."""
    suffix = Path(path).suffix.lower()
    require(suffix in (".png", ".svg"), f"{path}: a picture of poses is written as .png or .svg")
    figure: Any = figure_of(plan_arm(plan))
    picture = BytesIO()
    nothing = {"Date": None, "Creator": None} if suffix == ".svg" else {"Software": None}
    with style():
        figure.savefig(picture, format=suffix[1:], dpi=200, metadata=nothing, facecolor="white")
    atomic_write(path, picture.getvalue())


def _draw(axes: Axes, space: Space, view: Array, whole: bool) -> None:
    """`whole`: all poses as lines; else the first as bodies, and with arrows it alone."""
    every = whole or not space.has_arrows
    poses = space.poses if every else (space.poses[space.first],)
    _draw_around(axes, space, view, whole)
    for pose in poses if every else ():
        line, colour = pose.line @ view.T, SERIES[pose.group % len(SERIES)]
        axes.plot(line[:, 0], line[:, 1], color=colour, linewidth=0.9, alpha=0.5)
    if not whole:  # the furthest first
        for points in sorted((b @ view.T for b in space.bodies), key=lambda p: p[:, 2].mean()):
            _fill(axes, points, ARM, 1.0)
    elif not space.has_arrows:  # the flange of each pose: its group by colour and sign, its name
        tips = np.array([pose.line[-1] for pose in space.poses]) @ view.T
        group = np.array([pose.group for pose in space.poses])
        for k in np.unique(group):
            own = tips[group == k]
            name = f"{printable(space.groups[k])} ({len(own)})" if space.groups else ""
            axes.plot(own[:, 0], own[:, 1], SIGNS[(k + k // len(SERIES)) % len(SIGNS)], label=name,
                      color=SERIES[k % len(SERIES)], markersize=4.5, markeredgecolor="white",
                      markeredgewidth=0.5)  # fmt: skip
        for pose, (x, y, _) in zip(space.poses[:MOST_NUMBERED], tips, strict=False):
            if len(space.poses) <= MOST_NUMBERED:
                axes.annotate(say.short_name(pose.name, 6), (x, y), (3, 2),
                              textcoords="offset points", fontsize=7)  # fmt: skip
    for pose in poses if whole else (space.poses[space.first],):
        at, tip = pose.markers @ view.T, pose.line[-1] @ view.T
        for marker in () if whole else at:
            axes.plot([tip[0], marker[0]], [tip[1], marker[1]], color=INK, linewidth=0.8)
        axes.plot(at[:, 0], at[:, 1], ".", color=INK, markersize=2 if whole else 5)
        if pose.arrows is not None:
            step = space.scale * pose.arrows @ view.T
            axes.quiver(at[:, 0], at[:, 1], step[:, 0], step[:, 1], angles="xy",
                        scale_units="xy", scale=1, color=SERIES[1], width=0.004, headwidth=3.5,
                        headlength=4, zorder=3)  # fmt: skip
    drawn = [] if whole else space.bodies
    if space.tracker is not None:
        x, y, _ = view @ space.tracker
        axes.plot([x], [y], "D", color=SERIES[2], markersize=6)
        axes.annotate("tracker", (x, y), (6, 3), textcoords="offset points", fontsize=8)
        drawn.append(space.tracker[None])
    axes.set_aspect("equal")
    # Limits that hold arms, arrows and tracker; of what stands around, what lies within.
    drawn += [points for p in poses for points in (p.line, p.markers)]
    drawn += [p.markers + space.scale * p.arrows for p in poses if p.arrows is not None]
    flat = (np.vstack(drawn) @ view.T)[:, :2]
    low, high = flat.min(axis=0), flat.max(axis=0)
    room = 0.09 * (high - low).max()
    axes.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room))


def _draw_around(axes: Axes, space: Space, view: Array, whole: bool) -> None:
    for shell in space.around:
        points = shell.points @ view.T
        _fill(axes, points, FAINT, 0.25)
        if whole:
            top = (float(points[:, 0].mean()), float(points[:, 1].max()))
            axes.annotate(say.short_name(shell.name, LONGEST_NAME), top, (0, 2), ha="center",
                          textcoords="offset points", fontsize=7, clip_on=True)  # fmt: skip
    for wall in space.walls if whole else ():
        normal, at = (view @ wall.normal)[:2], (view @ wall.point)[:2]
        if abs(float(np.linalg.norm(normal)) - 1) < 1e-6:
            beyond = (float(at[0] - normal[1]), float(at[1] + normal[0]))
            axes.axline((float(at[0]), float(at[1])), beyond, color=FAINT, linestyle="--")


def _fill(axes: Axes, points: Array, colour: str, alpha: float) -> None:
    from scipy.spatial import ConvexHull, QhullError

    try:
        outline = points[ConvexHull(points[:, :2]).vertices]
    except QhullError:
        return  # seen edge on
    axes.fill(outline[:, 0], outline[:, 1], facecolor=colour, edgecolor=INK, linewidth=0.5,
              alpha=alpha)  # fmt: skip


def turned(space: Space) -> Any:
    import plotly.graph_objects as go

    def name(text: str) -> str:  # plotly reads some HTML in its texts
        return escape(say.short_name(text, LONGEST_NAME), quote=False)

    figure = go.Figure()

    def add(points: Array, mode: str, **how: Any) -> None:
        x, y, z = points.T
        figure.add_scatter3d(x=x, y=y, z=z, mode=mode, **how)

    for pose in space.poses:
        colour = SERIES[pose.group % len(SERIES)]
        add(pose.line, "lines+markers", name=name(f"pose {pose.name}"),
            line={"color": colour, "width": 4}, marker={"size": 2, "color": colour})  # fmt: skip
        add(pose.markers, "markers", text=[*map(name, pose.names)], hoverinfo="text",
            marker={"size": 3, "color": colour, "symbol": "diamond"},
            showlegend=False)  # fmt: skip
        arrows = () if pose.arrows is None else space.scale * pose.arrows
        for start, arrow in zip(pose.markers, arrows, strict=False):
            add(np.stack([start, start + arrow]), "lines", showlegend=False, hoverinfo="skip",
                line={"color": SERIES[1], "width": 4})  # fmt: skip
    if space.tracker is not None:
        add(space.tracker[None], "markers", name="tracker", marker={"size": 5, "color": INK})
    axes = {f"{a}axis": {"title": {"text": f"{a} in m"}} for a in "xyz"}
    return figure.update_layout(scene={"aspectmode": "data", **axes}, height=640)
