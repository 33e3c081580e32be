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
    for _ in range(rng.choice((1, 1, 2, 5, 40))):
        if changed:
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def truncate(data: bytes, rng: Random) -> bytes:
    return data[: _place(data, rng)]


def cut(data: bytes, rng: Random) -> bytes:
    begin, end = _span(data, rng)
    return data[:begin] + data[end:]


def double(data: bytes, rng: Random) -> bytes:
    begin, end = _span(data, rng)
    return data[:end] + data[begin:]


def insert_bytes(data: bytes, rng: Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.choice(BYTES) * rng.choice((1, 1, 3)) + data[at:]


def encode_anew(data: bytes, rng: Random) -> bytes:
    text = data.decode("utf-8", errors="replace")
    kind = rng.choice(("utf-16", "utf-16-be", "utf-32", "latin-1", "utf-8-sig", "cr", "crlf"))
    if kind == "cr":
        return text.replace("\n", "\r").encode()
    if kind == "crlf":
        return text.replace("\n", "\r\n").encode()
    return text.replace("e", "é", rng.choice((0, 1))).encode(kind, errors="replace")


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
    lines = text.split("\n")
    k, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    how = rng.randrange(6)
    if how == 0:
        del lines[k]
    elif how == 1:
        lines.insert(j, lines[k])
    elif how == 2:
        lines[k], lines[j] = lines[j], lines[k]
    elif how == 3:
        lines[k] = lines[k][: rng.randint(0, len(lines[k]))]
    elif how == 4:
        lines[k:k] = [lines[k]] * rng.choice((2, 50, 3000))
    else:
        del lines[min(k, j) : max(k, j)]
    return "\n".join(lines)


# Tables


def table_changed(text: str, rng: Random) -> str:
    delimiter = next((d for d in ",;\t" if d in text.split("\n")[0]), ",")
    rows = [line.split(delimiter) for line in text.split("\n")]
    width = max(len(rows[0]), 1)
    a, b = rng.randrange(width), rng.randrange(width)
    how = rng.randrange(12)
    value = rng.choice(rng.choice((READ, READ, UNREAD)))
    factor = rng.choice((1e3, 1e-3, 1e6, 57.29578, 0.0174533, -1.0, 0.0))
    line = rng.randrange(len(rows))
    for i, row in enumerate(rows):
        if len(row) < width:
            continue
        if how == 0:
            del row[a]
        elif how == 1:
            row.insert(b, row[a])
        elif how == 2 or (how == 3 and i):  # swapped, with the header or without it
            row[a], row[b] = row[b], row[a]
        elif how == 4 and i:
            row[a] = value
        elif how == 5 and i:
            row[a] = _times(row[a], factor)
        elif how == 6 and i:
            row[:] = [_times(cell, factor) for cell in row]
        elif how == 7 and i == line:
            row[a] = rng.choice((*NUMBERS, *NAMES))
        elif how == 8 and i == line:
            row.append("1")
        elif how == 9:
            row[a] = f'"{row[a]}"' if rng.random() < 0.9 else f'"{row[a]}'
        elif how == 10 and not i:
            row[a] = rng.choice(NAMES)
    text = "\n".join(delimiter.join(row) for row in rows)
    return text.replace(delimiter, rng.choice(";\t|  ")) if how == 11 else text


def _times(cell: str, factor: float) -> str:
    try:
        return repr(float(cell) * factor)
    except ValueError:
        return cell


# TOML


def toml_changed(text: str, rng: Random) -> str:
    lines = text.split("\n")
    keys = [i for i, line in enumerate(lines) if "=" in line]
    headers = [i for i, line in enumerate(lines) if line.startswith("[")]
    how = rng.randrange(9)
    if not keys or (how in (5, 6) and not headers):
        return text
    i = rng.choice(keys)
    name, _, value = lines[i].partition("=")
    nested = rng.choice((3, 40, 400))
    if how == 0:
        lines[i] = f"{name}= {'[' * nested}{value.strip()}{']' * nested}"
    elif how == 1:
        lines[i] = f"{name}= {rng.choice((*NUMBERS, *map(json.dumps, NAMES)))}"
    elif how == 2:
        lines.insert(i, lines[i])
    elif how == 3:
        lines.append(lines.pop(i))
    elif how == 4:
        lines[i] = f"{name.strip()}.{name.strip()} = {value}"
    elif how == 5:
        j = rng.choice(headers)
        lines[j] = rng.choice((f"[{lines[j]}]", lines[j].strip("[]"), "[robot]", "[a.b.c]", "[]"))
    elif how == 6:
        lines.append(lines[rng.choice(headers)])
    elif how == 7:
        words = [lines[k].partition("=")[2] for k in keys]
        lines[i] = f"{name}={rng.choice(words)}"
    else:
        lines[i] = f"{name}= [{', '.join([value.strip() or '0'] * rng.choice((2, 7, 5000)))}]"
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


# Files as the system has them; the file is absent when these are called


def _folder(path: Path) -> None:
    path.mkdir()


def _nothing(path: Path) -> None:
    pass


def _loop(path: Path) -> None:
    path.symlink_to(path.name)


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _binary(path: Path) -> None:
    path.write_bytes(bytes(Random(1).randrange(256) for _ in range(5000)))


def _large(path: Path) -> None:
    with open(path, "wb") as handle:  # sparse: it takes no room
        handle.truncate(3_000_000_000)


KINDS: tuple[Callable[[Path], None], ...] = (
    _folder, _nothing, _loop, _pipe, _device, _binary, _large,
)  # fmt: skip

ON_BYTES = (flip_bits, flip_bits, truncate, cut, double, insert_bytes, encode_anew, empty)
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
        kind = rng.choice(KINDS)
        kind(path)
        return f"{path.name} is {kind.__name__[1:]}"
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
