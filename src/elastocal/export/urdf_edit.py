"""Edits of a URDF's text that leave everything else as it was, to the byte.

An XML library would write the whole file anew: other quotes, no comments before the root, other
white space.  Here a parser only says where the start tags stand; the text between is not touched.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from elastocal.errors import InputError

DECLARATION = re.compile(r"""(<\?xml[^>]*?\bencoding\s*=\s*)("[^"]*"|'[^']*')""")


@dataclass
class JointTags:
    """Offsets of a joint's start tags in the UTF-8 bytes of the file; None where it has none."""

    start: int
    origin: int | None = None
    child: int | None = None


@dataclass
class UrdfText:
    """The text of a URDF and the edits to make; offsets count bytes of `data`, which is UTF-8."""

    data: bytes
    joints: dict[str, JointTags]
    end: int  # of the robot's content: where its end tag starts
    edits: list[tuple[int, int, bytes]] = field(default_factory=list)

    def set_origin(self, joint: str, attributes: Mapping[str, str]) -> None:
        """Replace xyz and rpy of a joint's <origin>, or give it one."""
        tags = self.joints[joint]
        if tags.origin is not None:
            self._set_attributes(tags.origin, attributes)
            return
        after = _tag_end(self.data, tags.start)
        self.edits.append((after, after, (element("origin", attributes)).encode()))

    def set_child(self, joint: str, link: str) -> None:
        """Let a joint carry another link."""
        tag = self.joints[joint].child
        assert tag is not None, joint  # urdf_check has seen it
        self._set_attributes(tag, {"link": link})

    def append(self, text: str) -> None:
        """Add elements at the end of the robot."""
        self.edits.append((self.end, self.end, text.encode("utf-8")))

    def result(self) -> str:
        """The text with all edits made."""
        data = self.data
        for start, end, new in sorted(self.edits, key=lambda e: e[:2], reverse=True):
            data = data[:start] + new + data[end:]
        return data.decode("utf-8")

    def _set_attributes(self, start: int, attributes: Mapping[str, str]) -> None:
        end = _tag_end(self.data, start)
        tag = self.data[start:end].decode("utf-8")
        for name, value in attributes.items():
            given = re.compile(rf"""(\s{name}\s*=\s*)("[^"]*"|'[^']*')""")
            new = quoteattr(value)
            if (found := given.search(tag)) is not None:
                tag = tag[: found.start(2)] + new + tag[found.end(2) :]
            else:
                body = tag[:-1].rstrip().removesuffix("/").rstrip()
                closing = "/>" if tag.endswith("/>") else ">"
                tag = f"{body} {name}={new}{closing}"
        self.edits.append((start, end, tag.encode("utf-8")))


def element(tag: str, attributes: Mapping[str, str]) -> str:
    """An empty element as text."""
    return f"<{tag}{''.join(f' {k}={quoteattr(v)}' for k, v in attributes.items())}/>"


def read_urdf_text(path: Path) -> UrdfText:
    """The URDF at `path` (already checked by urdf_check) with its joints located.

    A file in another encoding is taken over as UTF-8, its declaration with it.
    Raises InputError where it cannot be decoded.
    """
    data = _as_utf8(path)
    found = UrdfText(data, {}, len(data))
    parser = expat.ParserCreate()
    stack: list[str] = []
    current: list[JointTags] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        local, at = tag.rpartition(":")[2], parser.CurrentByteIndex
        stack.append(local)
        if len(stack) == 2 and local == "joint":
            current[:] = [JointTags(at)]
            found.joints[attributes["name"].strip()] = current[0]
        elif len(stack) == 3 and stack[1] == "joint":
            if local == "origin" and current[0].origin is None:
                current[0].origin = at
            elif local == "child" and current[0].child is None:
                current[0].child = at

    def end(tag: str) -> None:
        stack.pop()
        if not stack:
            found.end = parser.CurrentByteIndex

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(data, True)
    return found


def _as_utf8(path: Path) -> bytes:
    data = path.read_bytes()
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        name = "utf-16"
    else:
        declared = DECLARATION.search(data[:200].decode("ascii", "replace"))
        name = declared.group(2).strip("\"'") if declared else "utf-8"
    if name.lower() in ("utf-8", "utf8"):
        return data
    try:
        text = data.decode(name)
    except (LookupError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as {name} ({error}); save it as UTF-8") from None
    return DECLARATION.sub(r'\g<1>"UTF-8"', text, count=1).encode("utf-8")


def _tag_end(data: bytes, start: int) -> int:
    """Offset just after the `>` that closes the tag at `start`; one in quotes does not."""
    quote = None
    for k in range(start, len(data)):
        c = data[k : k + 1]
        if quote is None and c == b">":
            return k + 1
        if c in (b'"', b"'"):
            quote = c if quote is None else None if c == quote else quote
    raise AssertionError("a parsed tag ends")
