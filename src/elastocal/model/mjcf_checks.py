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
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
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
    model = _Model(path)
    weight = model.weight_of(path, data)
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
        self._roots = {os.path.realpath(path.parent), os.path.dirname(os.path.realpath(path))}
        self._weights: dict[str, float] = {}
        self._open: list[str] = []
        self._text = self._bytes = self._cells = 0

    def weight_of(self, path: Path, data: bytes | None = None) -> float:
        """The weight of an XML file, which is read once."""
        real = os.path.realpath(path)
        require(real not in self._open, f"{path}: includes itself; take out the <include>")
        if real not in self._weights:
            self._open.append(real)
            if data is None:
                data = read_bytes(path, "included model", MAX_BYTES)
            self._text += len(data)
            check_size(path, "MuJoCo model with all it includes", self._text, MAX_BYTES)
            root = xml_tree(path, data, "an MJCF file")
            self._weights[real] = _File(self, path, root).weight(root)
            self._open.pop()
        return self._weights[real]

    def included(self, path: Path, name: str) -> Iterator[Path]:
        """The files that an element of the file `path` includes by `name`: beside the model or
        beside the file itself, as versions of MuJoCo differ."""
        for found in {self._folder / name, path.parent / name}:
            if os.path.lexists(found):
                inside = any(
                    os.path.commonpath([root, os.path.realpath(found)]) == root
                    for root in self._roots
                )
                require(
                    inside,
                    f"{path}: includes {printable(name)}, which is outside its folder; put a copy "
                    "there",
                )
                yield found

    def count_file(self, path: Path, what: str) -> int:
        """Size of a file that is named once more, in bytes."""
        size = check_regular(path, what)
        check_size(path, what, size, MOST_MESH_BYTES)
        self._bytes += size
        require(
            self._bytes <= MOST_FILES_BYTES,
            f"{path}: with it the files that the model names have more than "
            f"{MOST_FILES_BYTES / 1e6:g} MB; keep the arm alone",
        )
        return size

    def count_cells(self, path: Path, cells: float) -> None:
        self._cells += int(min(cells, 1e18))
        require(
            self._cells <= MOST_CELLS,
            f"{path}: <hfield> has more than {MOST_CELLS} points, which no arm needs; take it out",
        )


class _File:
    """One file of a model: its elements and where the files that they name may stand."""

    def __init__(self, model: _Model, path: Path, root: ET.Element) -> None:
        self._model, self._path = model, path
        named = {
            compiler.get(key, "")
            for compiler in root.iter("compiler")
            for key in ("assetdir", "meshdir", "texturedir")
        }
        folders = {path.parent, model._folder}
        self._places = [folder / name for folder in folders for name in sorted({"", *named})]
        self._models = {
            one.get("name") or Path(one.get("file", "")).stem: one.get("file", "")
            for one in root.iter("model")
        }

    def weight(self, element: ET.Element) -> float:
        """How many elements MuJoCo makes of it and all within it."""
        self._check_sizes(element)
        inside = 1 + sum(self.weight(child) for child in element)
        inside += sum(self._named(element))
        return inside * _COUNTS.get(element.tag, _once)(element.attrib)

    def _named(self, element: ET.Element) -> Iterator[float]:
        """Weights of the files that it names: of a model its elements, of a grid its vertices."""
        if element.tag in ("include", "model"):
            for found in self._model.included(self._path, element.get("file", "")):
                yield self._model.weight_of(found)
            return
        if element.tag == "attach":
            name = self._models.get(element.get("model", ""), "")
            for found in self._model.included(self._path, name) if name else ():
                yield self._model.weight_of(found)
        for key, name in element.attrib.items():
            if key.startswith("file") and name:
                for found in self._candidates(name):
                    try:
                        size = self._model.count_file(found, "file")
                    except InputError as error:
                        tag = printable(element.tag)
                        raise InputError(f"{self._path}: <{tag}> names {error}") from None
                    if element.tag == "flexcomp":
                        yield size / VERTEX_BYTES
                    elif element.tag == "hfield":
                        self._model.count_cells(self._path, _pixels(found))

    def _candidates(self, name: str) -> set[Path]:
        """Where a file may stand; the last part of its name alone counts under `strippath`."""
        names = {name, re.split(r"[\\/]", name)[-1]}
        places = {place / each for place in self._places for each in names if each}
        return {place for place in places if os.path.lexists(place) and not place.is_dir()}

    def _check_sizes(self, element: ET.Element) -> None:
        tag = element.tag
        for key, text in element.attrib.items():
            require(
                key in NAMES or not re.search(r"(?i)(?<!\S)[-+]?nan(?!\S)", text),
                f"{self._path}: <{printable(tag)} {printable(key)}={quoted(text)}> is no number; "
                "correct it",
            )
        for key, largest in LARGEST.get(tag, {}).items():
            if max(_numbers(element.get(key, "")), default=0.0) > largest:
                raise InputError(
                    f"{self._path}: <{tag} {key}={quoted(element.get(key, ''))}> asks for more "
                    f"than {largest:g}, which no arm needs; take it out"
                )
        if tag == "hfield":
            rows, columns = (math.prod(_numbers(element.get(k, ""))) for k in ("nrow", "ncol"))
            self._model.count_cells(self._path, rows * columns)


def _numbers(text: str) -> list[float]:
    """Sizes of the numbers in a text, of one with a unit ("2G") too."""
    found = _NUMBER.finditer(text)
    return [abs(float(m[0])) * _UNITS.get(text[m.end() : m.end() + 1].upper(), 1.0) for m in found]


def _once(given: Mapping[str, str]) -> float:
    return 1.0


def _product(given: Mapping[str, str]) -> float:
    """Of all numbers of `count`; a dimension that is 0 or not there counts as one."""
    return math.prod(max(n, 1.0) for n in _numbers(given.get("count", "")))


def _vertices(given: Mapping[str, str]) -> float:
    """Each vertex of a flex is a body with three slides."""
    return 5 * max(_product(given), len(given.get("point", "").split()) / 3, 1.0)


def _segments(given: Mapping[str, str]) -> float:
    """Each segment of a composite is a body with joints and a geom."""
    return 5 * max(_product(given), len(given.get("vertex", "").split()) / 3, 1.0)


_COUNTS: dict[str, Callable[[Mapping[str, str]], float]] = {
    "replicate": _product, "composite": _segments, "flexcomp": _vertices,
}  # fmt: skip


def _pixels(path: Path) -> float:
    """Points of a height field's file: a PNG says them where it begins, however small it is."""
    with open_input(path, "file of <hfield>") as handle:
        head = handle.read(24)
    if head.startswith(b"\x89PNG") and len(head) == 24:
        width, height = struct.unpack(">II", head[16:24])
        return float(width) * float(height)
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
