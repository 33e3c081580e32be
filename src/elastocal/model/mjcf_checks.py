"""What an MJCF file asks of MuJoCo, counted before MuJoCo sees it; closed loops of its joints.

MuJoCo makes elements of a line (<replicate>, <composite>, <flexcomp>), reads whatever files a model
names, of any kind and size, and takes as much memory as a number in the text says.  So the text and
all that it includes is read here first.  With n children and m what its own counts multiply,

    weight(element) = m (1 + Σ weight(child)),

and the weight of a model is the number of elements that MuJoCo would have to make.
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree as ET

from elastocal.errors import InputError, require
from elastocal.files import check_regular, check_size, open_input, read_bytes
from elastocal.model.urdf import MAX_BYTES
from elastocal.model.xml_file import xml_tree
from elastocal.text import listed, printable, quoted

# A humanoid with hands and keyframes has 1500.  MuJoCo's compiler takes 1 s for so many bodies with
# free joints; its time grows with their square, and that of 20 000 is beyond a minute.
MOST_ELEMENTS = 5000
MOST_MESH_BYTES = 100_000_000  # of a file
MOST_FILES_BYTES = 300_000_000  # of all, each as often as it is named
MOST_CELLS = 1_000_000  # of all height fields
VERTEX_BYTES = 50  # of a mesh file, at least
# The largest numbers of attributes that MuJoCo sets memory aside by.
LARGEST: dict[str, dict[str, float]] = {
    "size": {"nuserdata": 1e6, "nkey": 1e3, "njmax": 1e6, "nconmax": 1e6, "nstack": 1e8,
             "memory": 4e9} | {f"nuser_{kind}": 1e3 for kind in
             ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")},
    "numeric": {"size": 1e5},
    "mesh": {"params": 200, "octree_maxdepth": 8},
    "composite": {"subgrid": 10},
}  # fmt: skip
NAMES = ("name", "class", "childclass", "model", "prefix", "file")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?")
_UNITS = {unit: 1024.0**k for k, unit in enumerate("KMGTPE", start=1)}


def check_bounds(path: Path, data: bytes) -> None:
    """Raise InputError where the MJCF `data` of the file `path` asks for more than an arm needs.

    Counted are elements as often as they are replicated, sizes, and what files it names: included
    models stand in its folder, and all are regular files.  The message names file and element.
    """
    weight = _Model(path).weight_of(path, data)
    require(
        weight <= MOST_ELEMENTS,
        f"{path}: makes {weight:.3g} elements of all it replicates and includes; more than "
        f"{MOST_ELEMENTS} are no arm, so keep the arm alone",
    )


class _Model:
    """A model of several files; adds up what they ask for."""

    def __init__(self, path: Path) -> None:
        self._folder = path.parent
        # The folder as it is named, and that of the file where the name is a link.
        self._roots = path.parent.resolve(), path.resolve().parent
        self._weights: dict[Path, float] = {}
        self._open: list[Path] = []
        self._text = self._bytes = self._cells = 0

    def weight_of(self, path: Path, data: bytes | None = None) -> float:
        """The weight of an XML file, which is read once."""
        real = path.resolve()
        require(real not in self._open, f"{path}: includes itself; take out the <include>")
        if real not in self._weights:
            self._open.append(real)
            data = read_bytes(path, "included model", MAX_BYTES) if data is None else data
            self._text += len(data)
            check_size(path, "MuJoCo model with all it includes", self._text, MAX_BYTES)
            root = xml_tree(path, data, "an MJCF file")
            self._weights[real] = self._weight(path, root, root)
            self._open.pop()
        return self._weights[real]

    def _weight(self, path: Path, root: ET.Element, element: ET.Element) -> float:
        """How many elements MuJoCo makes of one of the file `path` and all within it."""
        _check_sizes(path, element)
        if element.tag == "hfield":
            sides = (math.prod(_numbers(element.get(key, ""))) for key in ("nrow", "ncol"))
            self._count_cells(path, math.prod(sides))
        inside = 1 + sum(self._weight(path, root, child) for child in element)
        return _count(element) * (inside + sum(self._named(path, root, element)))

    def _named(self, path: Path, root: ET.Element, element: ET.Element) -> Iterator[float]:
        """Weights of the files that it names: of a model its elements, of a grid its vertices."""
        file = element.get("file", "")
        if element.tag == "attach":
            models = {one.get("name") or Path(one.get("file", "")).stem: one.get("file", "")
                      for one in root.iter("model")}  # fmt: skip
            file = models.get(element.get("model", ""), "")
        if element.tag in ("include", "model", "attach"):
            yield from map(self.weight_of, self._included(path, file) if file else ())
            return
        for key, name in element.attrib.items():
            for found in self._places(path, root, name) if key.startswith("file") and name else ():
                try:
                    size = self._count_file(found)
                except InputError as error:
                    raise InputError(f"{path}: <{printable(element.tag)}> names {error}") from None
                if element.tag == "flexcomp":
                    yield size / VERTEX_BYTES
                elif element.tag == "hfield":
                    self._count_cells(path, _pixels(found))

    def _included(self, path: Path, name: str) -> Iterator[Path]:
        """The files that an element of the file `path` includes by `name`: beside the model or
        beside the file itself, as versions of MuJoCo differ."""
        for found in {self._folder / name, path.parent / name}:
            if os.path.lexists(found):
                require(
                    any(found.resolve().is_relative_to(root) for root in self._roots),
                    f"{path}: includes {printable(name)}, which is outside its folder; put a copy "
                    "there",
                )
                yield found

    def _places(self, path: Path, root: ET.Element, name: str) -> set[Path]:
        """Where a file may stand; the last part of its name alone counts under `strippath`."""
        stated = [compiler.get(f"{kind}dir", "") for compiler in root.iter("compiler")
                  for kind in ("asset", "mesh", "texture")]  # fmt: skip
        names = {name, re.split(r"[\\/]", name)[-1]} - {""}
        places = {folder / place / each for folder in (path.parent, self._folder)
                  for place in ("", *stated) for each in names}  # fmt: skip
        return {place for place in places if os.path.lexists(place) and not place.is_dir()}

    def _count_file(self, path: Path) -> int:
        """Size of a file that is named once more, in bytes."""
        size = check_regular(path, "file")
        check_size(path, "file", size, MOST_MESH_BYTES)
        self._bytes += size
        require(
            self._bytes <= MOST_FILES_BYTES,
            f"{path}: with it the files that the model names have more than "
            f"{MOST_FILES_BYTES / 1e6:g} MB; keep the arm alone",
        )
        return size

    def _count_cells(self, path: Path, cells: float) -> None:
        self._cells += int(min(cells, 1e18))
        require(
            self._cells <= MOST_CELLS,
            f"{path}: <hfield> has more than {MOST_CELLS} points, which no arm needs; take it out",
        )


def _check_sizes(path: Path, element: ET.Element) -> None:
    tag = printable(element.tag)
    for key, text in element.attrib.items():
        stated = f"{path}: <{tag} {printable(key)}={quoted(text)}>"
        require(
            key in NAMES or not re.search(r"(?i)(?<!\S)[-+]?nan(?!\S)", text),
            f"{stated} is no number; correct it",
        )
        largest = LARGEST.get(element.tag, {}).get(key, math.inf)
        require(
            max(_numbers(text) if largest < math.inf else (), default=0.0) <= largest,
            f"{stated} asks for more than {largest:g}, which no arm needs; take it out",
        )


def _numbers(text: str) -> list[float]:
    """Sizes of the numbers in a text, of one with a unit ("2G") too."""
    found = _NUMBER.finditer(text)
    return [abs(float(m[0])) * _UNITS.get(text[m.end() : m.end() + 1].upper(), 1.0) for m in found]


def _count(element: ET.Element) -> float:
    """How often MuJoCo makes what an element states; a dimension that is 0 or not there counts as
    one, and a vertex or segment is a body with three joints and a geom."""
    if element.tag not in ("replicate", "composite", "flexcomp"):
        return 1.0
    count = math.prod(max(n, 1.0) for n in _numbers(element.get("count", "")))
    if element.tag == "replicate":
        return count
    return 5 * max(count, *(len(element.get(k, "").split()) / 3 for k in ("point", "vertex")))


def _pixels(path: Path) -> float:
    """Points of a height field's file: a PNG says them where it begins, however small it is."""
    with open_input(path, "file of <hfield>") as handle:
        head = handle.read(24)
    if head.startswith(b"\x89PNG") and len(head) == 24:
        return math.prod(map(float, struct.unpack(">II", head[16:24])))
    return 0.0


