"""An XML file: read with what is wrong said plainly, and edited so that all else stays to the byte.

An XML library would write the whole file anew: other quotes, no comments before the root, other
white space.  Here a parser only says where the start tags stand; the text between is not touched.
"""

from __future__ import annotations

import codecs
import math
import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from elastocal.errors import InputError, require
from elastocal.files import DEEPEST, check_size, read_bytes
from elastocal.text import SHOWN, printable, quoted

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
        """What the first tag of that name in it states."""
        inside = self.first(name)
        return None if inside is None else inside.stated.get(key)

    def within(self, name: str) -> bool:
        return self.above is not None and (self.above.name == name or self.above.within(name))


class XmlFile:
    """The tags of an XML file, and the edits to make in its text.

    `tags` in the order of the file, the root first; `end`: where the root's end tag starts.  `what`
    it should be ("a URDF") stands in messages.  It nests no deeper than a robot does and declares
    no entities, which may stand for more text than memory holds.
    """

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
        """Put text at an offset, behind what was put there before."""
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
    """A comment of this text, in which two hyphens would end it."""
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
    """What to say of bytes that are no UTF-8 in a file that declares no encoding, else ""."""
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


# What an MJCF file asks of MuJoCo, counted before MuJoCo sees it.  Its reader takes memory and time
# by numbers in the file, however small that is.

# A humanoid with hands and keyframes has 1500.  MuJoCo's compiler takes 1 s for so many bodies with
# free joints; its time grows with their square, and that of 20 000 is beyond a minute.
MOST_ELEMENTS = 5000
CELLS = 200  # points of a height field that count as one element
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


def check_bounds(file: XmlFile) -> None:
    """Raise InputError where an MJCF file asks for more than an arm needs.

    Counted are elements as often as they are replicated, included or attached, and sizes; included
    models are regular files in its folder.  The message names file and element.
    """
    weight = _Model(file.path).weight_of(file)
    require(
        weight <= MOST_ELEMENTS,
        f"{file.path}: makes {weight:.3g} elements of all it replicates and includes; more than "
        f"{MOST_ELEMENTS} are no arm, so keep the arm alone",
    )


class _Model:
    def __init__(self, path: Path) -> None:
        self._folder = path.parent
        # The folder as it is named, and that of the file where the name is a link.
        self._roots = path.parent.resolve(), path.resolve().parent
        self._weights: dict[Path, float] = {}
        self._text = 0

    def weight_of(self, file: XmlFile) -> float:
        """How many elements MuJoCo makes of a file and all that it includes."""
        path, real = file.path, file.path.resolve()
        if real not in self._weights:
            self._weights[real] = math.nan  # until it is known
            self._text += len(file.data)
            check_size(path, "MuJoCo model with all it includes", self._text, MAX_BYTES)
            self._weights[real] = self._weight(file, file.root)
        require(
            not math.isnan(self._weights[real]), f"{path}: includes itself; take out the <include>"
        )
        return self._weights[real]

    def _weight(self, file: XmlFile, tag: Tag) -> float:
        for key, text in tag.stated.items():
            stated = f"{file.path}: <{printable(tag.name)} {printable(key)}={quoted(text)}>"
            require(
                key in NAMES or not re.search(r"(?i)(?<!\S)[-+]?nan(?!\S)", text),
                f"{stated} is no number; correct it",
            )
            largest = LARGEST.get(tag.name, {}).get(key, math.inf)
            require(
                max(_numbers(text) if largest < math.inf else (), default=0.0) <= largest,
                f"{stated} asks for more than {largest:g}, which no arm needs; take it out",
            )
            require(
                (tag.name, key) != ("flexcomp", "file"),
                f"{stated} makes a body of every vertex of a file, which no arm needs; take it out",
            )
        inside = 1 + sum(self._weight(file, child) for child in tag.inside)
        return _count(tag) * (inside + sum(self._named(file, tag)))

    def _named(self, file: XmlFile, tag: Tag) -> Iterator[float]:
        """Weights of the models that it names."""
        name = tag.get("file")
        if tag.name == "attach":
            models = {one.get("name") or Path(one.get("file")).stem: one.get("file")
                      for one in file.tags if one.name == "model"}  # fmt: skip
            name = models.get(tag.get("model"), "")
        if tag.name not in ("include", "model", "attach") or not name:
            return
        # Beside the model or beside the file itself, as versions of MuJoCo differ.
        for found in {self._folder / name, file.path.parent / name}:
            if os.path.lexists(found):
                require(
                    any(found.resolve().is_relative_to(root) for root in self._roots),
                    f"{file.path}: includes {printable(name)}, which is outside its folder; "
                    "put a copy there",
                )
                yield self.weight_of(XmlFile.read(found, "included model", "an MJCF file"))


def _numbers(text: str) -> list[float]:
    """Sizes of the numbers in a text, of one with a unit ("2G") too."""
    found = _NUMBER.finditer(text)
    return [abs(float(m[0])) * _UNITS.get(text[m.end() : m.end() + 1].upper(), 1.0) for m in found]


def _count(tag: Tag) -> float:
    """How often MuJoCo makes what an element states; a dimension that is 0 or not there counts as
    one, and a vertex or segment is a body with three joints and a geom."""

    def size(*keys: str) -> float:
        return math.prod(max(n, 1.0) for key in keys for n in _numbers(tag.get(key)))

    if tag.name == "replicate":
        return size("count")
    if tag.name == "hfield":
        return 1 + size("nrow", "ncol") / CELLS
    if tag.name in ("composite", "flexcomp"):
        vertices = (len(tag.get(key).split()) / 3 for key in ("point", "vertex"))
        return 5 * max(size("count"), *vertices)
    return 1.0
