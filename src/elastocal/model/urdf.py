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
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, reduce
from itertools import takewhile
from pathlib import Path
from xml.parsers import expat

import numpy as np

from elastocal import messages
from elastocal.files import DEEPEST, read_bytes
from elastocal.messages import InputError, check_known, did_you_mean, listed, printable, require
from elastocal.model import chain, rigid
from elastocal.model.chain import MAX_JOINTS, MIN_JOINTS, Chain, Joint, JointKind, LinkMass
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
    """A start tag: its name without and with its prefix, its offset in bytes, what it states, the
    tags that stand in it and the one that it stands in."""

    name: str
    whole: str
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
        head = data[:300].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
        require(
            not head.startswith(b"version https://git-lfs"),
            f"{path}: is a pointer of Git LFS, not {what}; run git lfs pull, or download the file",
        )
        require(
            not head.startswith((b"<!doctype html", b"<html")),
            f"{path}: is a web page, not {what}; download the file itself (on GitHub: Raw)",
        )
        self.path, self.what = path, what
        # A carriage return by itself ends a line in XML, and is a control character elsewhere.
        self.data = re.sub(rb"\r(?!\n)", b"\n", _as_utf8(path, data))
        self.tags: list[Tag] = []
        self.end = len(self.data)
        self._edits: dict[tuple[int, int], str] = {}  # what stands from byte to byte
        open_: list[Tag] = []

        def start(name: str, stated: dict[str, str]) -> None:
            require(
                len(open_) < DEEPEST,
                f"{path}: <{printable(name)}> is nested more than {DEEPEST} deep, which no robot "
                "needs",
            )
            above = open_[-1] if open_ else None
            tag = Tag(name.rpartition(":")[2], name, parser.CurrentByteIndex, stated, above)
            self.tags.append(tag)
            open_.append(tag)
            if above is not None:
                above.inside.append(tag)

        def end(name: str) -> None:
            open_.pop()
            if not open_:
                self.end = parser.CurrentByteIndex

        def doctype(*_: object) -> None:
            raise InputError(f"{path}: has a <!DOCTYPE>, which {what} does not; remove it")

        parser = expat.ParserCreate("utf-8")
        parser.StartElementHandler = start
        parser.EndElementHandler = end
        parser.StartDoctypeDeclHandler = doctype
        try:
            parser.Parse(self.data, True)
        except expat.ExpatError as error:
            told = str(error).partition(": line")[0]
            place = f"in line {error.lineno}, column {error.offset + 1}; {what} is an XML file"
            reason = _unlike_xml(self.data) or f"{told} {place}"
            raise InputError(f"{path}: not XML: {reason}") from None

    @classmethod
    def read(cls, path: Path, file: str, what: str) -> XmlFile:
        return cls(path, read_bytes(path, file, MAX_BYTES), what)

    @property
    def root(self) -> Tag:
        return self.tags[0]

    def insert(self, at: int, text: str) -> None:
        self._edits[at, at] = self._edits.get((at, at), "") + text

    def insert_in(self, tag: Tag, text: str) -> None:
        self.insert(self._place(tag)[1], text)

    def remove(self, tag: Tag) -> None:
        self._edits[self._place(tag)] = ""

    def set(self, tag: Tag, stated: Mapping[str, str], without: Collection[str] = ()) -> None:
        kept = {key: value for key, value in tag.stated.items() if key not in without}
        tag.stated = kept | dict(stated)
        start, end = self._place(tag)
        new = element(tag.whole, tag.stated)
        closed = self.data.endswith(b"/>", start, end)
        self._edits[start, end] = new if closed else f"{new[:-2]}>"

    def set_in(self, tag: Tag, name: str, stated: Mapping[str, str]) -> None:
        if inside := tag.first(name):
            self.set(inside, stated)
        else:
            self.insert_in(tag, element(name, stated))

    def result(self) -> str:
        parts, last = [], 0
        for (start, end), new in sorted(self._edits.items()):
            parts += [self.data[last:start], new.encode("utf-8")]
            last = end
        return b"".join([*parts, self.data[last:]]).decode("utf-8")

    def _place(self, tag: Tag) -> tuple[int, int]:
        found = END_OF_TAG.match(self.data, tag.start)
        assert found, "a parsed tag ends"
        return tag.start, found.end()


def element(tag: str, stated: Mapping[str, str], *inside: str) -> str:
    from xml.sax.saxutils import quoteattr  # loads the modules of the internet, for a file written

    head = f"<{tag}{''.join(f' {k}={quoteattr(v)}' for k, v in stated.items())}"
    return f"{head}>{''.join(inside)}</{tag}>" if inside else f"{head}/>"


