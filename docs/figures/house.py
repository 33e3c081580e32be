"""The packages of elastocal and which of them uses which, read off the imports in the code."""

from __future__ import annotations

import ast

from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from style import ROOT, Colours, draw, plt

SOURCE = ROOT / "src" / "elastocal"
# Where each room is drawn (column, floor), its half width, and what it holds.
ROOMS = {
    "cli": (2.05, 7, 1.15, "elastocal VERB …"),
    "front door": (6.1, 7, 1.15, "import elastocal as ec"),
    "studies": (0.0, 6, 0.85, "many simulated\ncampaigns"),
    "report": (2.05, 6, 0.95, "terminal, HTML page,\nnotebook, figures"),
    "saving": (4.1, 6, 0.85, "a result as a file"),
    "verbs": (6.1, 6, 0.95, "options of the user\n→ options of a room"),
    "plugins": (8.25, 6, 1.0, "effects, noise models,\ncriteria of one's own"),
    "importing": (0.0, 5, 0.85, "exports of trackers\n→ the table"),
    "export": (2.05, 5, 0.85, "URDF, MJCF,\nDH table"),
    "compensation": (4.1, 5, 0.9, "commands for\nthe arm as it is"),
    "diagnosis": (6.1, 5, 0.85, "what the model lacks"),
    "planning": (6.4, 4, 1.3, "poses, with a certificate"),
    "simulation": (1.5, 3, 0.85, "what one would\nmeasure"),
    "identification": (4.1, 3, 0.95, "weighted fit on B,\nnoise, intervals"),
    "engine": (7.4, 2, 1.1, "the linear mixed model"),
    "model": (4.1, 2, 1.75, "effects on the chain → prediction and $B_i$"),
    "cell": (2.95, 1, 1.0, "robot, tool, tracker,\nwork space"),
    "measurements": (5.25, 1, 1.0, "the table of\nreadings"),
}
MISSION = ("model", "engine", "identification", "planning", "diagnosis")
PARTS = {
    "__init__": "front door", "cell_tables": "cell", "correction_table": "compensation",
}  # fmt: skip
COMMON = "config · files · messages · screen · tables · units"
HEIGHT, STEP = 0.72, 1.14


def uses() -> dict[str, set[str]]:
    """The rooms that each room imports from, those apart that it reaches through others."""
    found: dict[str, set[str]] = {room: set() for room in ROOMS}
    for path in SOURCE.rglob("*.py"):
        room = _room(path.relative_to(SOURCE).with_suffix("").parts[0])
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = node.module or "" if isinstance(node, ast.ImportFrom) else ""
            names = [name] if name != "elastocal" else [f"{name}.{a.name}" for a in node.names]
            for name in names:
                target = _room(name.removeprefix("elastocal.").partition(".")[0])
                if room in ROOMS and target in ROOMS and name.startswith("elastocal."):
                    found[room].add(target)
        found.get(room, set()).discard(room)
    return {
        room: {one for one in direct if not any(one in _below(o, found) for o in direct)}
        for room, direct in found.items()
    }


def _room(name: str) -> str:
    return PARTS.get(name, name)


def _below(room: str, uses: dict[str, set[str]]) -> set[str]:
    """All rooms that `room` reaches."""
    return uses[room].union(*(_below(one, uses) for one in uses[room]))


def figure(colours: Colours) -> Figure:
    fig, axis = plt.subplots(figsize=(9.8, 7.8))
    axis.axis("off")
    for room, direct in uses().items():
        for target in sorted(direct):
            _arrow(axis, room, target, colours)
    for room, (x, floor, half, what) in ROOMS.items():
        colour = colours.two if room in MISSION else colours.one
        _box(axis, x, floor * STEP, half, colour, colours.ground)
        two = "\n" in what
        axis.text(x, floor * STEP + (0.19 if two else 0.12), room, ha="center", va="center",
                  fontsize=10.5, weight="bold")  # fmt: skip
        axis.text(x, floor * STEP - (0.11 if two else 0.14), what, ha="center", va="center",
                  fontsize=8.5, linespacing=1.15)  # fmt: skip
    _box(axis, 4.1, 0.06, 3.6, colours.four, colours.ground)
    axis.text(4.1, 0.06, f"what all of them use: {COMMON}", ha="center", va="center", fontsize=9.5)
    axis.set_xlim(-0.95, 9.35)
    axis.set_ylim(-0.4, 7 * STEP + 0.4)
    return fig


def _box(axis: plt.Axes, x: float, y: float, half: float, colour: str, ground: str) -> None:
    for fill, alpha in ((ground, 1.0), (colour, 0.22)):  # arrows end at the box, not within
        box = FancyBboxPatch(
            (x - half, y - HEIGHT / 2), 2 * half, HEIGHT, boxstyle="round,pad=0,rounding_size=0.08",
            facecolor=fill, alpha=alpha, edgecolor=colour,
        )  # fmt: skip
        axis.add_patch(box)


def _arrow(axis: plt.Axes, room: str, target: str, colours: Colours) -> None:
    (x, floor, half, _), (to, below, wide, _) = ROOMS[room], ROOMS[target]
    start = x + max(-0.7 * half, min(0.7 * half, 0.25 * (to - x)))
    end = to + max(-0.7 * wide, min(0.7 * wide, 0.3 * (x - to)))
    style = {"arrowstyle": "-|>", "color": colours.text, "shrinkA": 0, "shrinkB": 0, "alpha": 0.75}
    drawn = axis.annotate("", (end, below * STEP + HEIGHT / 2), (start, floor * STEP - HEIGHT / 2),
                          arrowprops=style)  # fmt: skip
    drawn.arrow_patch.set_gid(f"{room} uses {target}".replace(" ", "_"))


if __name__ == "__main__":
    for room, direct in uses().items():
        print(room, "uses", ", ".join(sorted(direct)) or "none of the rooms")
    draw("house", figure)
