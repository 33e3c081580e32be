"""YAML of plain data: mappings, sequences, texts, numbers.  Reading YAML would need a library;
writing this much of it does not."""

from __future__ import annotations

import json
from typing import Any


def to_yaml(data: Any) -> str:
    """`data` (dicts with text keys, lists, texts, numbers, booleans, None) as YAML 1.1 and 1.2.

    Lists of plain values stand on one line; texts are quoted wherever YAML might take them for
    something else.
    """
    return "\n".join(_lines(data)) + "\n"


def _lines(data: Any) -> list[str]:
    if isinstance(data, dict) and data:
        lines = []
        for key, value in data.items():
            if _is_flow(value):
                lines.append(f"{_scalar(key)}: {_flow(value)}")
            else:
                lines += [f"{_scalar(key)}:", *(f"  {line}" for line in _lines(value))]
        return lines
    if isinstance(data, list) and not _is_flow(data):
        lines = []
        for item in data:
            first, *rest = _lines(item)
            lines += [f"- {first}", *(f"  {line}" for line in rest)]
        return lines
    return [_flow(data)]


def _is_flow(data: Any) -> bool:
    if isinstance(data, dict):
        return not data
    return not isinstance(data, list) or not any(isinstance(v, dict | list) for v in data)


def _flow(data: Any) -> str:
    if isinstance(data, list):
        return f"[{', '.join(_scalar(v) for v in data)}]"
    return "{}" if isinstance(data, dict) else _scalar(data)


def _scalar(value: Any) -> str:
    if isinstance(value, float):
        text = repr(value)
        # YAML 1.1 takes 1e-07 for a text: a number needs a point before the exponent.
        mantissa, e, exponent = text.partition("e")
        return text if not e or "." in mantissa else f"{mantissa}.0e{exponent}"
    if isinstance(value, str) and _is_plain(value):
        return value
    # A JSON text, number or null is one in YAML too, except that YAML knows no surrogate pairs
    # and wants more characters escaped.
    text = json.dumps(value, allow_nan=False, ensure_ascii=False)
    return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in text)


def _is_plain(text: str) -> bool:
    """Letters first, then letters, digits, and _ . : - / inside: no YAML reads it otherwise."""
    if not text.isascii() or text.lower() in {
        "true", "false", "yes", "no", "on", "off", "null", "y", "n", "nan", "inf",
    }:  # fmt: skip
        return False
    rest = text.translate(str.maketrans("", "", "_./-"))
    return text[:1].isalpha() and rest.isalnum()
