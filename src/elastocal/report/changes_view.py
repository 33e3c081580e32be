"""What a comparison of two calibrations says, as blocks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from elastocal.diagnosis.changes import Comparison
from elastocal.report.blocks import (
    Block,
    Figure,
    Fold,
    KeyFigures,
    Lines,
    Report,
    ShownTable,
    ShownVerdict,
)
from elastocal.report.effect_names import p_value, size_of
from elastocal.report.formatting import estimate, length, title_of
from elastocal.text import listed, printable

NAMED = 3  # parameters in a headline
MOST_DRAWN = 20  # parameters


def changes_report(c: Comparison) -> Report:
    """Two calibrations of one arm: has it changed, how far does the tool move, and by what."""
    model = c.old.model
    title = title_of(model.chain.name, model.cell.name)
    return Report("Comparison", title, _blocks(c), model.backend_report())


def _blocks(c: Comparison) -> Iterator[Block]:
    yield Fold("", lambda: [_key(c)])
    same = c.verdict == "no_change_shown" and not c.one_result
    yield ShownVerdict("good" if same else "warn", headline(c))
    yield Lines(changes_lines(c))
    yield Fold("", lambda: [_moves(c)], figures=("moved",))
    yield _change_table(c)


def _moved(c: Comparison) -> tuple[str, str, str]:
    """How far the tool has moved, rms and at most, and what noise alone gives."""
    rms, noise = (length(float(np.sqrt(np.mean(v**2)))) for v in (c.distance, c.chance))
    return rms, length(float(c.distance.max())), noise


def _key(c: Comparison) -> KeyFigures:
    rms, most, noise = _moved(c)
    figures = [
        ("the tool has moved, rms", rms), ("at most", most), ("noise alone", noise),
        ("all parameters together", size_of(c.p)),
    ]  # fmt: skip
    return KeyFigures(f"moved by {rms} (noise {noise})", figures)


def headline(c: Comparison) -> str:
    """The verdict in a sentence."""
    if c.one_result:
        return (
            f"Nothing is compared: {printable(c.old.source)} and {printable(c.new.source)} are the "
            "same result, equal to the last digit."
        )
    if c.changed:
        names = ", ".join(printable(change.name) for change in c.changed[:NAMED])
        more = f" and {len(c.changed) - NAMED} more" if len(c.changed) > NAMED else ""
        return f"The arm has changed: {names}{more}."
    if c.verdict == "no_change_shown":
        return "No significant change: the differences are within the noise."
    return "The arm has changed, but no single parameter is significant."


def changes_lines(c: Comparison) -> list[tuple[str, str]]:
    """Displacement, chance, what was compared, what to do."""
    rms, most, noise = _moved(c)
    lines = [
        (
            "Tool",
            f"Moved by {rms} rms for the same commands, {most} at most, at {len(c.distance)} "
            f"random poses within the joint limits {_under(c)}; noise alone gives {noise} rms.",
        ),
        (
            "Chance",
            f"All {len(c.changes)} parameters together: {size_of(c.p)}. Each alone by Holm's rule: "
            f"if nothing has changed, the probability of any finding is {c.level:g} at "
            "most.",
        ),
        (
            "Compared",
            "The arm itself. Base and markers are set up anew each time: a change that a motion of "
            "the base or the markers also explains is not seen.",
        ),
    ]
    if c.first_order:
        lines.append(
            (
                "Compared",
                "The sessions determined other parameters; the new ones are given in those of the "
                "old, to first order.",
            )
        )
    if c.one_result:
        return [
            *lines,
            ("Next", "Give the results of two sessions: this is one of them and its copy."),
        ]
    if c.verdict == "no_change_shown":
        told = "Nothing: the old calibration still holds within the noise of both sessions."
        return [*lines, ("Next", told)]
    return [
        *lines,
        ("Next", "Use the new calibration (elastocal compensate, elastocal export)."),
        (
            "Next",
            "Look for the cause at the joints and links named. A missing effect can look like a "
            "change if poses or loads differ (elastocal diagnose with the new data).",
        ),
    ]


def _under(c: Comparison) -> str:
    """Under which loads the tool was compared, and whose they are."""
    if len(c.forces) == 1:
        force = ", ".join(f"{v:g}" for v in c.forces[0])
        told = f"under ({force}) N"
    else:
        sizes = np.linalg.norm(c.forces, axis=1)
        told = f"under {len(c.forces)} loads in turn, {sizes.min():.4g} to {sizes.max():.4g} N"
    return f"{told}, {OF_LOADS[c.loads_of]}"


OF_LOADS = {
    "": "as no load is stated",
    "the option": "as asked for",
    "the earlier campaign": "those of the earlier session",
    "the later campaign": "those of the later session",
    "the cell's plan": "those of the cell's plan",
}


def _change_table(c: Comparison) -> ShownTable:
    """A row for each parameter, the changed first, then by their effect at the tool."""
    heads = ("parameter", "old", "new", "change", "± std", "unit", "p (Holm)", "moves the tool", "")
    rows = []
    for one in sorted(c.changes, key=lambda x: (not x.changed, -x.moves)):
        value, half, unit = estimate(one.change, one.std, one.unit)
        old, new = (estimate(v, one.std, one.unit)[0] for v in (one.old, one.new))
        told = "changed" if one.changed else ""
        with_others = f" (with {listed(one.combined_with, 3)})" if one.combined_with else ""
        rows.append(
            (printable(one.name + with_others), old, new, value, half, unit, p_value(one.p_family),
             length(one.moves), told)
        )  # fmt: skip
    note = (
        "± std: standard deviation of the difference, of both sessions together. p (Holm): chance "
        "of such a difference where nothing has changed, corrected for all parameters. Moves the "
        "tool: rms over the poses, by this change alone."
    )
    table = ShownTable(heads, rows, (0, 5, 8), title="Parameter by parameter", note=note)
    return table.when_narrow(1, 2)


def _moves(c: Comparison) -> Figure:
    """How far the tool moves by each change alone, the largest first."""
    from elastocal.report.figures import rows_of_dots

    most = sorted(c.changes, key=lambda change: -change.moves)[:MOST_DRAWN]
    rows = [(one.name, one.moves * 1e6, (np.nan, np.nan), length(one.moves)) for one in most]
    noise = ("all by noise alone", 1e6 * float(np.sqrt(np.mean(c.chance**2))))
    caption = "The largest changes by what each alone moves the tool, rms over the poses."
    title = "How far each change moves the tool"
    return rows_of_dots("moved", title, rows, "tool moved, rms", caption, noise, lengths=True)
