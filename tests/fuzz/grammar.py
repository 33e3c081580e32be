"""Whole robots, cells and tables by a grammar, and the chains of verbs that begin with them.

What `mutations` makes of valid files is mostly refused by the reader; what is made here is well
formed and mostly means something: arms of other joints, units, sizes and branches than anybody
tried, and cells and tables that fit them.  Now and then a number is one that no arm has.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from random import Random

from fuzz.campaign import Command

ODD = ("0", "-0.0", "1e-300", "1e300", "-1e12", "1e-9", "3.2e9", "nan", "inf", "", "1,5")
EFFECTS = (
    "base_frame", "joint_offset", "joint_compliance", "link_geometry", "marker_position",
    "backlash", "gear_ripple", "hysteresis", "joint_compliance:joint2", "payload_mass",
    "tool_compliance", "gravity", "no_such_effect",
)  # fmt: skip


def number(rng: Random, low: float, high: float, odd: float = 0.004) -> str:
    """A number of a usual size, seldom an odd one."""
    return rng.choice(ODD) if rng.random() < odd else f"{rng.uniform(low, high):.4g}"


def numbers(rng: Random, n: int, low: float, high: float) -> str:
    return " ".join(number(rng, low, high) for _ in range(n))


def axis(rng: Random) -> str:
    plain = ["1 0 0", "0 1 0", "0 0 1", "0 -1 0", "0 0 -1"]
    return rng.choice(plain) if rng.random() < 0.9 else numbers(rng, 3, -1, 1)


def urdf(rng: Random, joints: int) -> str:
    """A chain of links with masses, limits, side branches and fixed joints in between."""
    parts, last = ['<link name="base"/>'], "base"
    for i in range(1, joints + 1):
        inertia = " ".join(f'{k}="{number(rng, 0.001, 1)}"' for k in ("ixx", "iyy", "izz"))
        weight, centre = number(rng, 0.1, 50), numbers(rng, 3, 0, 0.3)
        mass = (
            f'<inertial><mass value="{weight}"/><origin xyz="{centre}"/>'
            f'<inertia {inertia} ixy="0" ixz="0" iyz="0"/></inertial>'
        ) * (rng.random() < 0.7)
        parts.append(f'<link name="l{i}">{mass}</link>')
        kind = rng.choices(("revolute", "prismatic", "continuous", "floating"), (20, 2, 2, 0.1))[0]
        mimic = f'<mimic joint="j{rng.randint(1, i)}"/>' if rng.random() < 0.01 else ""
        low, high = sorted((rng.uniform(-3, 0), rng.uniform(0, 3)))
        parts.append(
            f'<joint name="{rng.choice(("j", "j", "j", "J-", "joint_"))}{i}" type="{kind}">'
            f'<parent link="{last}"/><child link="l{i}"/>'
            f'<origin xyz="{numbers(rng, 3, -0.4, 0.6)}" rpy="{numbers(rng, 3, -1.6, 1.6)}"/>'
            f'<axis xyz="{axis(rng)}"/>{mimic}'
            f'<limit lower="{low:.3g}" upper="{high:.3g}" effort="100" velocity="1"/></joint>'
        )
        last = f"l{i}"
        if rng.random() < 0.1:
            parts.append(f'<link name="side{i}"/><joint name="s{i}" type="fixed"><parent link='
                         f'"{last}"/><child link="side{i}"/></joint>')  # fmt: skip
    parts.append(
        '<link name="tool0"/><joint name="flange" type="fixed"><child link="tool0"/>'
        f'<parent link="{last}"/><origin xyz="{numbers(rng, 3, 0, 0.1)}"/></joint>'
    )
    return f'<robot name="grown">{"".join(parts)}</robot>'


def mjcf(rng: Random, joints: int) -> str:
    """Bodies within bodies, with classes, sites, geoms, constraints, and what is replicated."""
    inside = f'<site name="attachment_site" pos="{numbers(rng, 3, 0, 0.1)}"/>'
    for i in range(joints, 0, -1):
        size, mass = number(rng, 0.01, 0.2), number(rng, 0.1, 9)
        geom = f'<geom type="sphere" size="{size}" mass="{mass}"/>'
        kind = rng.choices(("hinge", "slide", "ball"), (30, 2, 0.1))[0]
        place, turn = numbers(rng, 3, -0.3, 0.5), numbers(rng, 3, -1, 1)
        extra = ""
        if rng.random() < 0.05:
            count = rng.choice((2, 10, 10**4, 10**8))
            extra = f'<replicate count="{count}" offset="0 0 0.1"><site size=".01"/></replicate>'
        inside = (
            f'<body name="b{i}" pos="{place}" euler="{turn}"><joint name="joint{i}" type="{kind}"'
            f' axis="{axis(rng)}" range="-2 {number(rng, 0.5, 3)}" limited="true"/>'
            f"{geom}{extra}{inside}</body>"
        )
    angle = rng.choice(("radian", "radian", "degree"))
    more = rng.choice(("", "", '<option gravity="0 0 0"/>', '<size nuserdata="1000000000"/>',
                       '<equality><joint joint1="joint2" joint2="joint3"/></equality>',
                       '<include file="arm.xml"/>', '<include file="../other.xml"/>',
                       '<asset><mesh name="m" file="/dev/zero"/></asset>'))  # fmt: skip
    return f'<mujoco><compiler angle="{angle}"/>{more}<worldbody>{inside}</worldbody></mujoco>'


def dh(rng: Random, joints: int) -> str:
    angle, length = rng.choice(("deg", "rad")), rng.choice(("mm", "m"))
    scale, turn = (1000 if length == "mm" else 1), (90 if angle == "deg" else 1.5708)
    rows = [f"joint,a_{length},alpha_{angle},d_{length},theta_{angle}"]
    for i in range(1, joints + 1):
        alpha = rng.choice((0, turn, -turn))
        rows.append(f"{i},{number(rng, -0.5 * scale, 0.8 * scale)},{alpha},"
                    f"{number(rng, 0, 0.5 * scale)},{rng.choice((0, 0, -turn))}")  # fmt: skip
    return "\n".join(rows) + "\n"


ROBOTS: dict[str, tuple[str, Callable[[Random, int], str]]] = {
    "urdf": ("arm.urdf", urdf), "mjcf": ("arm.xml", mjcf), "dh": ("arm.csv", dh),
}  # fmt: skip


def cell(rng: Random, kind: str, joints: int) -> str:
    """A cell of this arm: tool, tracker, effects and their nominal values, a plan."""
    observe = rng.choice(("position", "position", "deflection", "pose", "distance"))
    markers = "".join(
        f"M{k} = [{', '.join(number(rng, -0.3, 0.3) or '0' for _ in range(3))}]\n"
        for k in range(1, rng.randint(2, 4))
    )
    effects = rng.sample(EFFECTS, rng.randint(0, 4))
    compliances = ", ".join(number(rng, 1e-7, 1e-5, 0) for _ in range(joints))
    return (
        f'[robot]\n{kind} = "{ROBOTS[kind][0]}"\n\n[tool]\nload_point_m = [0.1, 0.0, 0.1]\n\n'
        f"[tool.markers_m]\n{markers}\n[tracker]\nposition_m = [{number(rng, 2, 4)}, 1.0, 0.5]\n"
        f"sigma_um = {number(rng, 1, 100)}\n\n[model]\nobserve = \"{observe}\"\n"
        f"effects = {list(effects)!r}\n\n[model.nominal]\njoint_compliance = [{compliances}]\n"
        + ("[design]\nloads_N = [[0, 0, 0], [0, 0, -50]]\n" if rng.random() < 0.5 else "")
    )  # fmt: skip


def plan(rng: Random, joints: int) -> str:
    header = ["configuration", *(f"q{i}_deg" for i in range(1, joints + 1))]
    rows = [[str(k), *(number(rng, -60, 60, 0.001) for _ in range(joints))]
            for k in range(1, rng.randint(3, 40))]  # fmt: skip
    return "\n".join(",".join(row) for row in (header, *rows)) + "\n"


def chain(rng: Random, robot: str) -> list[Command]:
    """Verbs one after another, each reading what those before it wrote."""
    first = Command("init", f"{robot} -o out.toml", ("out.toml",))
    load = " --load 0 0 -50" if rng.random() < 0.7 else ""
    draw = rng.choice(("0", "1", "30"))
    seed = rng.choice((0, 1, 20261207, 2**40))
    simulate = Command(
        "simulate", f"cell.toml plan.csv -o out.csv --draw {draw}{load} --seed {seed}", ("out.csv",)
    )
    identify = Command(
        "identify", "cell.toml out.csv -o out.json -q --seed " + str(seed), ("out.json",)
    )
    ending = rng.choice((".urdf", ".xml", ".csv", ".yaml"))
    quick = "-o plan2.csv --effort quick --candidates 40 -q"
    plans = ("plan2.csv", "plan2.json")
    ends = (
        Command("export", f"cell.toml out.json -o arm2{ending} --poses 20 -q"),
        Command("compensate", "cell.toml out.json --target 600,100,700 --point M1 -q"),
        Command("compare", "cell.toml out.json out.json -q --poses 20"),
        Command("diagnose", "cell.toml out.csv -q -o why.json", ("why.json",)),
    )  # fmt: skip
    return rng.choice(
        (
            [first, Command("effects", "out.toml --json")],
            [first, Command("design", f"out.toml {quick} --poses 12", plans)],
            [Command("effects", "cell.toml --json")],
            [simulate, identify, rng.choice(ends)],
            [simulate, identify, rng.choice(ends)],
            [Command("design", f"cell.toml {quick} --poses 8 --criterion D", plans)],
        )
    )  # fmt: skip


def grown(folder: Path, rng: Random) -> list[tuple[Command, list[str]]]:
    """Write a robot, its cell and a plan into `folder`; returns the verbs to run there."""
    kind = rng.choice(tuple(ROBOTS))
    name, make = ROBOTS[kind]
    joints = rng.choices(range(3, 11), (1, 3, 4, 16, 6, 2, 1, 1))[0]
    folder.mkdir(parents=True)
    (folder / name).write_text(make(rng, joints), encoding="utf-8")
    (folder / "cell.toml").write_text(cell(rng, kind, joints), encoding="utf-8")
    (folder / "plan.csv").write_text(plan(rng, joints), encoding="utf-8")
    read = (name, "cell.toml", "plan.csv")
    return [(replace(c, named=read), shlex.split(c.line)) for c in chain(rng, name)]
