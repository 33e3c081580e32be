"""How valid input is spoilt: bytes, numbers, names, lines, columns, trees, words, kinds of file."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?![\w.])")
WORD = re.compile(r"[A-Za-z_][\w]*")
UNITS = (
    "um", "mm", "m", "deg", "rad", "N", "kN", "Nm", "s", "min", "ppm", "urad", "si", "kg", "C",
    "deg_per_s",
)  # fmt: skip
UNIT = re.compile(rf"_({'|'.join(UNITS)})(?![\w])")

# What stands where a number should: numbers that are read, and what is none.
READ = (
    "0", "-0.0", "-1", "1", "2", "1e-300", "-1e-300", "5e-324", "1e-12", "1e-5", "1e5", "1e12",
    "1e19", "-1e19", "1e150", "1e300", "-1e300", "1.7976931348623157e308", "1000000", "90", "360",
)  # fmt: skip
UNREAD = (
    "1e309", "-1e400", "nan", "NaN", "inf", "-inf", "Infinity", "9223372036854775808",
    "9223372036854775807", "2147483648", "1" * 400, "7" * 5000, "0." + "0" * 3000 + "1", "text",
    "", '""', "true", "null", "0x1F", "1_000", "1,5", "１２", "٣", "1e", "--1", "[1, 2, 3]",
    "{ a = 1 }", "1979-05-27",
)  # fmt: skip
NUMBERS = READ + UNREAD
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


def _place(text: str | bytes, rng: Random) -> int:
    return rng.randrange(len(text) + 1)


def _span(text: str | bytes, rng: Random, longest: int = 200) -> tuple[int, int]:
    begin = _place(text, rng)
    return begin, min(begin + rng.randint(1, longest), len(text))


# Bytes


def flip_bits(data: bytes, rng: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 5, 40)) * bool(data)):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def truncate(data: bytes, rng: Random) -> bytes:
    return data[: _place(data, rng)]


def cut_or_double(data: bytes, rng: Random) -> bytes:
    begin, end = rng.sample(_span(data, rng), 2)
    return data[:begin] + data[end:]


def insert_bytes(data: bytes, rng: Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.choice(BYTES) * rng.choice((1, 1, 3)) + data[at:]


def encode_anew(data: bytes, rng: Random) -> bytes:
    text = data.decode("utf-8", errors="replace").replace("e", "é", rng.choice((0, 1)))
    coding = rng.choice(("utf-16", "utf-16-be", "utf-32", "latin-1", "utf-8-sig", "utf-8", "utf-8"))
    return text.replace("\n", rng.choice(("\n", "\r", "\r\n"))).encode(coding, errors="replace")


def empty(data: bytes, rng: Random) -> bytes:
    return rng.choice((b"", b"\n", b"\xef\xbb\xbf", b" ", b"#\n"))


# Text of any kind


def _replace(text: str, pattern: re.Pattern[str], make: Callable[[re.Match[str]], str], rng: Random,
             most: int = 3) -> str:  # fmt: skip
    found = list(pattern.finditer(text))
    if not found:
        return text
    chosen = rng.sample(found, min(rng.randint(1, most), len(found)))
    for match in sorted(chosen, key=lambda m: -m.start()):
        text = text[: match.start()] + make(match) + text[match.end() :]
    return text


def other_number(text: str, rng: Random) -> str:
    return _replace(text, NUMBER, lambda m: rng.choice(rng.choice((READ, READ, UNREAD))), rng)


def scaled_number(text: str, rng: Random) -> str:
    factors = (1e3, 1e-3, 1e6, -1.0, 57.29577951308232, 0.017453292519943295, 1e9, 0.0, 1e18)
    return _replace(text, NUMBER, lambda m: repr(float(m[0]) * rng.choice(factors)), rng)


def nudged_number(text: str, rng: Random) -> str:
    """Numbers that may well be meant: what comes after reading is reached with them."""
    new = lambda m: f"{float(m[0]) * rng.choice((0, 0.5, 0.9, 1.1, 2, 10)):g}"  # noqa: E731
    return _replace(text, NUMBER, new, rng, most=6)


def other_word(text: str, rng: Random) -> str:
    words = WORD.findall(text) or ["x"]
    pick = (lambda: rng.choice(words)) if rng.random() < 0.5 else (lambda: rng.choice(NAMES))
    return _replace(text, WORD, lambda m: pick(), rng, most=2)


def other_unit(text: str, rng: Random) -> str:
    return _replace(text, UNIT, lambda m: rng.choice(("", *("_" + u for u in UNITS))), rng, most=3)


def lines_changed(text: str, rng: Random) -> str:
    """Some lines left out, turned round, doubled, or the first of them repeated or cut short."""
    lines = text.split("\n")
    k = rng.randrange(len(lines))
    some = lines[k : k + rng.choice((1, 1, 2, 10, 100))]
    short = some[0][: rng.randint(0, len(some[0]))]
    lines[k : k + len(some)] = rng.choice(
        ([], some[::-1], some * 2, some[:1] * rng.choice((2, 50, 3000)), [short, *some[1:]])
    )
    return "\n".join(lines)


# Tables


def table_changed(text: str, rng: Random) -> str:
    """One change of the header, of what stands below it, of all rows, or of one row."""
    delimiter = next((d for d in ",;\t" if d in text.split("\n")[0]), ",")
    if rng.random() < 0.08:
        return text.replace(delimiter, rng.choice(";\t|  "))
    rows = [line.split(delimiter) for line in text.split("\n")]
    width, n = len(rows[0]), len(rows)
    a, b = rng.randrange(width), rng.randrange(width)
    value, name = rng.choice(rng.choice((READ, READ, UNREAD))), rng.choice(NAMES)
    factor = rng.choice((1e3, 1e-3, 1e6, 57.29578, 0.0174533, -1.0, 0.0))
    of_cell: tuple[Callable[[str], str], ...] = (
        lambda cell: value, lambda cell: name, lambda cell: _times(cell, factor),
        lambda cell: f'"{cell}"', lambda cell: f'"{cell}',
    )  # fmt: skip
    in_cell = rng.choice(of_cell)
    of_row: tuple[Callable[[list[str]], list[str]], ...] = (
        lambda row: row[:a] + row[a + 1 :],
        lambda row: [*row[:b], row[a], *row[b:]],
        lambda row: [row[{a: b, b: a}.get(k, k)] for k in range(len(row))],
        lambda row: [_times(cell, factor) for cell in row],
        lambda row: [*row, "1"],
        *[lambda row: [*row[:a], in_cell(row[a]), *row[a + 1 :]]] * 7,
    )
    in_row, line = rng.choice(of_row), rng.randrange(n)
    where = rng.choice((range(1), range(1, n), range(1, n), range(n), range(line, line + 1)))
    rows = [in_row(row) if i in where and len(row) >= width else row for i, row in enumerate(rows)]
    return "\n".join(delimiter.join(row) for row in rows)


def _times(cell: str, factor: float) -> str:
    try:
        return repr(float(cell) * factor)
    except ValueError:
        return cell


# TOML


def toml_changed(text: str, rng: Random) -> str:
    """One key or one header is another one, another value's, nested, doubled or elsewhere."""
    lines = text.split("\n")
    keys = [i for i, line in enumerate(lines) if "=" in line]
    headers = [i for i, line in enumerate(lines) if line.startswith("[")]
    if not keys:
        return text
    if headers and rng.random() < 0.25:
        i = rng.choice(headers)
        line = lines[i]
        lines[i] = rng.choice((f"[{line}]", line.strip("[]"), "[robot]", "[a.b.c]", "[]"))
        return "\n".join(lines if rng.random() < 0.5 else [*lines, line])
    i = rng.choice(keys)
    name, _, value = lines[i].partition("=")
    deep, many = rng.choice((3, 40, 400)), rng.choice((2, 7, 5000))
    other = lines[rng.choice(keys)].partition("=")[2]
    lines[i] = rng.choice((
        f"{name}= {'[' * deep}{value.strip()}{']' * deep}",
        f"{name}= {rng.choice((*NUMBERS, *map(json.dumps, NAMES)))}",
        f"{lines[i]}\n{lines[i]}",
        f"{name.strip()}.{name.strip()} = {value}",
        f"{name}={other}",
        f"{name}= [{', '.join([value.strip() or '0'] * many)}]",
    ))  # fmt: skip
    if rng.random() < 0.1:
        lines.append(lines.pop(i))
    return "\n".join(lines)


