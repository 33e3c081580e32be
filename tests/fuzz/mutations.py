"""How valid input is spoilt: bytes, numbers, names, pieces, columns, trees, kinds of file."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from random import Random
from typing import Any

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?![\w.])")
WORD = re.compile(r"[A-Za-z_][\w]*")
UNIT = re.compile(r"_(um|mm|m|deg|rad|N|kN|Nm|s|min|ppm|urad|si|kg|C|deg_per_s)(?![\w])")

# What stands where a number should: numbers that are read, and what is none.
READ = (
    "0", "-0.0", "-1", "1", "2", "1e-300", "-1e-300", "5e-324", "1e-12", "1e-5", "1e5", "1e12",
    "1e19", "-1e19", "1e150", "1e300", "-1e300", "1.7976931348623157e308", "1000000", "90", "360",
)  # fmt: skip
UNREAD = (
    "1e309", "-1e400", "nan", "NaN", "inf", "-inf", "Infinity", "9223372036854775808",
    "9223372036854775807", "2147483648", "1" * 400, "7" * 5000, "0." + "0" * 3000 + "1", "text",
    "", '""', "true", "null", "0x1F", "1_000", "1,5", "１２", "٣", "1e", "--1", "[1, 2, 3]",
    "{ a = 1 }", "1979-05-27", "[" * 40 + "1" + "]" * 40, "[" * 400 + "]" * 400,
    f"[{'1, ' * 5000}1]",
)  # fmt: skip
# What stands where a name should.
NAMES = (
    "", " ", "a", "M1", "joint1", "joint2", "base", "all", "nan", "0", "=1+1", "@x", "+1", "-x",
    "x" * 300, "x" * 20_000, "\x1b]0;title\x07", "\x1b[31mred", "\u202egnp", "\u200b", "é", "🤖",
    "\u0301", "a\tb", "a\x00b", "\ufeff", "\u2028", "a,b", 'a"b', "a'b", "..", "../..", "~",
    "\udcff", "/dev/null", "%s%s", "{0}", "<script>", "&amp;", "[bold]", "$HOME",
    "__class__", "\\u0000",
)  # fmt: skip
BYTES = (
    b"\x00", b"\xff", b"\xfe\xff", b"\xef\xbb\xbf", b"\x1b[2J", b"\xed\xa0\x80", b"\xc3\x28",
    b"\r", b"\x0c", b"\x7f", b"\x85", b"\xe2\x80\xae",
)  # fmt: skip


def bytes_changed(data: bytes, rng: Random) -> bytes:
    """Bits flipped, a span cut, doubled or put before, odd bytes inserted, another encoding."""
    a, b = sorted(rng.randrange(len(data) + 1) for _ in "ab")
    flipped = bytearray(data)
    for _ in range(rng.choice((1, 2, 40)) * bool(data)):
        flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    coding = rng.choice(("utf-16", "utf-16-be", "utf-32", "latin-1", "utf-8-sig"))
    text = data.decode("utf-8", errors="replace").replace("e", "é", rng.choice((0, 1)))
    return rng.choice((
        bytes(flipped), data[:a], data[:a] + data[b:], data[:b] + data[a:],
        data[:a] + rng.choice(BYTES) * rng.choice((1, 3)) + data[a:],
        text.encode(coding, errors="replace"), data.replace(b"\n", rng.choice((b"\r", b"\r\n"))),
        rng.choice((b"", b"\n", b"\xef\xbb\xbf", b" ", b"#\n")),
    ))  # fmt: skip


def some_replaced(
    text: str, pattern: re.Pattern[str], new: Callable[[str], str], rng: Random, most: int = 3
) -> str:
    found = list(pattern.finditer(text))
    chosen = rng.sample(found, min(rng.randint(1, most), len(found)))
    for match in sorted(chosen, key=lambda m: -m.start()):
        text = text[: match.start()] + new(match[0]) + text[match.end() :]
    return text


def tokens_changed(text: str, rng: Random) -> str:
    """Numbers are others, of a wrong unit, or what may well be meant (what comes after reading is
    reached so); names and units are others."""
    named, read = rng.choice((WORD.findall(text) or NAMES, NAMES)), rng.choice((READ, READ, UNREAD))
    factors = rng.choice(((1e3, 1e-3, 1e6, -1.0, 57.2958, 1e18), (0, 0.5, 0.9, 1.1, 2, 10)))
    units = ("", *UNIT.findall(text), "mm", "deg", "m", "rad", "kN")
    pattern, new = rng.choice((
        (NUMBER, lambda old: rng.choice(read)),
        *[(NUMBER, lambda old: f"{float(old) * rng.choice(factors):.9g}")] * 2,
        (WORD, lambda old: rng.choice(named)), (UNIT, lambda old: f"_{rng.choice(units)}"),
    ))  # fmt: skip
    return some_replaced(text, pattern, new, rng)


def pieces_changed(text: str, rng: Random) -> str:
    """Lines, fields, tags or words dropped, turned round, doubled, repeated or cut short."""
    mark = rng.choice(("\n", "\n", "\n", ",", "<", " ", "=", '"'))
    pieces = text.split(mark)
    k = rng.randrange(len(pieces))
    some = pieces[k : k + rng.choice((1, 1, 2, 10, 100))]
    short = some[0][: rng.randint(0, len(some[0]))]
    pieces[k : k + len(some)] = rng.choice(
        ([], some[::-1], some * 2, some[:1] * rng.choice((2, 50, 3000)), [short, *some[1:]],
         [*some[1:], rng.choice(pieces)])
    )  # fmt: skip
    return mark.join(pieces)


def columns_changed(text: str, rng: Random) -> str:
    """A column of the header, of the rows or of both is dropped, doubled, swapped or another."""
    rows = [line.split(",") for line in text.split("\n")]
    a, b = rng.randrange(len(rows[0])), rng.randrange(len(rows[0]))
    value, factor = rng.choice(READ + UNREAD + NAMES), rng.choice((1e3, 1e-3, 57.2958, -1.0, 0.0))
    change: Callable[[list[str]], list[str]] = rng.choice((
        lambda row: row[:a] + row[a + 1 :],
        lambda row: [*row[:b], row[a], *row[b:]],
        lambda row: [row[{a: b, b: a}.get(k, k)] for k in range(len(row))],
        lambda row: [*row[:a], value, *row[a + 1 :]],
        lambda row: [*row[:a], scaled(row[a], factor), *row[a + 1 :]],
        lambda row: [scaled(cell, factor) for cell in row],
    ))  # fmt: skip
    where = rng.choice((range(1), range(1, len(rows)), range(len(rows))))
    return "\n".join(
        ",".join(change(row) if i in where and len(row) == len(rows[0]) else row)
        for i, row in enumerate(rows)
    )


def scaled(cell: str, factor: float) -> str:
    try:
        return repr(float(cell) * factor)
    except ValueError:
        return cell


def json_changed(text: str, rng: Random) -> str:
    """A value is gone, of another kind, nested or cut; a key stands twice; it is deep."""
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError):
        return text
    places = list(places_of(tree)) if isinstance(tree, dict | list) else []
    for _ in range(rng.choice((1, 1, 3)) * bool(places)):
        (holder, key), (other, name) = rng.choice(places), rng.choice(places)
        with suppress(KeyError, IndexError):  # taken away before
            old = holder[key]
            cut = old[: len(old) // 2] if isinstance(old, list | str) else None
            holder[key] = rng.choice((
                cut, True, -1, 0, [], {}, "text", 1e308, 5e-324, [old], deepcopy(other[name]),
                rng.choice(NAMES),
            ))  # fmt: skip
            if rng.random() < 0.2:
                del holder[key]
    text, n = json.dumps(tree), rng.choice((50, 2000, 100_000))
    twice = text.replace("{", '{"parameters": 1, ', 1)
    return rng.choices((text, twice, "[" * n + "]" * n), (20, 5, 1))[0]


def places_of(tree: Any, depth: int = 0) -> Any:
    for key, value in list(tree.items() if isinstance(tree, dict) else enumerate(tree))[:40]:
        yield tree, key
        if isinstance(value, dict | list) and depth < 5:
            yield from places_of(value, depth + 1)


def xml_changed(text: str, rng: Random) -> str:
    """Entities that grow or read a file, deep nesting, or an attribute that is something else."""
    entities = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 12))
    bare = re.sub(r"<\?.*?\?>", "", text)
    n = rng.choice((50, 5000))
    values = (*NAMES, *READ, *UNREAD, "1 2", "1 2 3 4", "nan nan nan")
    other = some_replaced(text, re.compile('"[^"]*"'), lambda old: f'"{rng.choice(values)}"', rng)
    return rng.choice((
        other, other, other, "<a>" * n + "</a>" * n,
        f'<!DOCTYPE r [<!ENTITY e0 "x">{entities}]>{bare}'.replace('name="', 'name="&e11;', 1),
        f'<!DOCTYPE r [<!ENTITY f SYSTEM "file:///etc/passwd">]>{bare}'.replace(
            'name="', 'name="&f;', 1),
    ))  # fmt: skip


# Kinds of file; it is absent when these make it.
KINDS: dict[str, Callable[[Path], object]] = {
    "a folder": Path.mkdir,
    "absent": lambda path: None,
    "a loop": lambda path: path.symlink_to(path.name),
    "a pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "binary": lambda path: path.write_bytes(Random(1).randbytes(5000)),
    # sparse: it takes no room
    "large": lambda path: (path.touch(), os.truncate(path, 3_000_000_000)),
}
ON_TEXT = (*[tokens_changed] * 4, pieces_changed)
BY_ENDING = {".csv": columns_changed, ".json": json_changed, ".urdf": xml_changed}


def spoil(path: Path, rng: Random) -> str:
    """Change one file; what was done, in words."""
    if rng.random() < 0.02:
        path.unlink()
        kind = rng.choice(tuple(KINDS))
        KINDS[kind](path)
        return f"{path.name} is {kind}"
    done = []
    for _ in range(rng.choice((1, 1, 1, 1, 2, 4))):
        data = path.read_bytes()
        text = data.decode("utf-8", errors="surrogateescape")
        own = [BY_ENDING[path.suffix]] * 2 if path.suffix in BY_ENDING else []
        change = rng.choice((*ON_TEXT, *own))
        if rng.random() < 0.15:
            path.write_bytes(bytes_changed(data, rng))
        else:
            path.write_bytes(change(text, rng).encode("utf-8", errors="surrogateescape"))
            done.append(change.__name__)
    return f"{path.name}: {', '.join(done) or 'bytes'}"


# Options whose values are costs, not kinds: as many poses or processes as one asks for are made.
COSTLY = {
    "--poses", "--repeats", "--jobs", "--candidates", "--only", "--curve", "--grid", "--effort",
}  # fmt: skip
CHEAP = ("0", "-1", "1", "2", "1.5", "nan", "text", "", "1e3", "3,3", "quick", "inf", "-inf")
VALUES = (
    "auto", "reml", "ols", "huber", "l1", "eq14", "hc3", "cr2", "profile", "polar", "stated",
    "marker+configuration", "rows", "none", "drop", "keep", "urdf", "mjcf", "dh", "yaml", "json",
    "corrections", "tracker", "base", "D", "c", "O3", "joint2.compliance", "1,2,3",
    "0,0,0,1,1,1", "1500,200,1200", "joint2.compliance=nan", "scale=1e400", "replicates=x", "=",
    "a=b=c", "nosuch=1", "kuka", "in", "gon", *READ, *UNREAD, *NAMES,
)  # fmt: skip


def spoil_arguments(words: list[str], rng: Random) -> list[str]:
    """The words of a command with one or two of them dropped, doubled, swapped or replaced."""
    words = [*words] or ["x"]
    for _ in range(rng.choice((1, 1, 2))):
        k, j = rng.randrange(len(words)), rng.randrange(len(words))
        new = rng.choice(CHEAP if k and words[k - 1] in COSTLY else VALUES).replace("\0", "\x01")
        match rng.randrange(6):
            case 0:
                del words[k]
            case 1:
                words.insert(k, words[j])
            case 2:
                words[k], words[j] = words[j], words[k]
            case _:
                words[k] = new
        words = words or ["x"]
    return words
