"""A text file of unknown origin as lines: UTF-8, UTF-16 or a Windows code page."""

from __future__ import annotations

import codecs
from dataclasses import dataclass
from pathlib import Path

from elastocal.errors import InputError
from elastocal.files import open_input

MAX_BYTES = 300_000_000
MAX_LINE = 64 * 1024
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig", "UTF-8"),
    (codecs.BOM_UTF16_LE, "utf-16", "UTF-16"),
    (codecs.BOM_UTF16_BE, "utf-16", "UTF-16"),
)
_BINARY = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0", b"PAR1", b"%PDF", b"#ROSBAG", b"SQLite format 3")


@dataclass(frozen=True)
class Text:
    """`lines` without their ends; line k of the file is lines[k - 1]."""

    source: str
    encoding: str
    lines: list[str]


def read_lines(path: str | Path, encoding: str = "auto") -> Text:
    """The lines of a text file of at most 300 MB.

    `encoding` "auto": by the byte order mark, else UTF-8 where the bytes allow, else UTF-16
    where every other byte is zero, else Windows-1252 (Latin-1 where that has no character).
    Raises InputError where the file cannot be read, is empty, no text, or not in `encoding`.
    """
    source = str(path)
    with open_input(path, "export") as handle:
        data = handle.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise InputError(f"{source}: larger than {MAX_BYTES // 10**6} MB; export fewer readings")
    if not data.strip():
        raise InputError(f"{source}: empty file; export it again")
    if data.startswith(_BINARY):
        raise InputError(
            f"{source}: is a workbook, bag, archive or other binary file; export its table as text "
            "(CSV)"
        )
    text, name = _decode(source, data, encoding)
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise InputError(f"{source}, line {line}: NUL characters, so this is no text; export it "
                         "as text (CSV)")  # fmt: skip
    # Not splitlines: a form feed or U+2028 in a comment ends no line for an editor.
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for number, content in enumerate(lines, start=1):
        if len(content) > MAX_LINE:
            raise InputError(f"{source}, line {number}: longer than {MAX_LINE // 1024} KiB; this "
                             "is no table of readings")  # fmt: skip
    return Text(source, name, lines)


def _decode(source: str, data: bytes, encoding: str) -> tuple[str, str]:
    """The text, and what its encoding is called."""
    if encoding == "auto":
        for mark, codec, name in _MARKS:
            if data.startswith(mark):
                return _strictly(source, data, codec, name), name
        wide = _wide(data)
        if wide:
            return _strictly(source, data, wide, "UTF-16"), "UTF-16"
        try:
            return data.decode("utf-8"), "ASCII" if data.isascii() else "UTF-8"
        except UnicodeDecodeError:
            pass
        try:
            return data.decode("cp1252"), "Windows-1252"
        except UnicodeDecodeError:
            return data.decode("latin-1"), "Latin-1"
    codec = {"utf-8": "utf-8-sig"}.get(encoding, encoding)
    if encoding == "utf-16" and not data.startswith(codecs.BOM_UTF16):
        codec = _wide(data) or "utf-16-le"
    return _strictly(source, data, codec, encoding), encoding


def _wide(data: bytes) -> str | None:
    """UTF-16 without a byte order mark shows by zeros at every other place."""
    start = data[:4000]
    even, odd = start[0::2].count(0), start[1::2].count(0)
    if odd > 0.4 * len(start) / 2 and even < odd / 4:
        return "utf-16-le"
    if even > 0.4 * len(start) / 2 and odd < even / 4:
        return "utf-16-be"
    return None


def _strictly(source: str, data: bytes, codec: str, name: str) -> str:
    try:
        return data.decode(codec)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{source}, line {line}: not {name} text (byte 0x{data[error.start]:02x}); set "
            "encoding in [source.text], or export as UTF-8"
        ) from None