def comment(text: str) -> str:
    return f"<!-- {text.replace('--', '- -').rstrip('-')} -->"


def _as_utf8(path: Path, data: bytes) -> bytes:
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


def _unlike_xml(data: bytes) -> str:
    """Of a text that is no XML why, where that is plainer than what the parser says."""

    def first_line(text: bytes) -> str:
        first = text.strip().decode("utf-8", "replace").partition("\n")[0]
        return printable(first[: messages.SHOWN])

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
LEAST_MASS = 1e-6  # kg of all links; MuJoCo takes no moving body without a mass
# Links that `elastocal export` hangs on a flange; none of them is a flange itself.
TOOL_FRAMES = ("elastocal_marker_", "elastocal_load_point")
TRACKER = "elastocal_tracker"  # the root that it puts above a robot with --base-frame


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
        if lost := [name for name in self.links if name not in self.ways]:
            way = [lost[0]]
            while way.count(way[-1]) < 2:
                way.append(self.parent_joint[way[-1]].parent)
            cycle = [self.parent_joint[name].name for name in way[way.index(way[-1]) : -1]]
            raise InputError(
                f"{self.path}: joints {listed(cycle[::-1])} form a closed loop "
                "that hangs on no root link; loops are not supported, open it at one joint"
            )
        require(
            len(self._roots) == 1,
            f"{self.path}: {len(self._roots)} links have no parent joint: {listed(self._roots)}; a "
            "robot is one tree with one root, connect or remove the others",
        )

    @cached_property
    def parent_joint(self) -> dict[str, FileJoint]:
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def ways(self) -> dict[str, tuple[FileJoint, ...]]:
        """The joints from the root to each link that hangs on one, a link before those on it."""
        found: dict[str, tuple[FileJoint, ...]] = {}
        below: dict[str, list[FileJoint]] = {name: [] for name in self.links}
        for joint in self.joints:
            below[joint.parent].append(joint)
        waiting = [(name, tuple[FileJoint, ...]()) for name in self._roots]
        while waiting:
            link, way = waiting.pop()
            found[link] = way
            waiting += [(joint.child, (*way, joint)) for joint in below[link]]
        return found

    @property
    def _roots(self) -> list[str]:
        return [name for name in self.links if name not in self.parent_joint]

    @property
    def root(self) -> str:
        return self._roots[0]

    def link_of(self, name: str) -> tuple[str, Array]:
        """The link that a name stands for, and its place (4, 4) in that link's frame."""
        return (name, np.eye(4)) if name in self.links else self.frames[name]

    def joints_between(self, base: str, flange: str) -> tuple[FileJoint, ...]:
        """Those on the way; none where there is no such way."""
        way = self.ways[self.link_of(flange)[0]]
        parents = [joint.parent for joint in way]
        return way[parents.index(base) :] if base in parents else ()

    def _below(self, base: str) -> list[str]:
        return [link for link in self.ways if link == base or self.joints_between(base, link)]

    def find(self, role: str, name: str, usual: str = "") -> str:
        there = [*self.links, *(self.frames if role == "flange" else ())]
        hint = did_you_mean(name, there)
        hint += f" (usual here: '{usual}')" if usual and f"'{usual}'" not in hint else ""
        told = f"{self.path}: {role} '{name}' is not there{hint}; {self.parts}: {listed(there)}"
        require(name in there, told)
        return name

    def ends(self, base: str | None, flange: str | None, choose: bool = True) -> tuple[str, str]:
        """The first and the last link, None for those that are found.  `choose`: whether a flange
        is found among several links that it could be: a cell that leaves the choice open may have
        meant another frame."""
        start = self.root if base is None else self.find("base", base, self.root)
        if flange is None:
            found = self.last_link(start)
            able = [k for k in self._leaves(start) if len(self._moving(start, k)) >= MIN_JOINTS]
            require(
                choose or len(able) < 2,
                f"{self.path}: several links could be the flange: "
                f"{listed(sorted({*able, found}))}; name the right one as `flange` (init takes "
                f"'{found}')",
            )
            return base or self._first_link(found), found
        usual = ""
        if flange not in self.links and flange not in self.frames:
            with suppress(InputError):  # of several arms, each with an end of its own
                usual = self.last_link(start)
        flange = self.find("flange", flange, usual)
        return base or self._first_link(flange), flange

    def _first_link(self, flange: str) -> str:
        """The root, or what floats or drives about below it with the arm on it."""
        still = [*takewhile(lambda joint: not joint.moves, self.ways[self.link_of(flange)[0]])]
        free = [k for k, joint in enumerate(still) if joint.kind != "fixed"]
        # A body of MuJoCo stands without a name behind its joint.
        own = [j.child for k in free[-1:] for j in still[k : k + 2] if j is still[k] or not j.name]
        return own[-1] if own else self.root

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
        parents = {j.parent for j in self.joints if not j.child.startswith(TOOL_FRAMES)}
        below = (link for link in self._below(base) if link not in parents)
        return [link for link in below if not link.startswith(TOOL_FRAMES)]

    def _end_of_arm(self, base: str, leaves: Sequence[str]) -> str:
        sizes = {leaf: len(self._moving(base, leaf)) for leaf in leaves}
        most = max(sizes.values())
        ways = [[joint.child for joint in self.joints_between(base, leaf)]
                for leaf in leaves if sizes[leaf] == most]  # fmt: skip
        common = [link for link in ways[0] if all(link in way for way in ways)]
        if len(self._moving(base, common[-1])) == most and len(ways) > 1:
            named = (way[-1] for name in FLANGES for way in ways if is_called(way[-1], name))
            return next(named, common[-1])
        # Fingers of unequal length, as a thumb has: no link is common to those with most joints.
        for link in common:
            before, after = (len(self._moving(*p)) for p in ((base, link), (link, common[-1])))
            if before < MIN_JOINTS or not 0 < after <= MOST_IN_A_FINGER:
                continue
            own = ([self.parent_joint[k] for k in self._below(joint.child)] for joint in self.joints
                   if joint.parent == link and joint.child not in common)  # fmt: skip
            beside = [joints for joints in own if any(joint.moves for joint in joints)]
            fingers = (j.follows is not None or chain.FINGERS.search(j.name + j.child)
                       for joints in beside for j in joints)  # fmt: skip
            if len(beside) > 1 or any(fingers):
                return link
        return common[-1]

    def _moving(self, base: str, flange: str) -> list[FileJoint]:
        return [j for j in self.joints_between(base, flange) if j.moves]

    def placed(self, link: str) -> Array:
        return reduce(np.matmul, (joint.held for joint in self.ways[link]), np.eye(4))

    def serial_chain(self, base: str, flange: str) -> tuple[FileJoint, ...]:
        below, joints = self._below(base), self.joints_between(base, flange)
        require(
            self.link_of(flange)[0] in below,
            f"{self.path}: flange '{flange}' is not below base '{base}'; {self.parts} below "
            f"'{base}': {listed(link for link in below if link != base)}",
        )
        for joint in joints:
            bounded = joint.moves and joint.kind != "continuous"
            lower, upper = joint.limit or (-math.inf, math.inf)
            left_out = " (a URDF takes 0 for one left out)" if 0.0 in (lower, upper) else ""
            for wrong, told in (
                (not joint.moves and joint.kind != "fixed",
                 f" is {joint.kind} and lies between base and flange; only {', '.join(MOVING)} and "
                 "fixed joints can, choose a base below it"),
                (joint.follows is not None and joint.moves,
                 f" mimics '{joint.follows}' and lies between base and flange; coupled joints are "
                 "not supported there, remove <mimic> or choose another flange"),
                (joint.limit is None and bounded,
                 f' is {joint.kind} without <limit>; add <limit lower="…" upper="…" effort="0" '
                 'velocity="0"/> or make it continuous'),
                (lower >= upper and bounded,
                 f": limits lower={lower:g}, upper={upper:g} leave no room to move; lower must be "
                 f"below upper{left_out}"),
            ):  # fmt: skip
                require(not wrong, f"{self.path}: joint '{joint.name}'{told}")
        moving = [joint for joint in joints if joint.moves]
        names = listed(j.name or f"joint{k}" for k, j in enumerate(moving, start=1)) or "none"
        require(
            MIN_JOINTS <= len(moving) <= MAX_JOINTS,
            f"{self.path}: {len(moving)} moving joints between '{base}' and '{flange}' ({names}); "
            f"{MIN_JOINTS} to {MAX_JOINTS} are supported, choose base and flange accordingly",
        )
        return tuple(moving)

    def carriers(self, moving: Sequence[FileJoint]) -> dict[str, tuple[int, Array]]:
        """Every link that one of the joints moves: number of the last of them, and the place (4, 4)
        in its frame."""
        own = {joint.child: k for k, joint in enumerate(moving)}
        at: dict[str, tuple[int, Array]] = {}
        for link, way in self.ways.items():
            if link in own:
                at[link] = own[link], np.eye(4)
            elif way and way[-1].parent in at:
                k, T = at[way[-1].parent]
                at[link] = k, T @ way[-1].held
        return at

    def places(self, base: str, flange: str) -> dict[str, Array]:
        """Name → place (3,) in m in the flange frame of every frame that moves with the flange, or
        link that `export` has added there."""
        added = {link: self.link_of(link) for link in self.links if link.startswith(TOOL_FRAMES)}
        moving = self.serial_chain(base, flange)
        carriers, last = self.carriers(moving), len(moving) - 1
        at = {name: carriers[link][1] @ T
              for name, (link, T) in (added | self.frames | {flange: self.link_of(flange)}).items()
              if carriers.get(link, (-1,))[0] == last}  # fmt: skip
        end = at.pop(flange)
        return {name: np.asarray(np.linalg.solve(end, T)[:3, 3]) for name, T in at.items()}

    def chain(self, base: str, flange: str) -> Chain:
        """Placements in m, unit axes, limits in rad or m, and one mass per joint in kg of all that
        it carries up to the next one, with its centre in m in the joint's frame; none where all
        are zero.  Bodies beyond the flange and on side branches count, those on the base do not."""
        moving = self.serial_chain(base, flange)
        joints, T = list[Joint](), np.eye(4)
        moments = np.zeros((len(moving), 4))  # mass times place, homogeneous
        with np.errstate(over="ignore", invalid="ignore"):  # numbers of 1e308 are judged later
            for source in self.joints_between(base, flange):
                T = T @ source.origin
                if source.moves:
                    name = source.name or f"joint{len(joints) + 1}"
                    limits = source.limit or (-np.inf, np.inf)
                    joints.append(Joint(name, source.motion, T, source.axis, *limits))
                    T = np.eye(4)
            for link, (k, place) in self.carriers(moving).items():
                body = self.links[link]
                moments[k] += body.mass * (place @ [*body.com, 1.0])
            masses = tuple(
                LinkMass(float(m[3]), m[:3] / m[3] if m[3] > 0 else np.zeros(3)) for m in moments
            )
        end = T @ self.link_of(flange)[1]
        masses = masses if moments[:, 3].sum() > LEAST_MASS else ()
        return Chain(self.name, tuple(joints), end, masses)


