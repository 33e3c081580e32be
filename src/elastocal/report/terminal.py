"""Results as plain text and for the terminal: tables and lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from io import StringIO
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from elastocal.compensation.compensate import Compensation, summary
from elastocal.diagnosis.diagnosis import Diagnosis
from elastocal.identification.findings import ALONE
from elastocal.identification.result import Calibration, Combination, Estimate
from elastocal.planning.plan import Plan
from elastocal.report.diagnosis_view import (
    BUDGET_HEADS,
    CANDIDATE_HEADS,
    PAIR_HEADS,
    PARAMETER_HEADS,
    UNTESTED_HEADS,
    Rows,
    added_parameter_rows,
    diagnosis_lines,
    diagnosis_steps,
    effect_at,
    gap_rows,
    hypothesis_rows,
    noise_floor_lines,
    pair_rows,
    untested_rows,
)
from elastocal.report.formatting import (
    ShownTable,
    capital,
    display,
    length,
    plain,
    printable,
    together,
)
from elastocal.report.identification_view import (
    Truth,
    any_lopsided,
    combination_truth,
    half_head,
    inside,
    judgement,
    names_of,
    nominal_known,
    short_note,
    shortened,
    signed_half,
    summary_lines,
    texts,
    undetermined_lines,
)
from elastocal.report.method_and_noise import candidate_rows, size_rows
from elastocal.report.plan_view import curve_rows, interval_rows, plan_lines, pose_rows, reason_rows

PRINTED_WIDTH = 100  # columns of a result as plain text


def identification_text(result: Calibration) -> str:
    """What `print` shows of an identification: parameters with their intervals, and what holds."""
    return _plain_text(lambda console: print_result(console, result))


def plan_text(plan: Plan) -> str:
    """What `print` shows of a plan: its poses, what it promises, how far from the best it is."""
    return _plain_text(lambda console: print_plan(console, plan))


def diagnosis_text(d: Diagnosis) -> str:
    """What `print` shows of a diagnosis: the verdict, the gap budget, the candidates."""
    base = d.calibrated
    joints = len(d.noise.repeatability)
    kinds = ("revolute",) * joints if base is None else base.model.chain.kinds
    return _plain_text(lambda console: print_diagnosis(console, d, kinds))


def compensation_text(c: Compensation) -> str:
    """What `print` shows of commands: errors before and after, and what could not be reached."""
    content = {"commands": summary(c, c.chain.kinds, commands=False)}
    return _plain_text(lambda console: print_compensation(console, content))


def _plain_text(printed: Callable[[Console], None]) -> str:
    """What is printed, without colours and trailing blanks."""
    console = Console(file=StringIO(), width=PRINTED_WIDTH, color_system=None, highlight=False)
    with console.capture() as capture:
        printed(console)
    return "\n".join(line.rstrip() for line in capture.get().rstrip().splitlines())


def titled(title: str) -> Table:
    """An empty table under a title, with a rule below its heads and no frame."""
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
    )


NARROW = 80  # columns; below, each number shares one column with its interval and unit
WIDE = 110  # columns; from here on a note fits beside the numbers
FEW = 6  # parameters without a number of their own, which the table then lists one by one
STYLE = {"inside": "green", "outside": "bold red"}


def parameter_table(
    result: Calibration,
    truth: Truth | None = None,
    undetermined: bool = True,
    brief: bool = False,
) -> Table:
    """Parameters with 95 % half widths; "–" and a note for what the data do not determine.

    Where an interval is lopsided or has no end, the ends stand instead of the half width.

    `truth` (SI) adds true values and whether the interval holds them.  `undetermined` False
    leaves out parameters that have no number of their own.  `brief` is for narrow terminals:
    value, interval and unit in one column, neither nominal nor true value.
    """
    notes = undetermined or any(e.note for e in result.estimates if e.identifiable)
    lopsided = any_lopsided(result.estimates)
    table = _table("Parameters", "parameter", truth, brief, lopsided)
    if not brief:
        table.add_column("nominal", justify="right", overflow="fold")
    if notes:
        table.add_column("note", overflow="fold")
    for e in result.estimates:
        if not (e.identifiable or undetermined):
            continue
        true = None if truth is None else truth.get(e.name)
        row = [Text(printable(e.name))]
        row += _numbers(e, true, truth is not None, brief, lopsided)
        if not brief:
            known = nominal_known(result, e.name)
            row.append(Text(plain(display(e.nominal, e.unit)[0]) if known else "–"))
        if notes:
            row.append(Text(short_note(result, e), style="dim"))
        table.add_row(*row)
    return table


def combination_table(
    result: Calibration, truth: Truth | None = None, brief: bool = False
) -> Table:
    """Sums of parameters that the data determine although their members they do not."""
    lopsided = any_lopsided(result.combinations)
    table = _table("Combinations (factors in SI units)", "combination", truth, brief, lopsided)
    for c in result.combinations:
        true = None if truth is None else combination_truth(result, c, truth)
        numbers = _numbers(c, true, truth is not None, brief, lopsided)
        table.add_row(Text(shortened(c)), *numbers)
    return table


def noise_tables(result: Calibration) -> list[Table]:
    """Sizes of the estimated noise, and the noise models tried with their criterion over the best.

    A table that would have a single row is left out: the summary says it.
    """
    tables = []
    if len(sizes := size_rows(result.noise)) > 1:
        table = _plain("Noise, standard deviations", "part")
        table.add_column("size", justify="right", overflow="fold")
        for row in sizes:
            table.add_row(*map(Text, row))
        tables.append(table)
    if len(candidates := candidate_rows(result.noise)) > 1:
        table = _plain("Noise models tried", "noise model")
        table.add_column("variances", justify="right", overflow="fold")
        table.add_column("criterion over best", justify="right", overflow="fold")
        for candidate in candidates:
            table.add_row(*map(Text, candidate))
        tables.append(table)
    return tables


def print_result(console: Console, result: Calibration, truth: Truth | None = None) -> None:
    """Single estimates, combinations, what is not determined, and the summary in words."""
    brief = console.width < NARROW
    alone = len(names_of(result, ALONE))
    listed = console.width >= WIDE and 0 < len(result.estimates) - alone <= FEW
    if alone or listed:
        console.print(parameter_table(result, truth, listed, brief))
    if result.combinations:
        console.print(combination_table(result, truth, brief))
    for line in undetermined_lines(result):
        console.print(Text(line, style="dim"))
    for table in noise_tables(result):
        console.print(table)
    console.print()
    for line in summary_lines(result, truth):
        label, colon, rest = line.partition(": ")
        style = "bold yellow" if label == "Warning" else "bold"
        console.print(Text.assemble((label + colon, style), rest))
    judged = judgement(result)
    console.print(Text.assemble(("Verdict: ", "bold"), printable(judged.headline)))
    for step in judged.steps:
        console.print(Text.assemble(("Next: ", "bold"), printable(step)))


def _table(title: str, first: str, truth: Truth | None, brief: bool, lopsided: bool) -> Table:
    table = _plain(title, first)
    if brief:
        table.add_column(f"value {half_head(lopsided)}", overflow="fold")
    else:
        for name in ("value", half_head(lopsided)):
            table.add_column(name, justify="right", overflow="fold")
        table.add_column("unit", overflow="fold")
    if truth is not None:
        if not brief:
            table.add_column("truth", justify="right", overflow="fold")
        table.add_column("in 95 %", overflow="fold")
    return table


def _plain(title: str, first: str) -> Table:
    table = titled(title)
    table.add_column(first, overflow="fold")
    return table


def _numbers(
    e: Estimate | Combination, true: float | None, compared: bool, brief: bool, lopsided: bool
) -> list[Text]:
    """Cells of value, interval and unit and, where `compared`, true value and verdict.

    `lopsided` says whether the column's head has no "±", which then stands with the number.
    """
    value, half, unit, known = texts(e, true)
    verdict = inside(true, e.ci95)
    tail = [Text(verdict, style=STYLE.get(verdict, ""))] if compared else []
    if brief:
        text = value if e.value is None else f"{value} {signed_half(half)} {unit}"
        return [Text(text), *tail]
    half = signed_half(half) if lopsided else half
    return [Text(value), Text(half), Text(unit), *([Text(known), *tail] if compared else [])]


WIDE_FOR_REASONS = 110  # columns, from which on the reasons stand beside the poses


def print_plan(console: Console, plan: Plan) -> None:
    """Poses in the order of the plan, predicted intervals, and what the plan is worth in words."""
    wide = console.width >= WIDE_FOR_REASONS
    console.print(pose_table(plan) if wide else _narrow_poses(console, plan))
    if not wide:
        console.print(reason_table(plan))
    console.print(interval_table(plan))
    if plan.curve:
        console.print(curve_table(plan))
    console.print()
    for label, text in plan_lines(plan):
        style = "bold yellow" if label == "Warning" else "bold"
        console.print(Text.assemble((f"{label}: ", style), text))


def _narrow_poses(console: Console, plan: Plan) -> Table:
    """The poses with as many decimals as there is room for; plan.csv has all of them."""
    room = console.options.update(max_width=WIDE_FOR_REASONS)
    for decimals in (2, 1):
        table = pose_table(plan, reasons=False, decimals=decimals)
        if console.measure(table, options=room).maximum <= console.width:
            return table
    return pose_table(plan, reasons=False, decimals=0)


def pose_table(plan: Plan, reasons: bool = True, decimals: int = 2) -> Table:
    """Joint values, load, place in the order of execution, and what the pose is there for."""
    return _printed("Poses", pose_rows(plan, reasons, decimals))


def reason_table(plan: Plan) -> Table:
    """What each pose is there for."""
    return _printed("Why each pose", reason_rows(plan))


def interval_table(plan: Plan) -> Table:
    """Predicted half widths of the 95 % intervals."""
    return _printed("Predicted intervals", interval_rows(plan))


def curve_table(plan: Plan) -> Table:
    """The criterion against the number of poses."""
    return _printed("Number of poses", curve_rows(plan))


def _printed(title: str, table: ShownTable) -> Table:
    """For the terminal: joints and words may wrap, other numbers may not."""
    shown = titled(title)
    for k, head in enumerate(table.heads):
        wraps = (k in table.words and head != "unit") or head.startswith("q")
        shown.add_column(head, justify="left" if k in table.words else "right",
                         overflow="fold" if wraps else "ellipsis")  # fmt: skip
    for row in table.rows:
        shown.add_row(*map(Text, row))
    return shown


MOST_CANDIDATES_PRINTED = 8
NARROW_FOR_SETTINGS = 100  # columns; below, a candidate is told without its settings
WORDS = ("settings", "unit", "why", "record or measure")  # columns that are not numbers


def print_diagnosis(console: Console, d: Diagnosis, kinds: Sequence[str]) -> None:
    """The whole answer for an engineer; `kinds` of the joints ("revolute" or "prismatic")."""
    _print_lines(console, diagnosis_lines(d))
    console.print()
    console.print(
        _rows_table("Gap budget (3-D rms error on held-out poses)", BUDGET_HEADS, gap_rows(d))
    )
    if rows := added_parameter_rows(d.effects):
        console.print(_rows_table("Parameters of the effects found", PARAMETER_HEADS, rows))
    rows = hypothesis_rows(d, MOST_CANDIDATES_PRINTED)
    heads = (
        CANDIDATE_HEADS
        if console.width >= NARROW_FOR_SETTINGS and any(r[-1] for r in rows)
        else CANDIDATE_HEADS[:-1]
    )
    title = f"Candidates, the best {len(rows) - 2} of {len(d.candidates)}"
    console.print(_rows_table(title, heads, rows))
    console.print(
        Text(
            "evidence: log marginal likelihood over that of no further effect. d: standard "
            "deviations that the typical size moves the data; below 3 it hides in the noise. "
            "seen from: the size, in typical sizes, from which it would have been seen.",
            style="dim",
        )
    )
    if d.extra is not None and d.extra.pairs:
        console.print(_rows_table("Rivals", PAIR_HEADS, pair_rows(d.extra)))
    if d.untested:
        console.print(_rows_table("Not tested", UNTESTED_HEADS, untested_rows(d)))
    console.print()
    _print_lines(console, [("Alike here", text) for text in _alike(d)])
    _print_lines(console, [("Noise", text) for text in noise_floor_lines(d.noise, kinds)])
    _print_lines(console, [("Next", text) for text in diagnosis_steps(d)])
    _print_lines(console, [("Warning", printable(text)) for text in d.warnings])


def _alike(d: Diagnosis) -> list[str]:
    """Sets that these data cannot tell apart."""
    sets = [together([effect_at(e) for e in rivals]) for rivals in d.indistinguishable]
    return [f"{text}: these data cannot tell them apart." for text in sets]


def _print_lines(console: Console, lines: Sequence[tuple[str, str]]) -> None:
    for label, text in lines:
        style = "bold yellow" if label == "Warning" else "bold"
        console.print(Text.assemble((f"{label}: ", style), capital(text)))


def _rows_table(title: str, heads: Sequence[str], rows: Rows) -> Table:
    """The first `heads` columns of the rows; numbers to the right."""
    table = titled(title)
    for k, head in enumerate(heads):
        words = k == 0 or head in WORDS
        table.add_column(head, justify="left" if words else "right", overflow="fold")
    for row in rows:
        table.add_row(*map(Text, row[: len(heads)]))
    return table


def print_compensation(console: Console, content: dict[str, Any]) -> None:
    """Errors before and after, uncertainty and warnings.

    `content`: the summary of the `commands`, that of the correction `table`, or both.
    """
    commands, table = content.get("commands"), content.get("table")
    if commands is not None:
        rows = {
            "nominal command": commands["error_before_um"],
            "new command": commands["error_after_um"],
            "standard uncertainty": commands["std_um"],
        }
        _print_spreads(console, "Position of the tool, predicted", rows)
        for k, command in enumerate(commands.get("commands", ())):
            joints = ", ".join(f"{n} {v:.6f}" for n, v in command.items() if n != "status")
            console.print(f"target {k + 1}: {joints or command['status']}")
        console.print(
            f"{commands['reached']} of {commands['n']} targets reached by the {commands['point']}; "
            f"targets in the {commands['frame']} frame.",
            markup=False,  # a marker may be called [red]
        )
        for told in commands["warnings"]:
            console.print(f"Warning: {told}", markup=False)
    if table is not None:
        rows = {"without the table": table["error_without_um"]}
        rows["with it, interpolated"] = table["error_with_um"]
        title = f"Position of the tool at {table['checked_between']} points between the grid's"
        _print_spreads(console, title, rows)
        console.print(
            f"{table['points']} grid points: {table['exact']} exact, {table['first_order']} of "
            "first order (beside singular postures or limits)."
        )


def _fine_length(um: float) -> str:
    return "< 0.01 µm" if um < 0.01 else length(um * 1e-6)


def _print_spreads(console: Console, title: str, rows: dict[str, dict[str, Any]]) -> None:
    shown = titled(title)
    shown.add_column("")
    for head in ("rms", "95 %", "max"):
        shown.add_column(head, justify="right")
    for name, values in rows.items():
        shown.add_row(name, *("–" if v is None else _fine_length(v) for v in values.values()))
    console.print(shown)