# Closed loops: <equality> that ties joints of the arm to each other.
#
# A chain of independent joints is read from the file, so none of them may depend on another.
# Bodies that constraints tie, directly or over bodies that float (<freejoint>, mocap), have to be
# carried by the same joint of the arm: otherwise those between are part of a loop.  Constraints on
# joint values (joint, fixed tendon) take one degree of freedom each: they bind the arm where a
# group of joints has more of them than joints beside the arm.

WORLD = 0
Tied = TypeVar("Tied", bound=Hashable)


@dataclass(frozen=True)
class Tie:
    """A constraint: pairs of `ends`, each (body or site, name), or the `joints` that it ties."""

    kind: str
    name: str
    ends: tuple[tuple[tuple[str, str], tuple[str, str]], ...] = ()
    joints: tuple[str, ...] = ()

    def __str__(self) -> str:
        tied = listed(f"'{name}'" for name in self.joints) or " and ".join(
            dict.fromkeys(f"{k} '{name or 'world'}'" for pair in self.ends for k, name in pair)
        )
        name = f" '{self.name}'" if self.name else ""
        return f"<equality><{self.kind}>{name} of {tied}"


def ties_of(spec: Any) -> list[Tie]:
    """The active constraints of a file, from MuJoCo's MjSpec of it."""
    import mujoco

    eq, found = mujoco.mjtEq, []
    tendons = {tendon.name: tendon for tendon in spec.tendons}
    for one in spec.equalities:
        names = [name for name in (one.name1, one.name2) if name]
        if not one.active:
            continue
        if one.type in (eq.mjEQ_CONNECT, eq.mjEQ_WELD):
            kind = "connect" if one.type == eq.mjEQ_CONNECT else "weld"
            what = "site" if one.objtype == mujoco.mjtObj.mjOBJ_SITE else "body"
            found.append(Tie(kind, one.name, (((what, one.name1), (what, one.name2)),)))
        elif one.type == eq.mjEQ_JOINT:
            found.append(Tie("joint", one.name, joints=tuple(names)))
        elif one.type == eq.mjEQ_TENDON:
            found += _of_tendons(one.name, [tendons[name] for name in names])
    return found