def is_called(link: str, name: str) -> bool:
    """As it is, or behind a prefix: ur5e_tool0, robot1/tool0."""
    return link == name or link.endswith(tuple(f"{mark}{name}" for mark in "_/-:"))


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
        require(not tag.whole.startswith("xacro:"), xacro_left(path, f"<{tag.whole}>"))
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
            hint = f"{did_you_mean(joint.follows, joints)}; name an existing joint"
            told = f"joint '{joint.name}' mimics joint '{joint.follows}', which is not there{hint}"
            raise InputError(f"{path}: {told}")
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
    require(name, f'{path}: {kind} number {len(known) + 1} has no name; write <{kind} name="…">')
    told = f"{path}: two {kind}s are named '{name}'; names must be unique, rename one"
    require(name not in known, told)
    return name


def _joint(where: str, name: str, tag: Tag, links: Collection[str]) -> FileJoint:
    kind = tag.get("type")
    require("type" in tag.stated, f'{where} has no type; write type="{"|".join(JOINT_TYPES)}"')
    check_known(kind, JOINT_TYPES, f"{where}: unknown joint type '{kind}'", "valid:")
    axis = np.array(_vector(where, tag, "axis", "xyz", (1.0, 0.0, 0.0)))  # URDF default
    length = math.hypot(*axis)
    told = f'{where}: axis is zero; give a direction such as xyz="0 0 1"'
    require(kind not in MOVING or length >= 1e-9, told)
    limit = None
    if (stated := tag.first("limit")) is not None:
        lower, upper = (
            _number(f"{where}, limit {side}", stated.get(side, "0"), endless=True)
            for side in ("lower", "upper")
        )
        limit = None if kind == "continuous" else (lower, upper)
    mimic, rpy = tag.first("mimic"), _vector(where, tag, "origin", "rpy")
    chain.check_angles(f"{where}, origin rpy", rpy, "a URDF takes rad")
    return FileJoint(
        name,
        kind,
        parent=_end(where, tag, "parent", links),
        child=_end(where, tag, "child", links),
        origin=pose_at(_vector(where, tag, "origin", "xyz"), rotation_from_rpy(rpy)),
        axis=axis / length if length else axis,
        limit=limit,
        follows=None if mimic is None else mimic.get("joint").strip(),
    )


def _end(where: str, joint: Tag, side: str, links: Collection[str]) -> str:
    name = (joint.of(side, "link") or "").strip()
    require(bool(name), f'{where} has no {side} link; add <{side} link="…"/>')
    if name not in links:
        hint = f"{did_you_mean(name, links)}; name an existing link or add it"
        raise InputError(f"{where}: {side} link '{name}' is not there{hint}")
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
