"""`elastocal init` of a robot's file, and small six-axis arms as URDF and MJCF."""

from __future__ import annotations

from pathlib import Path

from support.design_commands import elastocal

# Axis, offset from the joint before, both in its frame at zero.
JOINTS = (
    ("0 0 1", "0 0 0.33"), ("0 1 0", "0.15 0 0.1"), ("0 1 0", "0 0 0.6"), ("1 0 0", "0.2 0 0.12"),
    ("0 1 0", "0.45 0 0"), ("1 0 0", "0.09 0 0"),
)  # fmt: skip


def told_by_init(path: Path, *options: str) -> tuple[int, str, str]:
    """Exit code, output and errors of `elastocal init`, which writes cell.toml beside the file."""
    done = elastocal("init", path, "-o", path.with_name("cell.toml"), "--force", *options)
    return done.exit_code, " ".join(done.stdout.split()), " ".join(done.stderr.split())


def urdf(
    extra: str = "", limits: tuple[str, str] = ("-2.9", "2.9"), name: str = "joint_{}",
    base: str = "base_link", scale: float = 1.0,
) -> str:  # fmt: skip
    """A six-axis arm from `base` to tool0; `extra` elements; lengths times `scale`."""
    parts = [f'<link name="{base}"/>']
    parent = base
    for i, (axis, xyz) in enumerate(JOINTS, start=1):
        place = " ".join(f"{float(v) * scale:.6g}" for v in xyz.split())
        parts.append(
            f'<link name="link_{i}"><inertial><origin xyz="0.02 0 0.1"/><mass value="{10 - i}"/>'
            '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>'
            f'<joint name="{name.format(i)}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{i}"/><origin xyz="{place}"/><axis xyz="{axis}"/>'
            f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="1" velocity="1"/></joint>'
        )
        parent = f"link_{i}"
    if "tool0" not in extra and "hand" not in extra:
        parts.append(frame("tool0", "link_6", f"{0.05 * scale:g} 0 0"))
    return f'<?xml version="1.0"?>\n<robot name="arm">{"".join(parts)}{extra}</robot>\n'


def frame(name: str, parent: str, xyz: str = "0 0 0", rpy: str = "0 0 0") -> str:
    return (
        f'<link name="{name}"/><joint name="{name}_joint" type="fixed"><parent link="{parent}"/>'
        f'<child link="{name}"/><origin xyz="{xyz}" rpy="{rpy}"/></joint>'
    )


def slide(name: str, parent: str, child: str, inside: str = "") -> str:
    """A link that slides 40 mm on another."""
    return (
        f'<link name="{child}"/><joint name="{name}" type="prismatic"><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 1 0"/>{inside}'
        '<limit lower="0" upper="0.04" effort="1" velocity="1"/></joint>'
    )


def mjcf(
    head: str = "", beside: str = "", at_end: str = "", tail: str = "", of_bodies: str = "",
    limits: str = "-2.9 2.9", of_joints: str = "", compiler: str = 'angle="radian"',
    in_l1: str = "", in_l3: str = "",
) -> str:  # fmt: skip
    """A six-axis arm of bodies l1 … l6 with joints j1 … j6 and a site at its end.

    `head` and `tail` stand before and after <worldbody>, `beside` in it, `at_end` in l6, `in_l1`
    and `in_l3` in these; `of_bodies` and `of_joints` are attributes.
    """
    text = '<body name="base">'
    for i, (axis, pos) in enumerate(JOINTS, start=1):
        text += (
            f'<body name="l{i}" pos="{pos}" {of_bodies}><inertial pos="0.02 0 0.1" '
            f'mass="{10 - i}" diaginertia="0.1 0.1 0.1"/>'
            f'<joint name="j{i}" axis="{axis}" range="{limits}" {of_joints}/>'
            + {1: in_l1, 3: in_l3}.get(i, "")
        )
    text += f'<site name="attachment_site" pos="0.05 0 0"/>{at_end}' + "</body>" * 7
    return (
        f'<mujoco model="arm"><compiler {compiler}/>{head}<worldbody>{beside}{text}</worldbody>'
        f"{tail}</mujoco>\n"
    )
