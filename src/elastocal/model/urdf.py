"""Links and joints of a robot's XML file, the one way through them to a flange, and how a URDF
states them: what is wrong with the file is said by name.

Everything off the way from base to flange stands still.  Of a URDF only what kinematics and weights
need is read: links with mass and centre of mass, joints with parent, child, origin, axis and
limits.  Meshes, materials, plugins and transmissions are ignored.
"""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, reduce
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from elastocal.files import DEEPEST, read_bytes
from elastocal.messages import SHOWN, InputError, did_you_mean, listed, printable, require
from elastocal.model import rigid
from elastocal.model.chain import (
    FINGERS,
    MAX_JOINTS,
    MIN_JOINTS,
    Chain,
    Joint,
    JointKind,
    LinkMass,
    check_angles,
)
from elastocal.units import Array, pose_at, rotation_from_rpy

# An XML file, edited so that all else stays to the byte.
#
# An XML library would write the whole file anew: other quotes, no comments before the root, other
# white space.  Here a parser only says where the start tags stand; the text between is not touched.

MAX_BYTES = 10_000_000
UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
DECLARATION = re.compile(r"""(<\?xml[^>]*?\bencoding\s*=\s*)("[^"]*"|'[^']*')""")
END_OF_TAG = re.compile(rb"""(?:[^"'>]|"[^"]*"|'[^']*')*>""")  # a > in quotes is none


@dataclass(eq=False)
class Tag:
    """A start tag: its name without prefix, its offset in bytes, what it states, the tags that
    stand in it and the one that it stands in."""

    name: str
    prefix: str
    start: int
    stated: dict[str, str]
    above: Tag | None
    inside: list[Tag] = field(default_factory=list)

    def get(self, key: str, default: str = "") -> str:
        return self.stated.get(key, default)

    def all(self, *names: str) -> list[Tag]:
        return [tag for tag in self.inside if tag.name in names]

    def first(self, name: str) -> Tag | None:
        return next(iter(self.all(name)), None)

    def of(self, name: str, key: str) -> str | None:
        inside = self.first(name)
        return None if inside is None else inside.stated.get(key)


