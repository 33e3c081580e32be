"""The furniture that all reports share: template, style, script, and how to repeat the run."""

from __future__ import annotations

import base64
import hashlib
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from elastocal import __version__
from elastocal.files import open_input
from elastocal.report.words import printable

if TYPE_CHECKING:
    from jinja2 import Environment

    from elastocal.manipulator.model import Model

LIBRARIES = ("numpy", "scipy", "casadi")
Inputs = Mapping[str, str] | Iterable[str | Path] | None


@dataclass(frozen=True)
class Repeat:
    """What it takes to repeat a run: command line, files read with their SHA-256, seed, engine.

    `inputs` are the files, or a map from their names to their hashes; `backend` is what
    `Model.backend_report` says.
    """

    command: str | None = None
    inputs: Inputs = None
    seed: int | None = None
    backend: str = ""


@dataclass(frozen=True)
class Table:
    """A table of texts.  `words` are the columns that hold words; the others hold numbers.

    `groups` names the rows that follow, by the index of the first: {0: "base frame", 6: …}.
    """

    heads: tuple[str, ...]
    rows: list[tuple[str, ...]]
    words: tuple[int, ...] = (0,)
    groups: dict[int, str] = field(default_factory=dict)


def render(template: str, title: str, repeat: Repeat, **content: Any) -> str:
    """The page of `template` as text, which needs no network and no other file.

    Where `content` has a `view` (JSON of the 3-D view), plotly.js comes along.  The page runs
    these two scripts, named by their hashes, and no other: not even one that slipped into a name.
    Raises InputError where an input cannot be read.
    """
    from markupsafe import Markup

    script = resource("report.js")
    scripts = [script, *([plotly().source] if content.get("view") else [])]
    return str(
        environment()
        .get_template(template)
        .render(
            title=printable(title),
            css=Markup(resource("style.css")),
            script=Markup(script),
            script_hashes=" ".join(f"'sha256-{_digest(text)}'" for text in scripts),
            plotly=Markup(plotly().packed) if content.get("view") else "",
            version=__version__,
            environment=software(bool(content.get("view"))),
            command=None if repeat.command is None else printable(repeat.command),
            inputs={printable(k): printable(v) for k, v in digests(repeat.inputs).items()},
            seed=repeat.seed,
            backend=printable(repeat.backend),
            **content,
        )
    )


@cache
def environment() -> Environment:
    """Templates of this package: what is not marked as markup is escaped, what is missing fails."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    return Environment(
        loader=FunctionLoader(resource),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


@dataclass(frozen=True)
class Plotly:
    """plotly.js as `source`, and `packed` (gzip, base64) to a third of that."""

    source: str
    packed: str


@cache
def plotly() -> Plotly:
    import gzip

    from plotly.offline import get_plotlyjs

    source = get_plotlyjs()
    packed = gzip.compress(source.encode(), 9, mtime=0)
    return Plotly(source, base64.b64encode(packed).decode())


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def title_of(model: Model) -> str:
    """Robot and cell, once where they have the same name."""
    names = dict.fromkeys([model.chain.name, model.cell.name])
    return " – ".join(name for name in names if name)


def digests(inputs: Inputs) -> dict[str, str]:
    """File name → SHA-256; a map is taken as it is."""
    if inputs is None or isinstance(inputs, Mapping):
        return dict(inputs or {})
    found = {}
    for path in inputs:
        with open_input(path, "input file") as handle:
            digest = hashlib.sha256()
            while block := handle.read(1 << 20):
                digest.update(block)
        found[str(path)] = digest.hexdigest()
    return found


def software(plotly: bool = False) -> str:
    """Python and the libraries that the numbers depend on; plotly where the page draws with it."""
    names = (*LIBRARIES, "plotly") if plotly else LIBRARIES
    versions = [f"{name} {metadata.version(name)}" for name in names]
    return ", ".join([f"Python {platform.python_version()}", *versions])


def resource(name: str) -> str:
    return (resources.files("elastocal.report") / name).read_text(encoding="utf-8")
