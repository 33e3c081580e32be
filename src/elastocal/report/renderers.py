"""The blocks of a result as text for the terminal, as HTML pages that need no network and no other
file, and as what a notebook shows of itself, with figures and data frames.

Every text is escaped by `text_of`; what is not text was made here.  The style sheet and the script
lie beside this module.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import math
import platform
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from datetime import date
from functools import cache
from html import escape
from importlib import import_module, metadata
from io import BytesIO, StringIO
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from elastocal import __version__
from elastocal.above import checked_arguments, sources
from elastocal.files import atomic_write, check_output, open_input
from elastocal.measurements import in_file_units, joint_columns
from elastocal.messages import cell_meaning, check_known, listed, option, printable, quoted, require
from elastocal.model.effects.catalogue import effect_of
from elastocal.report import blocks as say
from elastocal.screen import safe_console, shown

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import RenderableType

    from elastocal.compensation import Compensation
    from elastocal.diagnosis.diagnosis import Diagnosis
    from elastocal.identification.result import Calibration
    from elastocal.planning.plan import Plan


def blocks_of(result: object, certificate: bool = False, **told: Any) -> Iterable[say.Block]:
    """What is to be said of a result.  Each kind has its view, which no other result loads."""
    room, view, _ = VIEWS["certificate" if certificate else type(result).__name__]
    found: Iterable[say.Block] = getattr(import_module(f"elastocal.report.{room}"), view)(
        result, **told
    )
    return found


# Kind of a result → module and function that say it, and what its page is.
VIEWS = {
    "certificate": ("smaller_views", "certificate_blocks", "Calibration certificate"),
    "Calibration": ("identification_view", "calibration_blocks", "Identification"),
    "Diagnosis": ("diagnosis_view", "diagnosis_blocks", "Diagnosis"),
    "Plan": ("plan_view", "plan_blocks", "Measurement plan"),
    "NextPoses": ("plan_view", "next_blocks", "Next poses"),
    "Comparison": ("smaller_views", "changes_blocks", "Comparison"),
    "Compensation": ("smaller_views", "commands_blocks", "Compensation"),
    "Measurements": ("smaller_views", "readings_blocks", "Readings"),
}

PRINTED_WIDTH = 100  # columns of a result as plain text
WIDEST = 1000  # columns; more than any table needs
STYLES = {"inside": "green", "outside": "bold red", "changed": "bold yellow"}
LONGEST_WHOLE = 28  # letters; a longer name breaks where its column ends


def print_report(console: Console, result: object, details: bool = True, **told: Any) -> None:
    """Without `details` only what stands open, not what is folded and `printed`."""
    print_blocks(console, blocks_of(result, **told), details)
    if not details:
        more = f"{option('details', True)} tells of method, noise, residuals, intervals"
        console.print(Text(f"{more} and every combination; so does the report.", style="dim"))


def printed_text(result: object) -> str:
    text = StringIO()
    print_report(safe_console(file=text, width=PRINTED_WIDTH, color_system=None), result)
    return "\n".join(line.rstrip() for line in text.getvalue().rstrip().splitlines())


def print_blocks(console: Console, blocks: Iterable[say.Block], details: bool = False) -> None:
    heading, before = "", None
    for block in say.unfolded(blocks, lambda fold: details and fold.printed):
        if isinstance(block, say.Heading):
            heading = block.text
        elif shown := list(_shown(console, block)):
            kind = say.Lines if isinstance(block, say.ShownVerdict) else type(block)
            if before not in (None, kind, say.ShownTable):  # a table ends with one
                console.print()
            if heading and _needs(heading, block):
                console.print(Text(heading, style="bold underline"))
            for each in shown:
                console.print(each, crop=False)  # wider than the screen, rather than cut
            heading, before = "", kind


def _needs(heading: str, block: say.Block) -> bool:
    told = block.title if isinstance(block, say.ShownTable) else ""
    if isinstance(block, say.Lines):
        told = block.items[0][0]
    first = told.partition(" (")[0].partition(",")[0]
    return not (told and (told.startswith(heading) or heading.startswith(first)))


def _shown(console: Console, block: say.Block) -> Iterable[RenderableType]:
    if isinstance(block, say.ShownVerdict):
        yield _line("Verdict", block.sentence, "bold" if block.tone == "good" else "bold yellow")
    elif isinstance(block, say.Lines):
        for label, text in block.items:
            yield _line(label, text, "bold yellow" if label == say.WARNING else "bold")
    elif isinstance(block, say.Sentence):
        yield Text(printable(block.text), style="dim" if block.soft else "")
    elif isinstance(block, say.ShownTable) and block.rows:
        shown, room = block, console.options.update(max_width=WIDEST)
        marked = "" in shown.heads  # by a last column, which is cut unless the others give way

        def width(table: Table) -> Measurement:
            return Measurement.get(console, room, table)

        while shown.narrow and width(table_of(shown, marked)).minimum > console.width:
            shown = shown.narrow
        whole = table_of(shown)
        yield whole if width(whole).maximum <= console.width else table_of(shown, marked)
        if block.note:
            yield Text(printable(block.note), style="dim")


def _line(label: str, text: str, style: str) -> Text:
    return Text.assemble((f"{label}: ", style), printable(text))


def table_of(shown: say.ShownTable, tight: bool = False) -> Table:
    """For the terminal: under its title, with a rule below its heads and no frame; words to the
    left, numbers to the right.  `tight`: only what is longer than a word gives way, and heads."""
    table = Table(title=shown.title or None, title_justify="left", title_style="bold",
                      box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)  # fmt: skip
    for k, head in enumerate(shown.heads):
        words, cells = k in shown.words, [row[k] for row in shown.rows]
        word = max((len(w) for text in (head, *cells) for w in text.split()), default=0)
        longest = word if words else max([word, *map(len, cells)])
        held = words and longest <= LONGEST_WHOLE and (not k or "±" in head or head in ("unit", ""))
        gives_way = words and any(" " in cell for cell in cells)
        table.add_column(head, justify="left" if words else "right", overflow="fold",
                         min_width=word if held or not words else None,
                         width=longest if tight and not gives_way else None)  # fmt: skip
    for row in shown.rows:
        table.add_row(*(Text(printable(cell), STYLES.get(cell, "")) for cell in row))
    return table


LIBRARIES = ("numpy", "scipy", "casadi")  # that the numbers depend on
Inputs = Mapping[str, str] | Iterable[str | Path] | str | Path | None


@checked_arguments
def write_page(
    result: Any, path: str | Path, inputs: Any = None, command: str | None = None,
    seed: int | None = None, **told: Any,
) -> None:  # fmt: skip
    """Arguments as for `page_of`; where no `inputs` are named, they are the files that the result
    came from.  A certificate whose name ends in .xml is a digital one (DCC)."""
    path = Path(path)
    if told.get("certificate") and path.suffix.lower() == ".xml":
        from elastocal.report.smaller_views import dcc_text

        return atomic_write(path, dcc_text(result))
    check_output(path, (".html", ".htm"))
    inputs = sources(result) if inputs is None else inputs
    atomic_write(path, page_of(result, inputs, command, seed, **told))


def page_of(
    result: Any, inputs: Inputs = None, command: str | None = None, seed: int | None = None,
    certificate: bool = False, **told: Any,
) -> str:  # fmt: skip
    """`inputs` are the files read, or a map from their names to their SHA-256; `command` and `seed`
    tell how to repeat the run.  To a calibration `truth` (SI) adds true values, and `published`
    values (SI) and half widths that others found; `certificate` makes a certificate of it."""
    body = html_of(blocks_of(result, certificate, **told))
    kind = VIEWS["certificate" if certificate else type(result).__name__][2]
    if certificate and result.model.cell.certificate.missing:
        kind = "Calibration report"
    model = getattr(getattr(result, "old", result), "model", None)
    names = [getattr(result, name, "") for name in ("source", "data")]
    if model is not None:
        names = [model.chain.name, model.cell.name]
    elif hasattr(result, "chain"):
        names = [result.chain.name]
    # Robot and cell, once where they have the same name.
    title = printable(" – ".join(name for name in dict.fromkeys(names) if name))
    head = f"{kind} of {text_of(title, False)}"
    space = VIEW in body
    libraries = (*LIBRARIES, "plotly") if space else LIBRARIES
    versions = [f"{name} {metadata.version(name)}" for name in libraries]
    found = (
        ("command", command), ("elastocal", __version__), ("made on", date.today().isoformat()),
        ("with", ", ".join([f"Python {platform.python_version()}", *versions])),
        ("model evaluated by", None if model is None else model.backend_report()),
        ("seed", getattr(result, "seed", seed)),
        *((name, f"SHA-256 {digest}") for name, digest in digests_of(inputs).items()),
    )  # fmt: skip
    rows = "".join(
        f'<tr><td class="name">{text_of(name, False)}</td>'
        f"<td><code>{text_of(str(value), False)}</code></td></tr>\n"
        for name, value in found if value not in (None, "")
    )  # fmt: skip
    last = f'<table class="repeat"><tbody>{rows}</tbody></table>'
    if not certificate:  # which is to be printed and kept, so that nothing is folded
        last = f"<details><summary>To repeat this</summary>{last}</details>"
    source, packed = plotly() if space else ("", "")
    script = say.resource("report.js")
    # The page runs these two scripts, and no other: not even one that slipped into a name.
    digests = (hashlib.sha256(text.encode()).digest() for text in (script, source) if text)
    hashes = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
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
<style>{say.resource("style.css")}</style>
</head>
<body class="{"filed" * certificate}">
<h1>{head}</h1>
{body}{last}
{carried if space else ""}
<script>{script}</script>
</body>
</html>
"""