class XmlFile:
    """The tags of an XML file, and the edits to make in its text.  `tags` in the order of the file,
    the root first; `end`: where the root's end tag starts.  `what` it should be ("a URDF") stands
    in messages.  It nests no deeper than a robot does and declares no entities, which may stand for
    more text than memory holds."""

    def __init__(self, path: Path, data: bytes, what: str) -> None:
        start = data[:300].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
        require(
            not start.startswith(b"version https://git-lfs"),
            f"{path}: is a pointer of Git LFS, not {what}; run git lfs pull, or download the file",
        )
        require(
            not start.startswith((b"<!doctype html", b"<html")),
            f"{path}: is a web page, not {what}; download the file itself (on GitHub: Raw)",
        )
        self.path, self.what = path, what
        # A carriage return by itself ends a line in XML, and is a control character elsewhere.
        self.data = re.sub(rb"\r(?!\n)", b"\n", as_utf8(path, data))
        self.tags: list[Tag] = []
        self.end = len(self.data)
        self._inserted: list[tuple[int, int, bytes]] = []
        self._changed: dict[int, dict[str, str | None]] = {}
        self._parse()

    @classmethod
    def read(cls, path: Path, file: str, what: str) -> XmlFile:
        return cls(path, read_bytes(path, file, MAX_BYTES), what)

    @property
    def root(self) -> Tag:
        return self.tags[0]

    def _parse(self) -> None:
        parser = expat.ParserCreate("utf-8")
        open_: list[Tag] = []

        def start(name: str, stated: dict[str, str]) -> None:
            require(
                len(open_) < DEEPEST,
                f"{self.path}: <{printable(name)}> is nested more than {DEEPEST} deep, which no "
                "robot needs",
            )
            prefix, _, bare = name.rpartition(":")
            above = open_[-1] if open_ else None
            tag = Tag(bare, prefix, parser.CurrentByteIndex, stated, above)
            self.tags.append(tag)
            open_.append(tag)
            if above is not None:
                above.inside.append(tag)

        def end(name: str) -> None:
            open_.pop()
            if not open_:
                self.end = parser.CurrentByteIndex

        def doctype(*_: object) -> None:
            raise InputError(
                f"{self.path}: has a <!DOCTYPE>, which {self.what} does not; remove it"
            )

        parser.StartElementHandler, parser.EndElementHandler = start, end
        parser.StartDoctypeDeclHandler = doctype
        try:
            parser.Parse(self.data, True)
        except expat.ExpatError as error:
            told = str(error).partition(": line")[0]
            reason = _around(self.data) or _undeclared(self.data) or (
                f"{told} in line {error.lineno}, column {error.offset + 1}; {self.what} is an XML "
                "file"
            )  # fmt: skip
            raise InputError(f"{self.path}: not XML: {reason}") from None

    def insert(self, at: int, text: str) -> None:
        self._inserted.append((at, at, text.encode("utf-8")))

    def insert_in(self, tag: Tag, text: str) -> None:
        self.insert(self._end(tag.start), text)

    def remove(self, tag: Tag) -> None:
        self._inserted.append((tag.start, self._end(tag.start), b""))

    def set(self, tag: Tag, stated: Mapping[str, str], without: Collection[str] = ()) -> None:
        self._changed.setdefault(tag.start, {}).update(dict.fromkeys(without) | dict(stated))

    def set_in(self, tag: Tag, name: str, stated: Mapping[str, str]) -> None:
        if inside := tag.first(name):
            self.set(inside, stated)
        else:
            self.insert_in(tag, element(name, stated))

    def result(self) -> str:
        parts, last = [], 0
        changed = [self._edit(start, stated) for start, stated in self._changed.items()]
        for start, end, new in sorted([*self._inserted, *changed], key=lambda edit: edit[:2]):
            parts += [self.data[last:start], new]
            last = end
        return b"".join([*parts, self.data[last:]]).decode("utf-8")

    def _end(self, start: int) -> int:
        found = END_OF_TAG.match(self.data, start)
        assert found, "a parsed tag ends"
        return found.end()

    def _edit(self, start: int, stated: Mapping[str, str | None]) -> tuple[int, int, bytes]:
        end = self._end(start)
        tag = self.data[start:end].decode("utf-8")
        for name, value in stated.items():
            pattern = re.compile(rf"""(\s{name}\s*=\s*)("[^"]*"|'[^']*')""")
            found = pattern.search(tag)
            if value is None:
                tag = pattern.sub("", tag)
            elif found is not None:
                tag = tag[: found.start(2)] + quoteattr(value) + tag[found.end(2) :]
            else:
                body = tag[:-1].rstrip().removesuffix("/").rstrip()
                closing = "/>" if tag.endswith("/>") else ">"
                tag = f"{body} {name}={quoteattr(value)}{closing}"
        return start, end, tag.encode("utf-8")


def element(tag: str, stated: Mapping[str, str], *inside: str) -> str:
    head = f"<{tag}{''.join(f' {k}={quoteattr(v)}' for k, v in stated.items())}"
    return f"{head}>{''.join(inside)}</{tag}>" if inside else f"{head}/>"


def comment(text: str) -> str:
    return f"<!-- {text.replace('--', '- -').rstrip('-')} -->"


