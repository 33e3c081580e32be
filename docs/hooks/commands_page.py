"""Every verb of the command line as a page, from the command line's own definitions."""

from __future__ import annotations

import inspect
from typing import Any

HEAD = """# Commands

    elastocal VERB CELL [DATA] [options]

This page is made from the command line itself when the site is built; `elastocal VERB --help`
prints the same. For what the verbs are good for see the how-to pages.

Exit codes: 0 done; 1 the data do not support an answer (the message says why and what to measure);
2 wrong input (one message on stderr that names file, row or key; no half-written file is left); 130
interrupted. Colours respect `NO_COLOR`.
"""


def page() -> str:
    """The page, a section for each verb."""
    import typer

    from elastocal.__main__ import commands

    group = typer.main.get_command(commands())
    parts = [HEAD, "## Options of every verb\n", _options(group), ""]
    for name, command in sorted(group.commands.items()):  # type: ignore[attr-defined]
        parts += [f"## {name}\n", inspect.cleandoc(_text(command)), ""]
        arguments = [p for p in command.params if p.param_type_name == "argument"]
        parts += [_arguments(arguments), "", _options(command), ""]
    return "\n".join(parts)


def _text(command: Any) -> str:
    """The help text, its example set as code."""
    text, found, example = inspect.cleandoc(command.help or "").partition("Example: ")
    example = " ".join(example.split())
    return f"{text.strip()}\n\n```console\n$ {example}\n```" if found else text


def _arguments(arguments: list[Any]) -> str:
    lines = ["| argument | |", "|---|---|"]
    for a in arguments:
        lines.append(f"| `{a.name.upper()}` | {_cell(a.help or '')} |")
    return "\n".join(lines) if arguments else ""


def _options(command: Any) -> str:
    lines = ['<div class="options" markdown>\n', "| option | default | |", "|---|---|---|"]
    for p in command.params:
        if p.param_type_name != "option":
            continue
        names = ", ".join(f"`{n}`" for n in (*p.opts, *p.secondary_opts))
        lines.append(f"| {names} | {_default(p)} | {_cell(p.help or '')} |")
    return "\n".join([*lines, "\n</div>"])


def _default(p: Any) -> str:
    if p.required:
        return "required"
    value = p.default
    if callable(value) or value is None or value is False or value in ("", (), []):
        return ""
    shown = str(value)
    return f"`{shown}`" if "Sentinel" not in shown and "UNSET" not in shown else ""


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