OPTION = re.compile(r"(?<!\S)\(?--[a-z][a-z-]+[.,:;)]*")
VIEW = '<script type="application/json" class="view-data">'


def text_of(text: str, minus: bool = True) -> str:
    """A text as HTML, as it can be read; `minus`: with proper minus signs before numbers, and
    options of the command line in one piece."""
    found = escape(shown(text))
    return OPTION.sub(r'<span class="whole">\g<0></span>', say.typeset(found)) if minus else found


def html_of(
    blocks: Iterable[say.Block], deep: int = 2, pictures: bool = True, summary: str = ""
) -> str:
    """Under heads of level `deep`; figures that follow each other stand in a row.  Without
    `pictures` figures are left out, and of folds what is not `printed`.  A table does not repeat
    the `summary` that they stand behind."""
    parts = []
    for flat, several in groupby(blocks, lambda b: isinstance(b, say.Figure) and b.space is None):
        found = [_html(block, deep, pictures, summary) for block in several]
        if flat and pictures:
            found = [f'<div class="figures">{"".join(found)}</div>']
        parts += found
    return "\n".join(part for part in parts if part)


def _html(block: say.Block, deep: int, pictures: bool, summary: str) -> str:
    if isinstance(block, say.ShownVerdict):
        tone = '<span class="tone" aria-hidden="true"></span>'
        return (
            f'<section class="judgement {block.tone}" aria-label="Verdict"><p class="headline">'
            f"{tone} {text_of(block.sentence)}</p></section>"
        )
    if isinstance(block, say.KeyFigures):
        figures = "".join(
            f"<div><dt>{text_of(name)}</dt><dd>{text_of(number)}</dd></div>"
            for name, number in block.figures
        )
        return f'<p class="change">{text_of(block.headline)}</p><dl class="key">{figures}</dl>'
    if isinstance(block, say.Heading):
        return f"<h{deep}>{text_of(block.text)}</h{deep}>"
    if isinstance(block, say.Sentence):
        return f'<p class="{"soft" if block.soft else "told"}">{text_of(block.text)}</p>'
    if isinstance(block, say.Lines):
        return _lines(block)
    if isinstance(block, say.ShownTable):
        return _table(block, deep, summary) if block.rows else ""
    if isinstance(block, say.Fold):
        if not (pictures or block.printed):
            return ""
        inside = html_of(block.blocks(), deep + bool(block.summary), pictures, block.summary)
        if not (inside and block.summary):
            return inside
        return f"<details><summary>{text_of(block.summary)}</summary>\n{inside}</details>"
    return _picture(block) if pictures else ""


