"""Text and numbers as robot controllers read them."""

from __future__ import annotations


def plain(text: str) -> str:
    """One line of printable ASCII without quotation marks, so that it can stand in a comment or
    a string of any controller; other characters become ?, quotation marks apostrophes."""
    line = " ".join(text.split()).replace('"', "'")
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in line)


def number(value: float, digits: int) -> str:
    """Decimal digits without exponent; no negative zero."""
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