def _of_tendons(name: str, tendons: list[Any]) -> list[Tie]:
    """A tendon over joints ties these, one between sites their bodies."""
    import mujoco

    joints, ends = [], []
    for tendon in tendons:
        before = ""
        for wrap in getattr(tendon, "path", ()):
            if wrap.type == mujoco.mjtWrap.mjWRAP_JOINT:
                joints.append(wrap.target.name)
            elif wrap.type == mujoco.mjtWrap.mjWRAP_SITE:
                if before:
                    ends.append((("site", before), ("site", wrap.target.name)))
                before = wrap.target.name
    ties = [Tie("tendon", name, joints=tuple(joints))] if joints else []
    return ties + ([Tie("tendon", name, ends=tuple(ends))] if ends else [])


def check_open(arm: Any, ties: list[Tie]) -> None:
    """Raise InputError, naming constraint and joints, where an `MjcfArm` is no open chain.

    A weld of what the last joint carries to the world or to a mocap body is no loop of the arm's:
    people drag the flange by it.
    """
    _check_values(arm, [tie for tie in ties if tie.joints])
    free, order = _floating(arm), {None: -1} | {j: k for k, j in enumerate(arm.joints)}
    tied = ((pair, tie) for tie in ties for pair in _bodies(arm, tie))
    for bodies, members in _groups(tied):
        carriers = {order[arm.carrier(body)] for body in bodies - free}
        if len(carriers) > 1:
            joint = arm.joint_name(arm.joints[min(carriers) + 1])
            raise InputError(
                f"{arm.path}: joint '{joint}' is part of a closed loop, by "
                f"{listed(map(str, dict.fromkeys(members)))}; loops are not supported between base "
                "and flange, remove the constraint or choose another flange"
            )


def _groups(ties: Iterable[tuple[Iterable[Tied], Tie]]) -> list[tuple[set[Tied], list[Tie]]]:
    """What constraints tie to each other, with the constraints that do."""
    groups: list[tuple[set[Tied], list[Tie]]] = []
    for what, tie in ties:
        names, members = set(what), [tie]
        for other in [g for g in groups if g[0] & names]:
            groups.remove(other)
            names, members = names | other[0], other[1] + members
        groups.append((names, members))
    return groups


def _check_values(arm: Any, ties: list[Tie]) -> None:
    own = {arm.model.joint(j).name for j in arm.joints} - {""}
    for names, members in _groups((tie.joints, tie) for tie in ties):
        # joint1 of <joint> follows joint2, as a mimic does in a URDF.
        follows = [tie for tie in members if tie.kind == "joint" and tie.joints[0] in own]
        bound = names & own and len(members) > len(names - own)
        require(
            not follows and not bound,
            f"{arm.path}: joint {listed(repr(n) for n in sorted(names & own))} is coupled by "
            f"{listed(map(str, follows or members))}; coupled joints are not supported between "
            "base and flange, remove the constraint or choose another flange",
        )


def _bodies(arm: Any, tie: Tie) -> list[tuple[int, int]]:
    """The pairs of bodies that a constraint ties, without those that leave the arm open."""
    model, found = arm.model, []
    for ends in tie.ends:
        a, b = (
            WORLD if not name
            else int(model.site_bodyid[model.site(name).id]) if kind == "site"
            else int(model.body(name).id)
            for kind, name in ends
        )  # fmt: skip
        at_end = [arm.carrier(body) == arm.joints[-1] for body in (a, b)]
        still = [model.body_weldid[body] == WORLD for body in (a, b)]
        dragged = (at_end[0] and still[1]) or (at_end[1] and still[0])
        if not (tie.kind == "weld" and dragged):
            found.append((a, b))
    return found


def _floating(arm: Any) -> set[int]:
    """Bodies that are free of their parent."""
    import mujoco

    model, free = arm.model, mujoco.mjtJoint.mjJNT_FREE
    loose = {int(model.jnt_bodyid[j]) for j in range(model.njnt) if model.jnt_type[j] == free}
    return loose | {b for b in range(model.nbody) if model.body_mocapid[b] >= 0}