def _lines(block: say.Lines) -> str:
    parts = []
    for label, items in groupby(block.items, lambda item: item[0]):
        texts = [text_of(text) for _, text in items]
        told = texts[0] if len(texts) == 1 else f"<ul><li>{'</li><li>'.join(texts)}</li></ul>"
        tone = ' class="warned"' if label == say.WARNING else ""
        parts.append(f"<dt{tone}>{text_of(label)}</dt><dd>{told}</dd>")
    return f'<dl class="lines">{"".join(parts)}</dl>' if parts else ""


def _table(t: say.ShownTable, deep: int, summary: str) -> str:
    told = not t.title or summary.startswith(t.title.partition(" (")[0])
    title = "" if told else f"<h{deep}>{text_of(t.title)}</h{deep}>\n"
    below = f'\n<p class="soft">{text_of(t.note)}</p>' if t.note else ""
    slug = re.findall(r"[a-z0-9]+", re.split("[(,]", t.title or t.heads[0])[0].lower())
    kinds = ["name" if k in t.words else "number" for k in range(len(t.heads))]
    heads = [
        f'<th scope="col" class="{kind}">{text_of(head)}</th>'
        for kind, head in zip(kinds, t.heads, strict=True)
    ]
    # What stands before a cell where a screen is too narrow for columns.
    before = ["" if head == "unit" else text_of(head) for head in t.heads]
    rows = []
    for k, row in enumerate(t.rows):
        if k in t.groups:
            rows.append(f'<tr class="group"><th scope="colgroup" colspan="{len(heads)}">'
                        f"{text_of(t.groups[k])}</th></tr>")  # fmt: skip
        cells = "".join(
            f'<td class="{kind}{f" {text}" * (text in STYLES)}" data-head="{head}">'
            f"{text_of(text)}</td>"
            for kind, head, text in zip(kinds, before, row, strict=True)
        )
        rows.append(f"<tr>{cells}</tr>")
    body = "\n".join(rows)
    return (
        f'{title}<table class="data" data-name="{"-".join(slug)}"><thead>'
        f"<tr>{''.join(heads)}</tr></thead>\n<tbody>{body}</tbody></table>{below}"
    )


