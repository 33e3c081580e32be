"""The blocks of a result as HTML: pages that need no network and no other file.

Every text is escaped by `_text`; what is not text was made here.  The style sheet and the script
lie beside this module.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import platform
import re
from collections.abc import Callable, Iterable, Mapping
from datetime import date
from functools import cache
from html import escape
from importlib import metadata
from itertools import groupby
from pathlib import Path
from typing import Any

from elastocal import __version__
from elastocal.files import atomic_write_text, check_ending, open_input
from elastocal.report.blocks import (
    WARNING,
    Block,
    Figure,
    Fold,
    Heading,
    KeyFigures,
    Lines,
    Sentence,
    ShownArm,
    ShownTable,
    ShownVerdict,
)
from elastocal.report.formatting import resource, typeset
from elastocal.report.terminal import report_of
from elastocal.screen import shown

LIBRARIES = ("numpy", "scipy", "casadi")  # that the numbers depend on
Inputs = Mapping[str, str] | Iterable[str | Path] | None


def write_page(
    result: object, path: Path, inputs: Inputs = None, command: str | None = None,
    seed: int | None = None, **told: Any,
) -> None:  # fmt: skip
    """Write the result's page, whole or not at all; arguments as for `page_of`.  A certificate
    whose name ends in .xml is a digital one (DCC).

    Where no `inputs` are named, they are the files that the result came from.  Raises InputError
    where an input cannot be read or `path` cannot be written, or names no page.
    """
    if told.get("certificate") and path.suffix.lower() == ".xml":
        from elastocal.report.certificate_view import dcc_text

        fit: Any = result
        return atomic_write_text(path, dcc_text(fit))
    check_ending(path, (".html", ".htm"))
    inputs = sources(result) if inputs is None else inputs
    atomic_write_text(path, page_of(result, inputs, command, seed, **told))


def page_of(
    result: object, inputs: Inputs = None, command: str | None = None, seed: int | None = None,
    **told: Any,
) -> str:  # fmt: skip
    """The page of a result as text.

    `inputs` are the files read, or a map from their names to their SHA-256; `command` and `seed`
    tell how to repeat the run.  To a calibration `truth` (SI) adds true values, and `published`
    values (SI) and half widths that others found; `certificate` makes a certificate of it.  Raises
    InputError where an input cannot be read.
    """
    named = digests(inputs)
    report = report_of(result, **told)
    body = html_of(report.blocks)
    space = VIEW in body
    libraries = (*LIBRARIES, "plotly") if space else LIBRARIES
    versions = [f"{name} {metadata.version(name)}" for name in libraries]
    found = (
        ("command", command), ("elastocal", __version__), ("made on", date.today().isoformat()),
        ("with", ", ".join([f"Python {platform.python_version()}", *versions])),
        ("model evaluated by", report.backend),
        ("seed", seed if report.seed is None else report.seed),
        *((name, f"SHA-256 {digest}") for name, digest in named.items()),
    )  # fmt: skip
    rows = "".join(
        f'<tr><td class="name">{text_of(name, False)}</td>'
        f"<td><code>{text_of(str(value), False)}</code></td></tr>\n"
        for name, value in found if value not in (None, "")
    )  # fmt: skip
    last = f'<table class="repeat"><tbody>{rows}</tbody></table>'
    if not report.filed:
        last = f"<details><summary>To repeat this</summary>{last}</details>"
    return _framed(f"{report.kind} of {text_of(report.title, False)}", body + last, space,
                   "filed" if report.filed else "")  # fmt: skip


def _framed(head: str, body: str, space: bool, kind: str) -> str:
    """The whole page.  Where it has a 3-D view, plotly.js comes along.  It runs these two scripts,
    named by their hashes, and no other: not even one that slipped into a name."""
    source, packed = plotly() if space else ("", "")
    script = resource("report.js")
    hashes = " ".join(f"'sha256-{_digest(text)}'" for text in (script, source) if text)
    carried = f'<script type="application/octet-stream" id="plotly">{packed}</script>'
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; \
style-src 'unsafe-inline'; img-src data: blob:; script-src {hashes}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="elastocal {__version__}">
<title>{head}</title>
<style>{resource("style.css")}</style>
</head>
<body class="{kind}">
<h1>{head}</h1>
{body}
{carried if space else ""}
<script>{script}</script>
</body>
</html>
"""


# Blocks as HTML

VIEW = '<script type="application/json" class="view-data">'


def text_of(text: str, minus: bool = True) -> str:
    """A text as HTML, as it can be read; `minus`: with proper minus signs before numbers."""
    found = escape(shown(text))
    return typeset(found) if minus else found


def html_of(
    blocks: Iterable[Block], deep: int = 2, pictures: bool = True, summary: str = ""
) -> str:
    """Blocks as HTML under heads of level `deep`; figures that follow each other stand in a row.

    Without `pictures` figures are left out, and of folds what is not `printed`.  A table does not
    repeat the `summary` that they stand behind.
    """
    parts = []
    for kind, several in groupby(blocks, type):
        found = [_html(block, deep, pictures, summary) for block in several]
        if kind is Figure and pictures:
            found = [f'<div class="figures">{"".join(found)}</div>']
        parts += found
    return "\n".join(part for part in parts if part)