# JSON


def json_changed(text: str, rng: Random) -> str:
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError):
        return text
    places = list(_places(tree))
    for _ in range(rng.choice((1, 1, 1, 3))):
        holder, key = rng.choice(places)
        how = rng.randrange(6)
        try:
            if how == 0:
                del holder[key]
            elif how == 1:
                holder[key] = rng.choice((None, True, -1, 0, [], {}, "", "text", 1e308, 5e-324))
            elif how == 2:
                other, name = rng.choice(places)
                holder[key] = other[name]
            elif how == 3 and isinstance(holder[key], list):
                holder[key] = holder[key][: len(holder[key]) // 2]
            elif how == 4:
                holder[key] = rng.choice(NAMES)
            else:
                holder[key] = [holder[key]]
        except (KeyError, IndexError):
            pass
    try:
        text = json.dumps(tree)
    except (ValueError, RecursionError):
        return text
    if rng.random() < 0.3:
        text = text.replace("{", '{"parameters": 1, ', 1)
    return text


def _places(tree: Any, depth: int = 0) -> Any:
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    for key, value in list(items)[:40]:
        yield tree, key
        if isinstance(value, dict | list) and depth < 5:
            yield from _places(value, depth + 1)


def deep_json(text: str, rng: Random) -> str:
    return "[" * (n := rng.choice((50, 2000, 100_000))) + "]" * n


# XML


def xml_changed(text: str, rng: Random) -> str:
    tags = list(re.finditer(r"<(\w+)[^<>]*?/?>", text))
    how = rng.randrange(7)
    if how == 0:
        entities = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 12))
        text = f'<!DOCTYPE r [<!ENTITY e0 "x">{entities}]>' + re.sub(r"<\?.*?\?>", "", text)
        return text.replace('name="', 'name="&e11;', 1)
    if how == 1:
        return f'<!DOCTYPE r [<!ENTITY f SYSTEM "file:///etc/passwd">]>{text}'.replace(
            'name="', 'name="&f;', 1
        )
    if how == 2:
        return "<a>" * (n := rng.choice((50, 5000))) + "</a>" * n
    if not tags:
        return text
    tag = rng.choice(tags)
    if how == 3:
        return text[: tag.start()] + text[tag.end() :]
    if how == 4:
        return text[: tag.end()] + tag[0] + text[tag.end() :]
    quoted = list(re.finditer(r'"([^"]*)"', text))
    if not quoted:
        return text
    a, b = rng.choice(quoted), rng.choice(quoted)
    new = f'"{rng.choice((b[1], *NAMES, *NUMBERS, "1 2", "1 2 3 4", "nan nan nan"))}"'
    return text[: a.start()] + new + text[a.end() :]


