"""Small MJCF arms of our own, with what makes a file hard to read."""

from __future__ import annotations

from pathlib import Path

# Degrees and another Euler sequence, defaults by class, a frame, an arm that is turned and moved,
# an off-centre joint with ref, a slide, a full inertia tensor, two fingers, sites, a free box, a
# mesh that is not there, a keyframe; joint5 has no name.
ARM = Path(__file__).with_name("arm.xml").read_text(encoding="utf-8")
# MuJoCo reads it by itself too: without the mesh.
LOADABLE = ARM.replace('<geom type="mesh" mesh="hull"/>', "").replace(
    '<asset><mesh name="hull" file="hull.stl"/></asset>', ""
)


def write_arm(folder: Path, text: str = ARM) -> Path:
    path = folder / "arm.xml"
    path.write_text(text, encoding="utf-8")
    return path