def as_utf8(path: Path, data: bytes) -> bytes:
    declared = DECLARATION.search(data[:200].decode("ascii", "replace"))
    name = declared.group(2).strip("\"'") if declared else "utf-8"
    name = "utf-16" if data.startswith(UTF16) else name
    if name.lower() in ("utf-8", "utf8"):
        return data
    try:
        text = data.decode(name)
    except (LookupError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as {name} ({error}); save it as UTF-8") from None
    return DECLARATION.sub(r'\g<1>"UTF-8"', text, count=1).encode("utf-8")


def _around(data: bytes) -> str:
    def first_line(text: bytes) -> str:
        return printable(text.strip().decode("utf-8", "replace").partition("\n")[0][:SHOWN])

    head = re.search(rb"<\?xml\b|<(?:robot|mujoco)\b", data)
    before = data[: head.start()].removeprefix(b"\xef\xbb\xbf") if head else b""
    declared = head is not None and head[0] == b"<?xml"
    if before.strip() or (before and declared):
        told = f"'{first_line(before)}' stands" if before.strip() else "blanks stand"
        return f"{told} before {'<?xml …?>' if declared else 'it'}; remove that"
    tail = re.search(rb"</(?:robot|mujoco)\s*>", data)
    after = data[tail.end() :] if tail else b""
    if re.sub(rb"<!--.*?-->", b"", after, flags=re.DOTALL).strip():
        return f"'{first_line(after)}' stands after the end of the robot; remove that"
    return ""


def _undeclared(data: bytes) -> str:
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        return (
            f"line {line} has the byte 0x{data[error.start]:02x}, which is not UTF-8, and no "
            'encoding is declared; save it as UTF-8, or declare it: <?xml version="1.0" '
            'encoding="latin-1"?>'
        )
    return ""


# Links and joints, whatever file states them.

Vector = tuple[float, float, float]
MOVING = ("revolute", "continuous", "prismatic")
# Names of flanges, the usual first.
FLANGES = ("tool0", "flange", "ee_link", "tcp")
MOST_IN_A_FINGER = 5  # joints
# Links that `elastocal export` hangs on a flange; none of them is a flange itself.
TOOL_FRAMES = ("elastocal_marker_", "elastocal_load_point")


@dataclass(frozen=True, eq=False)
class FileJoint:
    """A joint of the file: `origin` T (4, 4) from its frame at zero, which is its child's, to its
    parent link's; unit `axis`; `limit` None where none is stated, infinite where there is none.
    `follows`: the joint that it mimics; `rest`: where it stands when it is not part of the way;
    `number` is MuJoCo's."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Array
    axis: Array
    limit: tuple[float, float] | None = None
    follows: str | None = None
    rest: float = 0.0
    number: int = -1

    @property
    def moves(self) -> bool:
        return self.kind in MOVING

    @property
    def motion(self) -> JointKind:
        return "prismatic" if self.kind == "prismatic" else "revolute"

    @property
    def held(self) -> Array:
        """T (4, 4) from the child's frame to the parent's where it stands still."""
        if not self.rest:
            return self.origin
        return self.origin @ rigid.moved(self.motion, self.axis, self.rest)


@dataclass(frozen=True)
class Tree:
    """Links, each with its own mass (0 where the file has none), and joints, in file order.
    `parts`: what links are called; `frames`: other names of places, fixed to a link.  Raises
    InputError at construction unless they form one tree: every link has at most one parent joint,
    exactly one has none, and all hang on that root."""

    path: Path
    name: str
    links: dict[str, LinkMass]
    joints: tuple[FileJoint, ...]
    parts: str = "links"
    frames: dict[str, tuple[str, Array]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for joint in self.joints:
            other = self.parent_joint[joint.child]
            require(
                other is joint,
                f"{self.path}: link '{joint.child}' has two parents, joints '{joint.name}' and "
                f"'{other.name}'; kinematic loops are not supported, remove one of them",
            )
        roots = [name for name in self.links if name not in self.parent_joint]
        reached = {link for root in roots for link in self._below(root)}
        if lost := [name for name in self.links if name not in reached]:
            way = [lost[0]]
            while way.count(way[-1]) < 2:
                way.append(self.parent_joint[way[-1]].parent)
            cycle = [self.parent_joint[name].name for name in way[way.index(way[-1]) : -1]]
            raise InputError(
                f"{self.path}: joints {listed(cycle[::-1])} form a closed loop "
                "that hangs on no root link; loops are not supported, open it at one joint"
            )
        require(
            len(roots) == 1,
            f"{self.path}: {len(roots)} links have no parent joint: {listed(roots)}; a robot "
            "is one tree with one root, connect or remove the others",
        )

    @cached_property
    def parent_joint(self) -> dict[str, FileJoint]:
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def _children(self) -> dict[str, list[str]]:
        children: dict[str, list[str]] = {name: [] for name in self.links}
        for joint in self.joints:
            children[joint.parent].append(joint.child)
        return children

    @property
    def root(self) -> str:
        return next(name for name in self.links if name not in self.parent_joint)

    def _below(self, link: str) -> Iterator[str]:
        waiting = [link]
        while waiting:
            link = waiting.pop()
            yield link
            waiting += self._children[link]

    def link_of(self, name: str) -> tuple[str, Array]:
        """The link that a name stands for, and its place (4, 4) in that link's frame."""
        return (name, np.eye(4)) if name in self.links else self.frames[name]

    def joints_between(self, base: str, flange: str) -> tuple[FileJoint, ...] | None:
        joints: list[FileJoint] = []
        link = self.link_of(flange)[0]
        while link != base:
            if link not in self.parent_joint:
                return None
            joints.append(self.parent_joint[link])
            link = joints[-1].parent
        return tuple(reversed(joints))

    def find(self, role: str, name: str, usual: str = "") -> str:
        there = [*self.links, *(self.frames if role == "flange" else ())]
        hint = did_you_mean(name, there)
        hint += f" (usual here: '{usual}')" if usual and f"'{usual}'" not in hint else ""
        require(
            name in there,
            f"{self.path}: {role} '{name}' is not there{hint}; {self.parts}: {listed(there)}",
        )
        return name

    def ends(self, base: str | None, flange: str | None, choose: bool = True) -> tuple[str, str]:
        """The first and the last link, None for those that are found.  `choose`: whether a flange
        is found among several links that it could be: a cell that leaves the choice open may have
        meant another frame."""
        base = self.root if base is None else self.find("base", base, self.root)
        if flange is None:
            found = self.last_link(base)
            able = [k for k in self._leaves(base) if len(self._moving(base, k)) >= MIN_JOINTS]
            require(
                choose or len(able) < 2,
                f"{self.path}: several links could be the flange: "
                f"{listed(sorted({*able, found}))}; name the right one as `flange` (init takes "
                f"'{found}')",
            )
            return base, found
        usual = ""
        if flange not in self.links and flange not in self.frames:
            with suppress(InputError):  # of several arms, each with an end of its own
                usual = self.last_link(base)
        return base, self.find("flange", flange, usual)

    def last_link(self, base: str) -> str:
        """The link below `base` from which on fingers, or frames that none moves, branch off.  Of
        the links that no other hangs on, those with the most moving joints on their way have it in
        common; among frames at its end one with a usual name is taken."""
        arms: dict[tuple[FileJoint, ...], list[str]] = {}
        for leaf in self._leaves(base):
            way = self._moving(base, leaf)
            if len(way) >= MIN_JOINTS:
                arms.setdefault(tuple(way[:MIN_JOINTS]), []).append(leaf)
        ends = [self._end_of_arm(base, leaves) for leaves in arms.values()]
        require(
            len(ends) < 2,
            f"{self.path}: several {self.parts} could be the flange, one of each arm: "
            f"{listed(sorted(ends))}; name the right one as `flange`, and its base",
        )
        if ends:
            return ends[0]
        return max(self._leaves(base), key=lambda leaf: len(self._moving(base, leaf)))

    def _leaves(self, base: str) -> list[str]:
        """Links on which nothing hangs but tool frames that `export` has added."""
        return [
            link for link in self._below(base)
            if not link.startswith(TOOL_FRAMES)
            and all(child.startswith(TOOL_FRAMES) for child in self._children[link])
        ]  # fmt: skip

    def _end_of_arm(self, base: str, leaves: Sequence[str]) -> str:
        sizes = {leaf: len(self._moving(base, leaf)) for leaf in leaves}
        most = max(sizes.values())
        ways = [[joint.child for joint in self.joints_between(base, leaf) or ()]
                for leaf in leaves if sizes[leaf] == most]  # fmt: skip
        common = [link for link in ways[0] if all(link in way for way in ways)]
        if len(self._moving(base, common[-1])) == most and len(ways) > 1:
            named = (way[-1] for name in FLANGES for way in ways if way[-1] == name)
            return next(named, common[-1])
        # Fingers of unequal length, as a thumb has: no link is common to those with most joints.
        for link in common:
            before, after = (len(self._moving(*p)) for p in ((base, link), (link, common[-1])))
            if before < MIN_JOINTS or not 0 < after <= MOST_IN_A_FINGER:
                continue
            own = ([self.parent_joint[k] for k in self._below(child)]
                   for child in self._children[link] if child not in common)  # fmt: skip
            beside = [joints for joints in own if any(joint.moves for joint in joints)]
            fingers = (j.follows is not None or FINGERS.search(j.name + j.child)
                       for joints in beside for j in joints)  # fmt: skip
            if len(beside) > 1 or any(fingers):
                return link
        return common[-1]

    def _moving(self, base: str, flange: str) -> list[FileJoint]:
        return [j for j in self.joints_between(base, flange) or () if j.moves]

    def placed(self, link: str) -> Array:
        held = (joint.held for joint in self.joints_between(self.root, link) or ())
        return reduce(np.matmul, held, np.eye(4))

    def serial_chain(self, base: str, flange: str) -> tuple[FileJoint, ...]:
        joints = self.joints_between(base, flange)
        if joints is None:
            raise InputError(
                f"{self.path}: flange '{flange}' is not below base '{base}'; {self.parts} below "
                f"'{base}': {listed(link for link in self._below(base) if link != base)}"
            )
        for joint in joints:
            where = f"{self.path}: joint '{joint.name}'"
            bounded = joint.moves and joint.kind != "continuous"
            lower, upper = joint.limit or (-math.inf, math.inf)
            require(
                joint.moves or joint.kind == "fixed",
                f"{where} is {joint.kind} and lies between base and flange; only "
                f"{', '.join(MOVING)} and fixed joints can, choose a base below it",
            )
            require(
                joint.follows is None or not joint.moves,
                f"{where} mimics '{joint.follows}' and lies between base and flange; coupled "
                "joints are not supported there, remove <mimic> or choose another flange",
            )
            require(
                joint.limit is not None or not bounded,
                f'{where} is {joint.kind} without <limit>; add <limit lower="…" upper="…" '
                'effort="0" velocity="0"/> or make it continuous',
            )
            require(
                lower < upper or not bounded,
                f"{where}: limits lower={lower:g}, upper={upper:g} leave no room to move; "
                "lower must be below upper (a URDF takes 0 for one left out)",
            )
        moving = self._moving(base, flange)
        names = listed(j.name or f"joint{k}" for k, j in enumerate(moving, start=1)) or "none"
        require(
            MIN_JOINTS <= len(moving) <= MAX_JOINTS,
            f"{self.path}: {len(moving)} moving joints between '{base}' and '{flange}' "
            f"({names}); {MIN_JOINTS} to {MAX_JOINTS} are supported, choose base and flange "
            "accordingly",
        )
        return tuple(moving)

    def carriers(self, moving: Sequence[FileJoint]) -> dict[str, tuple[int, Array]]:
        """Every link that one of the joints moves: number of the last of them, and the place (4, 4)
        in its frame."""
        own = {joint.child: k for k, joint in enumerate(moving)}
        at: dict[str, tuple[int, Array]] = {}
        for link in self._below(self.root):
            before = self.parent_joint.get(link)
            if link in own:
                at[link] = own[link], np.eye(4)
            elif before is not None and before.parent in at:
                k, T = at[before.parent]
                at[link] = k, T @ before.held
        return at

    def chain(self, base: str, flange: str) -> Chain:
        """Placements in m, unit axes, limits in rad or m, and one mass per joint in kg of all that
        it carries up to the next one, with its centre in m in the joint's frame; none where all
        are zero.  Bodies beyond the flange and on side branches count, those on the base do not."""
        moving = self.serial_chain(base, flange)
        joints, T = list[Joint](), np.eye(4)
        mass, moment = np.zeros(len(moving)), np.zeros((len(moving), 3))
        with np.errstate(over="ignore", invalid="ignore"):  # numbers of 1e308 are judged later
            for source in self.joints_between(base, flange) or ():
                T = T @ source.origin
                if source.moves:
                    name = source.name or f"joint{len(joints) + 1}"
                    limits = source.limit or (-np.inf, np.inf)
                    joints.append(Joint(name, source.motion, T, source.axis, *limits))
                    T = np.eye(4)
            for link, (k, place) in self.carriers(moving).items():
                body = self.links[link]
                mass[k] += body.mass
                moment[k] += body.mass * (place @ [*body.com, 1.0])[:3]
            both = zip(mass, moment, strict=True)
            masses = tuple(LinkMass(float(m), s / m if m > 0 else np.zeros(3)) for m, s in both)
        end = T @ self.link_of(flange)[1]
        return Chain(self.name, tuple(joints), end, masses if mass.any() else ())


JOINT_TYPES = (*MOVING, "fixed", "floating", "planar")
MOST_LINKS = 2000
ENDLESS_TEXT = re.compile(r"([+-]?)\.?inf(?:inity)?", re.IGNORECASE)
# What xacro, roslaunch and launch files would put in.
LEFT = re.compile(r"\$\{|\$\((?:arg|find|env|optenv|eval|dirname|anon)\b")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def read_urdf(path: str | Path, base: str | None = None, flange: str | None = None) -> Chain:
    """The serial chain between two links of a URDF: from the frame of `base`, default the root
    link, to `flange`, default the only leaf that at least four moving joints carry."""
    tree = check_urdf(path)
    return tree.chain(*tree.ends(base, flange, choose=False))


def check_urdf(path: str | Path) -> Tree:
    return tree_of(urdf_file(Path(path)))


def urdf_file(path: Path) -> XmlFile:
    return XmlFile.read(path, "URDF file", "a URDF")


def tree_of(file: XmlFile) -> Tree:
    path, root = file.path, file.root
    for tag in file.tags:
        require(tag.prefix != "xacro", xacro_left(path, f"<xacro:{tag.name}>"))
        # Files of meshes and plug-ins are not read.
        values = [v for k, v in tag.stated.items() if k not in ("filename", "file")]
        macro = next((v for v in values if LEFT.search(v)), None)
        require(macro is None, xacro_left(path, f"'{macro}' in <{tag.name}>"))
    hint = {
        "mujoco": '; this is MJCF, give it as mjcf = "…"',
        "sdf": "; this is SDF, export it as URDF",
    }.get(root.name, "")
    require(
        root.name == "robot",
        f'{path}: the root element is <{root.name}>, a URDF has <robot name="…">{hint}',
    )
    links: dict[str, LinkMass] = {}
    for tag in root.all("link"):
        name, inertial = _name(path, tag, links), tag.first("inertial")
        where, mass, com = f"{path}: link '{name}'", 0.0, (0.0, 0.0, 0.0)
        if inertial is not None:
            if (value := inertial.of("mass", "value")) is None:
                told = f'{where}: <inertial> without <mass value="…">; add it or remove <inertial>'
                raise InputError(told)
            mass = _number(f"{where}, mass value", value)
            require(mass >= 0, f"{where}: mass {mass:g} kg is negative; give kg, zero or more")
            com = _vector(where, inertial, "origin", "xyz")
        links[name] = LinkMass(mass, np.array(com))
    require(bool(links), f"{path}: <robot> has no <link>; a robot needs links and joints")
    joints: dict[str, FileJoint] = {}
    for tag in root.all("joint"):
        name = _name(path, tag, joints)
        joints[name] = _joint(f"{path}: joint '{name}'", name, tag, links)
    for joint in joints.values():
        if joint.follows is not None and joint.follows not in joints:
            raise InputError(
                f"{path}: joint '{joint.name}' mimics joint '{joint.follows}', which is not there"
                f"{did_you_mean(joint.follows, joints)}; name an existing joint"
            )
    return Tree(path, root.get("name") or path.stem, links, tuple(joints.values()))


def xacro_left(path: Path, what: str) -> str:
    plain = path.name.removesuffix(".xacro")
    plain = plain if plain.endswith(".urdf") and plain != path.name else "expanded.urdf"
    return (
        f"{path}: xacro macros are left in ({what}); run xacro first: xacro {path.name} > {plain}"
    )


def _name(path: Path, tag: Tag, known: Collection[str]) -> str:
    kind, name = tag.name, tag.get("name").strip()
    require(len(known) < MOST_LINKS, f"{path}: more than {MOST_LINKS} {kind}s; remove some")
    require(
        bool(name), f'{path}: {kind} number {len(known) + 1} has no name; write <{kind} name="…">'
    )
    require(
        name not in known,
        f"{path}: two {kind}s are named '{name}'; names must be unique, rename one",
    )
    return name


def _joint(where: str, name: str, tag: Tag, links: Collection[str]) -> FileJoint:
    kind = tag.stated.get("type", "")
    require("type" in tag.stated, f'{where} has no type; write type="{"|".join(JOINT_TYPES)}"')
    require(
        kind in JOINT_TYPES,
        f"{where}: unknown joint type '{kind}'{did_you_mean(kind, JOINT_TYPES)}; "
        f"valid: {', '.join(JOINT_TYPES)}",
    )
    axis = np.array(_vector(where, tag, "axis", "xyz", (1.0, 0.0, 0.0)))  # URDF default
    length = math.hypot(*axis)
    require(
        kind not in MOVING or length >= 1e-9,
        f'{where}: axis is zero; give a direction such as xyz="0 0 1"',
    )
    limit = None
    if (stated := tag.first("limit")) is not None:
        lower, upper = (
            _number(f"{where}, limit {side}", stated.get(side, "0"), endless=True)
            for side in ("lower", "upper")
        )
        limit = None if kind == "continuous" else (lower, upper)
    mimic, rpy = tag.first("mimic"), _vector(where, tag, "origin", "rpy")
    check_angles(f"{where}, origin rpy", rpy, "a URDF takes rad")
    return FileJoint(
        name,
        kind,
        parent=_end(where, tag, "parent", links),
        child=_end(where, tag, "child", links),
        origin=pose_at(_vector(where, tag, "origin", "xyz"), rotation_from_rpy(rpy)),
        axis=axis / length if length else axis,
        limit=limit,
        follows=None if mimic is None else mimic.get("joint"),
    )


def _end(where: str, joint: Tag, side: str, links: Collection[str]) -> str:
    name = joint.of(side, "link") or ""
    require(bool(name), f'{where} has no {side} link; add <{side} link="…"/>')
    require(
        name in links,
        f"{where}: {side} link '{name}' is not there{did_you_mean(name, links)}; "
        "name an existing link or add it",
    )
    return name


def _vector(
    where: str, above: Tag, name: str, key: str, default: Vector = (0.0, 0.0, 0.0)
) -> Vector:
    if (text := above.of(name, key)) is None:
        return default
    words, what = text.split(), f"{where}, {name} {key}"
    require(len(words) == 3, f"{what}: '{text}' is not three numbers; write e.g. {key}=\"0 0 1\"")
    x, y, z = (_number(what, word) for word in words)
    return x, y, z


def _number(what: str, text: str, endless: bool = False) -> float:
    text = text.strip()
    if endless and (found := ENDLESS_TEXT.fullmatch(text)):
        return float(f"{found[1]}inf")
    value = float(text) if NUMBER.fullmatch(text) else math.nan
    require(
        math.isfinite(value), f"{what}: '{text}' is not a finite number; write e.g. 0.25 or -1.5e-3"
    )
    return value
