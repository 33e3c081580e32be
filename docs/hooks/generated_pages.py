"""mkdocs hook: pages that are made from the code at build time, so that they cannot fall behind."""

from __future__ import annotations

import posixpath
import re
from typing import TYPE_CHECKING, Any

import cell_keys_page
import commands_page
import criteria_page
import effects_page

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

PAGES = {
    "reference/effects.md": effects_page.page,
    "reference/commands.md": commands_page.page,
    "reference/criteria.md": criteria_page.page,
    "reference/cell-keys.md": cell_keys_page.page,
}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Underscores are part of names and formulas (w_i), never emphasis."""
    from markdown import Markdown
    from markdown.extensions import Extension

    class PlainUnderscores(Extension):
        def extendMarkdown(self, md: Markdown) -> None:
            md.inlinePatterns.deregister("em_strong2", strict=False)

    config.markdown_extensions.append(PlainUnderscores())  # type: ignore[arg-type]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to those that stand in docs/."""
    from mkdocs.structure.files import File

    for name, make in PAGES.items():
        files.append(File.generated(config, name, content=make()))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """What the files have for other readers, as a site takes it."""
    return plain_fences(links_inside(markdown, page.file.src_uri))


def plain_fences(markdown: str) -> str:
    """Fences whose language has a word of ours behind it (```toml workspace), as Markdown has it.

    The word says to tests and readers of the file which piece of a cell it is; a site would take
    the fence for text.
    """
    return re.sub(r"^```(\w+) \w+$", r"```\1", markdown, flags=re.M)


def links_inside(markdown: str, page: str) -> str:
    """Links that lead out of docs/, into the repository, as the path that they lead to."""

    def shown(found: re.Match[str]) -> str:
        text, target = found.groups()
        path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), target))
        if "://" in target or path.startswith("docs/"):
            return found.group()
        return text if path in text else f"{text} (`{path}`)"

    return re.sub(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)[^)]*\)", shown, markdown)