def _picture(block: say.Figure) -> str:
    from elastocal.report.figures import svg

    caption = f"<figcaption>{text_of(block.caption)}</figcaption>" if block.caption else ""
    if block.space is None:
        return f"<figure>{svg(block)}{caption}</figure>"
    return (
        f'<figure class="view"><div class="still">{svg(block)}</div><div class="live" hidden></div>'
        f"{VIEW}{block.space.json}</script>{caption}</figure>"
    )


@cache
def plotly() -> tuple[str, str]:
    """plotly.js, and the same packed (gzip, base64) to a third of that."""
    from plotly.offline import get_plotlyjs

    source = get_plotlyjs()
    return source, base64.b64encode(gzip.compress(source.encode(), 9, mtime=0)).decode()


def digests_of(inputs: Inputs) -> dict[str, str]:
    if inputs is None or isinstance(inputs, Mapping):
        return dict(inputs or {})
    found = {}
    require(isinstance(inputs, Iterable), f"{option('inputs')} takes paths; found {inputs}")
    for path in [inputs] if isinstance(inputs, str | Path) else inputs:
        with open_input(path, "input file") as handle:
            found[str(path)] = hashlib.file_digest(handle, "sha256").hexdigest()  # type: ignore[arg-type]
    return found


# In a notebook (found by elastocal.above): HTML, figures and data frames

# What `plot` draws where nothing else is asked for, if not the first figure.
DEFAULTS = {"Calibration": "residuals", "Diagnosis": "budget"}


def html(result: object) -> str:
    return html_of(blocks_of(result), 4, pictures=False)


