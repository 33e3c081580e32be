"""A URDF for an arm that has none: a robot described by a DH table."""

from __future__ import annotations

import math
from xml.sax.saxutils import quoteattr

from elastocal.export.pieces import Pieces
from elastocal.export.rigid_text import origin_attributes
from elastocal.export.urdf import TRACKER, Frames, comment, fixed_joint, tool_frames
from elastocal.export.urdf_edit import element
from elastocal.manipulator.chain import Joint, LinkMass
from elastocal.simulation.mjcf import numbers

BASE, FLANGE = "base_link", "flange"
NO_LIMIT = 1e6  # m; a URDF's slide must have limits


def new_urdf(pieces: Pieces, frames: Frames, note: str) -> str:
    """URDF text of links base_link, link_1 … link_n, flange with the calibrated placements.

    Joints bear the table's names and limits (continuous where one has none); masses stand with a
    zero inertia tensor, of which the table says nothing.
    """
    chain = pieces.calibrated_chain()
    lines = []
    if frames.base:
        lines += [element("link", {"name": TRACKER})]
        lines += [fixed_joint(f"{TRACKER}_joint", TRACKER, BASE, pieces.T_tracker_base)]
    lines += [element("link", {"name": BASE})]
    parent = BASE
    for i, joint in enumerate(chain.joints, start=1):
        lines += _link(f"link_{i}", chain.masses[i - 1] if chain.masses else None)
        lines += _joint(joint, parent, f"link_{i}")
        parent = f"link_{i}"
    lines += [element("link", {"name": FLANGE})]
    lines += [fixed_joint(f"{FLANGE}_joint", parent, FLANGE, chain.flange_placement)]
    if frames.tool:
        for name, T in tool_frames(pieces).items():
            lines += [element("link", {"name": name})]
            lines += [fixed_joint(f"{name}_joint", FLANGE, name, T)]
    head = ['<?xml version="1.0" encoding="UTF-8"?>', f"<!-- {comment(note)} -->"]
    body = [f"  {line}" for line in lines]
    return "\n".join([*head, f"<robot name={quoteattr(chain.name)}>", *body, "</robot>"]) + "\n"


def _link(name: str, body: LinkMass | None) -> list[str]:
    if body is None:
        return [element("link", {"name": name})]
    inertia = dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0")
    return [
        f"<link name={quoteattr(name)}>",
        "  <inertial>",
        f"    {element('origin', {'xyz': numbers(body.com), 'rpy': '0 0 0'})}",
        f"    {element('mass', {'value': repr(float(body.mass))})}",
        f"    {element('inertia', inertia)}",
        "  </inertial>",
        "</link>",
    ]


def _joint(joint: Joint, parent: str, child: str) -> list[str]:
    bounded = math.isfinite(joint.lower) and math.isfinite(joint.upper)
    kind = joint.kind if bounded or joint.kind == "prismatic" else "continuous"
    lines = [
        f"<joint name={quoteattr(joint.name)} type={quoteattr(kind)}>",
        f"  {element('parent', {'link': parent})}",
        f"  {element('child', {'link': child})}",
        f"  {element('origin', origin_attributes(joint.placement))}",
        f"  {element('axis', {'xyz': numbers(joint.axis)})}",
    ]
    if kind != "continuous":
        lower, upper = max(joint.lower, -NO_LIMIT), min(joint.upper, NO_LIMIT)
        limit = {
            "lower": repr(float(lower)),
            "upper": repr(float(upper)),
            "effort": "0",
            "velocity": "0",
        }
        lines += [f"  {element('limit', limit)}"]
    return [*lines, "</joint>"]