# Kinds of file; it is absent when these make it
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
ON_BYTES = (flip_bits, flip_bits, truncate, cut_or_double, insert_bytes, encode_anew, empty)
ON_TEXT = (
    other_number, other_number, scaled_number, scaled_number, nudged_number, nudged_number,
    other_word, other_unit, lines_changed,
)  # fmt: skip
BY_ENDING: dict[str, tuple[Callable[[str, Random], str], ...]] = {
    ".toml": (toml_changed,) * 6,
    ".csv": (table_changed,) * 8,
    ".txt": (table_changed,) * 3,
    ".json": (json_changed,) * 8 + (deep_json,),
    ".urdf": (xml_changed,) * 6,
}


def spoil(path: Path, rng: Random) -> str:
    """Change one file; what was done, in words."""
    if rng.random() < 0.02:
        path.unlink()
        kind = rng.choice(tuple(KINDS))
        KINDS[kind](path)
        return f"{path.name} is {kind}"
    data, done = path.read_bytes(), []
    for _ in range(rng.choice((1, 1, 1, 1, 1, 2, 4))):
        if rng.random() < 0.15:
            change = rng.choice(ON_BYTES)
            data = change(data, rng)
        else:
            change = rng.choice((*ON_TEXT, *BY_ENDING.get(path.suffix, ())))
            text = data.decode("utf-8", errors="surrogateescape")
            data = change(text, rng).encode("utf-8", errors="surrogateescape")
        done.append(change.__name__)
    path.write_bytes(data)
    return f"{path.name}: {', '.join(done)}"


# Arguments

# Options whose values are costs, not kinds: as many poses or processes as one asks for are made.
COSTLY = {
    "--poses", "--repeats", "--jobs", "--candidates", "--only", "--curve", "--grid", "--effort",
}  # fmt: skip
CHEAP = ("0", "-1", "1", "2", "1.5", "nan", "text", "", "1e3", "3,3", "quick", "inf", "-inf")
WORDS_OF_OPTIONS = (
    "auto", "reml", "ols", "huber", "l1", "eq14", "hc3", "cr2", "profile", "polar", "stated",
    "marker+configuration", "rows", "none", "drop", "keep", "urdf", "mjcf", "dh", "yaml", "json",
    "corrections", "tracker", "base", "D", "c", "O3", "joint1", "joint2.compliance", "1,2,3",
    "0,0,0,1,1,1", "1500,200,1200", "joint2.compliance=nan", "scale=1e400", "replicates=x", "=",
    "a=b=c", "nosuch=1", "kuka", "in", "gon",
)  # fmt: skip


def spoil_arguments(words: list[str], rng: Random) -> tuple[list[str], str]:
    """The words of a command with one or two of them changed; what was done."""
    words, done = list(words), []
    for _ in range(rng.choice((1, 1, 2))):
        k = rng.randrange(len(words))
        how = rng.randrange(6)
        if how == 0:
            done.append(f"dropped {words.pop(k)!r}")
            if not words:
                return ["x"], "dropped all"
        elif how == 1:
            words.insert(k, words[rng.randrange(len(words))])
            done.append(f"doubled {words[k]!r}")
        elif how == 2 and len(words) > 1:
            j = rng.randrange(len(words))
            words[k], words[j] = words[j], words[k]
            done.append(f"swapped {words[k]!r} and {words[j]!r}")
        else:
            costly = k and words[k - 1] in COSTLY
            pool = CHEAP if costly else (*NUMBERS, *NAMES, *WORDS_OF_OPTIONS)
            new = rng.choice(pool).replace("\0", "\x01")
            done.append(f"{words[k]!r:.80} → {new!r:.80}")
            words[k] = new
    return words, "; ".join(done)
