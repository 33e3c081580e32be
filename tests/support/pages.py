"""A report page as its parts: tags, text, table rows, scripts; tags have to match."""

from __future__ import annotations

import base64
import hashlib
import re
from collections import Counter
from html.parser import HTMLParser
from typing import Any

VOID = {"meta", "br", "link", "img", "hr", "input"}
NAMESPACES = {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}


class Page(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: Counter[str] = Counter()
        self.rows: list[list[str]] = []
        self.text = ""
        self.scripts: list[tuple[str, str]] = []  # type and content
        self.policy = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags[tag] += 1
        found = dict(attrs)
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag == "script":
            self.scripts.append((found.get("type", ""), ""))
        if found.get("http-equiv") == "Content-Security-Policy":
            self.policy = found["content"]

    def handle_startendtag(self, tag: str, attrs: Any) -> None:
        self.tags[tag] += 1

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "script" in self.open:
            kind, before = self.scripts[-1]
            self.scripts[-1] = kind, before + data
            return
        self.text += data
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data.strip()

    def named_rows(self) -> dict[str, list[str]]:
        return {row[0]: row for row in self.rows if row}

    @property
    def data(self) -> list[str]:
        return [text for kind, text in self.scripts if kind == "application/json"]

    def check_harmless(self, source: str) -> None:
        """The page runs its own script alone, and asks for nothing from elsewhere."""
        assert not {"link", "img", "iframe", "object"} & set(self.tags)
        (own,) = [text for kind, text in self.scripts if kind == ""]
        assert digest(own) in self.policy
        assert self.policy.startswith("default-src 'none'; ")
        assert "unsafe-eval" not in self.policy
        assert "'unsafe-inline'" not in self.policy.partition("script-src")[2]
        assert "\x1b" not in source
        unscripted = re.sub(r"<script.*?</script>", "", source, flags=re.DOTALL)
        addresses = set(re.findall(r"""(?:https?:)?//[^\s"'<>)]+""", unscripted))
        assert addresses <= NAMESPACES
        assert "@import" not in unscripted
        assert all(t.startswith("#") for t in re.findall(r"url\(([^)]*)\)", unscripted))


def digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