def _html(block: Block, deep: int, pictures: bool, summary: str) -> str:
    if isinstance(block, ShownVerdict):
        return _verdict(block)
    if isinstance(block, KeyFigures):
        return _key(block)
    if isinstance(block, Heading):
        return f"<h{deep}>{text_of(block.text)}</h{deep}>"
    if isinstance(block, Sentence):
        return f'<p class="{"soft" if block.soft else "told"}">{text_of(block.text)}</p>'
    if isinstance(block, Lines):
        return _lines(block)
    if isinstance(block, ShownTable):
        return _titled_table(block, deep, summary) if block.rows else ""
    if isinstance(block, Fold):
        if not (pictures or block.printed):
            return ""
        inside = html_of(block.blocks(), deep + bool(block.summary), pictures, block.summary)
        if not (inside and block.summary):
            return inside
        return f"<details><summary>{text_of(block.summary)}</summary>\n{inside}</details>"
    return _picture(block) if pictures else ""


def _verdict(v: ShownVerdict) -> str:
    tone = '<span class="tone" aria-hidden="true"></span>'
    return (
        f'<section class="judgement {v.tone}" aria-label="Verdict"><p class="headline">{tone} '
        f"{text_of(v.sentence)}</p></section>"
    )


def _key(key: KeyFigures) -> str:
    figures = "".join(
        f"<div><dt>{text_of(name)}</dt><dd>{text_of(number)}</dd></div>"
        for name, number in key.figures
    )
    return f'<p class="change">{text_of(key.headline)}</p><dl class="key">{figures}</dl>'


def _lines(block: Lines) -> str:
    """A label once for sentences that follow each other."""
    parts = []
    for label, items in groupby(block.items, lambda item: item[0]):
        texts = [text_of(text) for _, text in items]
        told = texts[0] if len(texts) == 1 else f"<ul><li>{'</li><li>'.join(texts)}</li></ul>"
        tone = ' class="warned"' if label == WARNING else ""
        parts.append(f"<dt{tone}>{text_of(label)}</dt><dd>{told}</dd>")
    return f'<dl class="lines">{"".join(parts)}</dl>' if parts else ""


def _titled_table(t: ShownTable, deep: int, summary: str) -> str:
    told = not t.title or summary.startswith(t.title.partition(" (")[0])
    title = "" if told else f"<h{deep}>{text_of(t.title)}</h{deep}>\n"
    below = f'\n<p class="soft">{text_of(t.note)}</p>' if t.note else ""
    return f"{title}{_table(t)}{below}"


def _table(t: ShownTable) -> str:
    kinds = ["name" if k in t.words else "number" for k in range(len(t.heads))]
    heads = [
        f'<th scope="col" class="{kind}">{text_of(head)}</th>'
        for kind, head in zip(kinds, t.heads, strict=True)
    ]
    rows = []
    for k, row in enumerate(t.rows):
        if k in t.groups:
            rows.append(f'<tr class="group"><th scope="colgroup" colspan="{len(heads)}">'
                        f"{text_of(t.groups[k])}</th></tr>")  # fmt: skip
        cells = [_cell(*each) for each in zip(kinds, t.heads, row, strict=True)]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    body = "\n".join(rows)
    return (
        f'<table class="data" data-name="{_slug(t.title or t.heads[0])}"><thead>'
        f"<tr>{''.join(heads)}</tr></thead>\n<tbody>{body}</tbody></table>"
    )


def _cell(kind: str, head: str, text: str) -> str:
    """`data-head` stands before the cell where a screen is too narrow for columns."""
    tone = f" {text}" if text in ("inside", "outside", "changed") else ""
    before = "" if head == "unit" else text_of(head)
    return f'<td class="{kind}{tone}" data-head="{before}">{text_of(text)}</td>'


def _slug(title: str) -> str:
    """ "Predicted intervals (95 %)" → "predicted-intervals"."""
    return "-".join(re.findall(r"[a-z0-9]+", re.split("[(,]", title)[0].lower()))


def _picture(block: Figure | ShownArm) -> str:
    caption = f"<figcaption>{text_of(block.caption)}</figcaption>" if block.caption else ""
    if isinstance(block, Figure):
        from elastocal.report.figures import svg

        return f"<figure>{svg(block)}{caption}</figure>"
    from elastocal.report.arm_view import space_figure
    from elastocal.report.figures import svg

    return (
        f'<figure class="view"><div class="still">{svg(space_figure(block))}</div>'
        f'<div class="live" hidden></div>{VIEW}{block.space.json}</script>{caption}</figure>'
    )


# What goes with a page


@cache
def plotly() -> tuple[str, str]:
    """plotly.js, and the same packed (gzip, base64) to a third of that."""
    from plotly.offline import get_plotlyjs

    source = get_plotlyjs()
    packed = gzip.compress(source.encode(), 9, mtime=0)
    return source, base64.b64encode(packed).decode()


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def sources(result: Any) -> list[Path]:
    of_kind: dict[str, Callable[[Any], list[Any]]] = {
        "Comparison": lambda c: [c.old.model.cell.path, c.old.source, c.new.source],
        "Compensation": lambda c: [c.targets.table.source],
        "Calibration": lambda c: [c.model.cell.path, c.observations.table.source],
        "Diagnosis": lambda d: [d.model.cell.path, d.data],
        "Plan": lambda p: [p.model.cell.path],
    }
    named = of_kind.get(type(result).__name__, lambda r: [getattr(r, "source", None)])(result)
    return [Path(path) for path in named if path is not None and Path(path).is_file()]


def digests(inputs: Inputs) -> dict[str, str]:
    """File name → SHA-256; a map is taken as it is."""
    if inputs is None or isinstance(inputs, Mapping):
        return dict(inputs or {})
    found = {}
    for path in inputs:
        with open_input(path, "input file") as handle:
            found[str(path)] = hashlib.file_digest(handle, "sha256").hexdigest()  # type: ignore[arg-type]
    return found