@checked_arguments
def plot(result: object, kind: str | None, interactive: bool, ax: Any = None) -> Any:
    """matplotlib's, in the place of `ax` where that is given, or of the arm plotly's where
    `interactive`."""
    from elastocal.report.figures import figure_of

    folds = [block for block in blocks_of(result) if isinstance(block, say.Fold)]
    every = [name for fold in folds for name in fold.figures]
    arms = [name for name in every if name in ("space", "poses")]
    chosen = DEFAULTS.get(type(result).__name__, every[0]) if kind is None else kind
    if interactive and kind is None and arms:
        chosen = arms[0]

    def figures(names: Collection[str]) -> dict[str, say.Figure]:
        opened = say.unfolded(folds, lambda fold: not set(names).isdisjoint(fold.figures))
        return {block.name: block for block in opened if isinstance(block, say.Figure)}

    found = figures([chosen]).get(chosen)
    if found is None:
        check_known(chosen, figures(every), f"no figure {quoted(chosen)}")
    assert found is not None
    if interactive:
        told = f"; interactive=True turns the arm: {listed(arms)}" * bool(arms)
        require(found.space, f"the figure {quoted(chosen)} stands still{told}")
        from elastocal.report.arm_view import turned

        return turned(found.space)
    if ax is not None:
        spot: Any = getattr(ax, "get_subplotspec", lambda: None)()
        require(spot is not None, "`ax` takes axes that plt.subplots or Figure.subplots made")
        ax.remove()
        return figure_of(found, spot.get_gridspec().figure.add_subfigure(spot))
    figure: Any = figure_of(found)

    def png() -> bytes:
        picture = BytesIO()
        figure.savefig(picture, format="png", dpi=100, facecolor="white")
        return picture.getvalue()

    figure._repr_png_ = png  # for a notebook without pyplot, whose hooks do so
    return figure


def frame(result: object) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame(FRAMES[type(result).__name__](result))


def _estimates(result: Calibration) -> list[dict[str, Any]]:
    none = math.nan, math.nan
    return [
        {
            "parameter": e.name, "unit": e.unit, "value": value, "std": std, "ci95_low": low,
            "ci95_high": high, "nominal": e.nominal, "held": e.held,
            "identifiable": e.identifiable, "combined_with": ", ".join(e.combined_with),
            "note": e.note,
        }
        for e in result.estimates
        for value, std in (none if e.value is None else (e.value, e.std),)
        for low, high in (e.ci95 or none,)
    ]  # fmt: skip


def _plan_frame(plan: Plan | None) -> dict[str, Any]:
    if plan is None:
        return {}
    columns: dict[str, Any] = {"configuration": list(plan.names)}
    kinds = plan.model.chain.kinds
    columns |= dict(zip(joint_columns(kinds), in_file_units(plan.q, kinds).T, strict=True))
    if plan.level_joint is not None:
        columns["level"] = plan.group + 1
    order = say.first_stops(plan)
    columns["order"] = [order.get(k) for k in range(len(plan.q))]
    return columns


def _candidates(d: Diagnosis) -> list[dict[str, Any]]:
    """Best first; whether it is held to be real; `score` in nats.  What was found only where all
    causes are judged together comes first, without a score."""
    found = {(f.effect, f.where): f for f in d.effects}
    tried = {(c.effect, c.where): c for c in d.candidates}
    return [
        {
            "effect": key[0], "where": key[1], "stage": effect_of(key[0]).stage,
            "probability": getattr(c or f, "probability", np.nan),
            "score": getattr(c, "score", np.nan),
            "detectable": getattr(c, "detectable", np.nan), "found": f is not None,
            "gap_reduction": getattr(f, "gap_reduction", np.nan),
        }
        for key in dict.fromkeys([*(key for key in found if key not in tried), *tried])
        for f, c in ((found.get(key), tried.get(key)),)
    ]  # fmt: skip


def _commands(c: Compensation) -> pd.DataFrame:
    import pandas as pd

    from elastocal.compensation import commands_csv

    text = StringIO(commands_csv(c))
    frame = pd.read_csv(text, dtype={"configuration": str}, keep_default_na=False, na_values=[""])
    if "configuration" in frame:
        frame["configuration"] = frame["configuration"].map(cell_meaning, na_action="ignore")
    return frame


FRAMES: dict[str, Callable[[Any], Any]] = {
    "Calibration": _estimates,
    "Plan": _plan_frame,
    "NextPoses": lambda found: _plan_frame(found.plan),
    "Diagnosis": _candidates,
    "Comparison": lambda c: [vars(change) for change in c.changes],
    "Compensation": _commands,
    "Measurements": lambda table: table.to_dataframe(),
}
