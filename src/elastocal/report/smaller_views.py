"""What a comparison, commands, readings, an export, an import and a certificate say, as blocks."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from string import Template
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import numpy as np

from elastocal import __version__
from elastocal.identification.prediction import measured_loads
from elastocal.identification.result import Calibration
from elastocal.identification.scrutiny import ErrorBudget, gap_budget, pose_accuracy
from elastocal.measurements import in_file_units, joint_columns, numbered
from elastocal.messages import InputError, listed, load_text, printable, rounded, some
from elastocal.model.chain import names_told
from elastocal.report import blocks as say
from elastocal.report import identification_view as fitted
from elastocal.report.figures import NO_ENDS, rows_of_dots
from elastocal.report.judgement_view import judgement, method_and_weights
from elastocal.units import Array

if TYPE_CHECKING:
    from elastocal.compensation import Compensation
    from elastocal.diagnosis.changes import Comparison
    from elastocal.export.export import Exported
    from elastocal.importing.assemble import Imported
    from elastocal.measurements import Measurements

MOST_NAMED = 3  # parameters in a headline
MOST_DRAWN = 20  # parameters
MOST_ROWS = 40  # drawn, and shown of tables


def changes_blocks(c: Comparison) -> Iterator[say.Block]:
    rms, noise = (say.length(float(np.sqrt(np.mean(v**2)))) for v in (c.distance, c.chance))
    most = say.length(float(c.distance.max()))
    yield say.Fold("", lambda: [say.KeyFigures(f"moved by {rms} (noise {noise})", [
        ("the tool has moved, rms", rms), ("at most", most), ("noise alone", noise),
        ("all parameters together", say.size_of(c.p)),
    ])])  # fmt: skip
    steps = [
        *["Use the new calibration (elastocal compensate, elastocal export)."] * (not c.new.doubt),
        ("Look for the cause at the joints and links named. " if c.changed else
         "Measure more poses to see which parameter has changed. ")
        + "A missing effect can look like a change if poses or loads differ (elastocal diagnose "
        "with the new data).",
    ]  # fmt: skip
    tone: say.Tone = "warn"
    mostly = dict.fromkeys((*c.old.by_prior, *c.new.by_prior))
    if c.one_result:
        verdict = (
            f"Nothing is compared: {printable(c.old.source)} and {printable(c.new.source)} are the "
            "same result, equal to the last digit."
        )
        steps = ["Give the results of two sessions: this is one of them and its copy."]
    elif c.verdict == "no_change_shown":
        tone, verdict = "good", "No significant change: the differences are within the noise."
        steps = [
            "Compare results without smooth functions and without knowledge: beside their priors a "
            "change of these parameters is hardly seen."
            if mostly
            else "Nothing: the old calibration still holds within the noise of both sessions."
        ]
    elif c.changed:
        names = some((printable(change.name) for change in c.changed), MOST_NAMED)
        verdict = f"The arm has changed: {names}."
    else:
        verdict = "The arm has changed, but no single parameter is significant."
    yield say.ShownVerdict(tone, verdict)
    loads = say.loads_text(c.forces, "{}", "{} loads in turn")
    yield say.Lines([
        ("Tool", f"Moved by {rms} rms for the same commands, {most} at most, at {len(c.distance)} "
         f"random poses within the joint limits under {loads}, {c.loads_of}; noise alone "
         f"gives {noise} rms."),
        ("Chance", f"All {len(c.changes)} parameters together: {say.size_of(c.p)}. Each alone by "
         "Holm's rule: if nothing has changed, the probability that one is named is "
         f"{c.level:g} at most."),
        ("Compared", "The arm itself. Base and markers are set up anew each time: a change that a "
         "motion of the base or the markers also explains is not seen."),
        ("Compared", "The sessions determined different parameters; what both show is compared, to "
         "first order." if c.first_order else None),
        ("Compared", "A change of what is determined mostly by a prior is hardly seen, and its "
         f"part of the noise is that of the prior: {some(mostly, 8)}." if mostly else None),
        *(("Not compared", printable(f"{some(names, 8)} ({why})."))
          for why, names in c.not_compared.items()),
        *(("Next", step) for step in steps),
        *((say.WARNING, say.sentence(printable(t))) for a in (c.old, c.new) for t in a.doubted),
    ])  # fmt: skip
    yield say.Fold("", lambda: [_moves(c)], figures=("moved",))
    yield _change_table(c)


def _change_table(c: Comparison) -> say.ShownTable:
    heads = ("parameter", "old", "new", "change", "± std", "unit", "p (Holm)", "moves the tool", "")
    rows = []
    for one in sorted(c.changes, key=lambda x: (not x.changed, -x.moves)):
        value, half, unit = say.estimate(one.change, one.std, one.unit)
        old, new = (say.estimate(v, one.std, one.unit)[0] for v in (one.old, one.new))
        with_others = f" (with {listed(one.combined_with, 3)})" if one.combined_with else ""
        rows.append(
            (printable(one.name + with_others), old, new, value, half, unit,
             say.p_value(one.p_family), say.length(one.moves), "changed" * one.changed)
        )  # fmt: skip
    note = (
        "± std: standard deviation of the difference, of both sessions together. p (Holm): chance "
        "of such a difference where nothing has changed, corrected for all parameters. Moves the "
        "tool: rms over the poses, by this change alone."
    )
    if any(one.name not in c.old.values for one in c.changes):
        note += " Of smooth functions all numbers are such rms."
    table = say.ShownTable(heads, rows, (0, 5, 8), title="Parameter by parameter", note=note)
    short = table.without(1, 2)
    return replace(table, narrow=replace(short, narrow=short.without(4).when_narrow(2)))


def _moves(c: Comparison) -> say.Figure:
    most = sorted(c.changes, key=lambda change: -change.moves)[:MOST_DRAWN]
    rows = [(one.name, one.moves, NO_ENDS) for one in most]
    noise = ("all by noise alone", float(np.sqrt(np.mean(c.chance**2))))
    caption = "The largest changes by what each alone moves the tool, rms over the poses."
    title = "How far each change moves the tool"
    return rows_of_dots("moved", title, rows, "tool moved, rms", caption, noise)


def commands_blocks(c: Compensation) -> Iterator[say.Block]:
    from elastocal.compensation import summary

    table, kinds = c.targets.table, c.chain.kinds
    names = [table.configuration_labels[k] for k in table.configuration]
    axis = "error at the nominal command"
    reached = np.flatnonzero(c.reached)[:MOST_ROWS]
    dots = [(names[i], float(c.before[i]), NO_ENDS) for i in reached]
    q, std, rows = in_file_units(c.q, kinds), c.uncertainty.std * 1e6, []
    for i, status in enumerate(c.status[:MOST_ROWS]):
        numbers = [f"{v:.4f}" if np.isfinite(v) else "–" for v in q[i]]
        sure = f"{std[i]:.2f}" if np.isfinite(std[i]) else "–"
        rows.append((printable(names[i]), *numbers, sure, printable(status)))
    heads = ("configuration", *joint_columns(kinds), "std_um", "status")
    more = len(c.status) - len(rows)
    note = f"and {more} more in the file of commands" if more else ""
    commands = say.ShownTable(heads, rows, (0, len(heads) - 1), note=note)
    yield from compensation_blocks({"commands": summary(c, commands=False)})
    yield say.Fold(
        "", lambda: [rows_of_dots("errors", f"Targets: {axis}", dots, axis, told=False)],
        figures=("errors",),
    )  # fmt: skip
    yield say.Fold("Commands", lambda: [commands])


def compensation_blocks(content: dict[str, Any]) -> Iterator[say.Block]:
    """Of the summary of the `commands`, that of the correction `table`, or both."""
    commands, table = content.get("commands"), content.get("table")
    if commands is not None:
        rows = {
            "nominal command": commands["error_before_um"],
            "new command": commands["error_after_um"],
            "standard uncertainty of fitted parameters": commands["std_um"],
            "within, at 95 %": commands["within95_um"],
        }
        yield _spreads("Position of the tool, predicted", rows)
        yield say.Sentence(
            "Within counts possible model error and what the readings leave open as well."
        )
        if (turn := commands.get("std_rotation_urad", {}).get("rms")) is not None:
            yield say.Sentence(f"Standard uncertainty of the rotation: {rounded(turn)} µrad rms.")
        for k, command in enumerate(commands.get("commands", ())):
            joints = ", ".join(f"{n} {v:.6f}" for n, v in command.items() if n != "status")
            yield say.Sentence(f"target {k + 1}: {joints or command['status']}")
        yield say.Sentence(
            f"{commands['reached']} of {commands['n']} targets reached by the {commands['point']}; "
            f"targets in the {commands['frame']} frame."
        )
        yield say.Lines([(say.WARNING, say.sentence(text)) for text in commands["warnings"]])
    if table is not None:
        rows = {"without the table": table["error_without_um"]}
        rows["with it, interpolated"] = table["error_with_um"]
        yield _spreads(
            f"Position of the tool at {table['checked_between']} points between grid points", rows
        )
        yield say.Sentence(
            f"{table['points']} grid points: {table['exact']} exact, {table['first_order']} of "
            "first order (beside singular postures or limits)."
        )
        if (std := table["std_um"]["rms"]) is not None:
            yield say.Sentence(
                f"Standard uncertainty of the tool at them: {say.length(std * 1e-6)} rms; within, "
                f"at 95 %: {say.length(table['within95_um']['rms'] * 1e-6)}."
            )
        yield say.Lines([(say.WARNING, say.sentence(text)) for text in table["warnings"]])


def _spreads(title: str, rows: dict[str, dict[str, Any]]) -> say.ShownTable:
    def shown(um: float | None) -> str:
        if um is None:
            return "–"
        return "< 0.01 µm" if um < 0.01 else say.length(um * 1e-6)

    cells = [(name, *map(shown, values.values())) for name, values in rows.items()]
    return say.ShownTable(("", "rms", "95 %", "max"), cells, title=title)


def readings_blocks(table: Measurements) -> Iterator[say.Block]:
    rows = [
        (printable(name), str(len(np.unique(values.astype(str)))), "", "")
        if values.dtype == object
        else (name, str(len(np.unique(values))), f"{values.min():.6g}", f"{values.max():.6g}")
        for name, values in table.columns().items() if len(values)
    ]  # fmt: skip
    heads = ("column", "different", "least", "largest")
    yield say.ShownTable(heads, rows, title=f"{len(table)} rows of {printable(table.source)}")
    q = in_file_units(table.q, table.kinds)
    ends = [(float(v.min()), float(v.max())) if len(v) else (0.0, 0.0) for v in q.T]
    dots = [
        (name, (a + b) / 2, (a, b))
        for name, (a, b) in zip(joint_columns(table.kinds), ends, strict=True)
    ]
    axis, title = "middle and ends of the values, in ° or mm", "Where each joint stood"
    yield say.Fold(
        "", lambda: [rows_of_dots("joints", title, dots, axis, lengths=False)], figures=("joints",)
    )


WORTH_TELLING = 10e-6  # m, as for what compensate leaves open
# At the start of a sentence and in a title.
FORMATS = {
    "urdf": ("The URDF", "a URDF"),
    "mjcf": ("The MJCF", "this MJCF"),
    **dict.fromkeys(("dh", "mdh"), ("The DH table", "a DH table")),
    **dict.fromkeys(("yaml", "json", "corrections"), ("Geometry alone", "geometry alone")),
}


def export_blocks(done: Exported) -> Iterator[say.Block]:
    from elastocal.export.export import base_told

    def rounding(metres: float) -> str:  # what is below a nanometre is no number to read
        return "< 0.001 µm" if metres < 1e-9 else say.length(metres)

    cost, (name, in_title), refit = done.cost, FORMATS[done.format], done.refit
    if cost.effects:
        every = [(e.effect.replace("_", " "), e.difference, e.note) for e in cost.effects]
        rows = []
        for effect, d, note in [*every, ("all of it", cost.total, "")]:
            sizes = () if d is None else (d.marker_rms, d.marker_max, d.flange_rms, d.flange_max)
            rows.append((effect, *([say.length(size) for size in sizes] or [""] * 4), note))
        heads = ("effect", "markers rms", "max", "flange rms", "max", "")
        yield say.ShownTable(heads, rows, (0, 5), title=f"What {in_title} cannot hold")
        yield say.Sentence(
            f"Costs: differences from the calibrated model at {cost.poses} random poses within the "
            f"joint {'ranges measured' if cost.measured else 'limits'} under "
            f"{say.loads_text(cost.forces, 'a load of {}', 'the {} loads measured')}, each effect "
            "left out alone."
        )
    else:
        yield say.Sentence(f"{name} holds all of the calibrated model.")
    if refit is not None:
        told = f"the markers are {say.length(refit.after)} rms off"
        if refit.correction is not None:
            told += f", with its joint correction {say.length(refit.correction)}"
        how = "Values as identified; no refit is better"
        if refit.taken:
            how = f"Refitted to the calibrated arm at {refit.visits} measured visits"
            told += f", with the values identified {say.length(refit.before)}"
        worse = "" if refit.after < refit.nominal else "; it is worse than the nominal file"
        told += f", the nominal file with base and tool placed {say.length(refit.nominal)}{worse}"
        yield say.Sentence(f"{how}: {told}.")
        if refit.taken:
            there = ", which the file has" if done.framed else ": place it there"
            yield say.Sentence(f"The file is fitted {base_told(done.T_tracker_base)}{there}.")
    if done.checked is not None:
        yield say.Sentence(f"Read back with {done.checked_with}: {rounding(done.checked)} at most.")
    if done.without_beta is not None:
        yield say.Sentence(f"Without the column beta_rad: {rounding(done.without_beta)} at most.")
    if names := done.undetermined:
        told = "Not determined by the data, at the values that identify predicts with"
        yield say.Sentence(f"{told}: {some(map(printable, names), 8)}.")
    if n := len(done.held) - len(done.undetermined):
        yield say.Sentence(
            f"{say.counted(n, 'parameter')} without a value alone: known in combinations, or not "
            "identifiable at any pose under these loads (expected)."
        )
    if done.by_prior:
        yield say.Sentence(f"Determined mostly by a prior: {some(done.by_prior, 8)}.")
    if done.of_the_measurement:
        left = ", ".join(done.of_the_measurement)
        yield say.Sentence(f"Left out, effects of the measurement: {left}.")
    for warning in done.warnings:
        yield say.Sentence(f"Note: {warning}.")
    if cost.total.marker_rms > WORTH_TELLING:
        yield say.Sentence(
            "Next: if that matters, elastocal compensate corrects it with the same cell and result."
        )


FIRST_ROWS = 5
MOST_COLUMNS = 14  # of the first rows, on a wide terminal
ROLES = {"points": "points", "joints": "joint values", "both": "points and joint values"}


def left_out(found: Imported) -> Iterator[str]:
    for observed in found.understood:
        if n := len({line for line, _ in observed["ignored"]}):
            rows = listed((f"line {line} ({reason})" for line, reason in observed["ignored"]), 8)
            yield f"{observed['file']}: passed over in {say.counted(n, 'line')}: {rows}"
    if (joined := found.joined) is not None:
        for told, names in (("left out, without joint values: %d points", joined.left_out),
                            ("poses without a point: %d", joined.unused)):  # fmt: skip
            yield from [f"{told % len(names)}: {listed(names, 12)}"] * bool(names)


def import_blocks(found: Imported, width: int) -> Iterator[say.Block]:
    for seen in found.understood:
        preset = f"preset {seen['preset']}, " if seen["preset"] else ""
        decimals = ", decimal commas" if seen["decimal"] == "," else ""
        yield say.Heading(
            f"{seen['file']}: {say.counted(seen['rows'], 'row')} of {ROLES[seen['role']]} "
            f"({preset}{seen['encoding']}, {seen['layout']}{decimals})"
        )
        rows = [(each["from"], each["to"], each["unit"] or "–") for each in seen["columns"]]
        yield say.ShownTable(("in the file", "read as", "unit"), rows, (0, 1, 2))
        yield say.Lines([("Not used", listed(seen["unused"], 20))])
    columns = found.columns
    first = range(min(FIRST_ROWS, len(found.table)))
    every = {n: [_cell(columns[n], i) for i in first] for n in columns if n != "note_source"}
    # Whole columns, two blanks apart: a head is not broken.
    ends = np.cumsum([max(map(len, (n, *texts))) + 2 for n, texts in every.items()])
    shown = list(every)[: max(1, min(MOST_COLUMNS, int((ends <= width).sum())))]
    rest = len(columns) - len(shown)
    words = tuple(k for k, n in enumerate(shown) if not isinstance(columns[n], np.ndarray))
    cells = [tuple(every[n][i] for n in shown) for i in first]
    title = "The first rows of the table" + f", {say.counted(rest, 'more column')}" * bool(rest)
    yield say.ShownTable(tuple(shown), cells, words, title=title)
    ranges = [
        (name, f"{values.min():.6g}", f"{values.max():.6g}")
        for name, values in columns.items()
        if isinstance(values, np.ndarray) and name != "repeat"
    ]
    yield say.ShownTable(("column", "least", "largest"), ranges, title="Ranges")
    yield say.Lines([
        *_counts(found),
        *(("Left out", text) for text in left_out(found)),
        *((say.WARNING, say.sentence(text)) for text in found.warnings),
    ])  # fmt: skip


def _cell(values: Sequence[str] | np.ndarray, i: int) -> str:
    if not isinstance(values, np.ndarray):
        return printable(values[i])
    return f"{values[i]:d}" if values.dtype.kind == "i" else f"{values[i]:.6g}"


def _counts(found: Imported) -> Iterator[tuple[str, str]]:
    table, joined = found.table, found.joined
    repeats = np.bincount(numbered(table.configuration, table.marker, *table.force.T))
    span = " to ".join(dict.fromkeys((str(repeats.min()), str(repeats.max()))))
    poses = say.counted(len(table.configuration_labels), "configuration")
    yield (
        "Table",
        f"{say.counted(len(table), 'reading')} of {poses}, {span} per configuration, marker and "
        "load",
    )
    yield "Markers", listed(table.markers_read, 20)
    forces, sizes = np.unique(table.force, axis=0, return_counts=True)
    loads = [
        f"{load_text(force)}: {say.counted(int(n), 'reading')}"
        for force, n in zip(forces, sizes, strict=True)
    ]
    yield "Loads", some(loads, 8, "; ", "; {} more")
    if joined is not None:
        yield "Joined", "; ".join([f"by {joined.how}", *joined.remarks])
    if table.time is not None:
        yield "Time", f"{table.time.max():.6g} s from the first reading to the last"
    if found.fit is not None:
        error = say.length(found.fit.error)
        yield "Nominal arm", f"readings fit it to {error} (median, base and markers fitted)"


# The calibration certificate: what was calibrated, by whom and by what, and how far off it is.
#
# The entries of ISO/IEC 17025 (7.8.2) come from [certificate] of the cell; without them the
# document is called a report.  Uncertainty as the GUM has it (JCGM 100), conformity by ISO 14253-1,
# accuracy and repeatability of poses by ISO 9283.  As XML it is a digital one: DCC 3.2.1 of PTB,
# quantities by D-SI (schema: https://gitlab.com/ptb/dcc/xsd-dcc), filled into the `dcc.xml` beside
# this module.

K = 2.0  # coverage factor: about 95 % of a normal distribution
FEWEST = 3  # readings of one place from which on a repeatability is told


def certificate_blocks(result: Calibration) -> Iterator[say.Block]:
    entries, budget = result.model.cell.certificate, gap_budget(result)
    certified = Certified(result, budget)
    yield judgement(result)
    degrees, own = entries.temperature, entries.instrument_uncertainty
    told = say.Lines([
        *((name.replace("_", " "), printable(value))
          for name, value in vars(entries).items() if isinstance(value, str)),
        ("temperature", None if degrees is None else f"{degrees:g} °C"),
        ("instrument's expanded uncertainty, k = 2", None if own is None else say.length(own)),
    ]).items  # fmt: skip
    yield say.ShownTable(("entry", ""), told, (0, 1), title="Entries")
    if told and entries.missing:
        yield say.Sentence(
            f"Not a certificate: [certificate] of the cell lacks {listed(entries.missing)}.",
            soft=True,
        )
    if entries.limit is not None:
        yield say.Heading("Statement of conformity")
        yield say.Sentence(certified.conformity(entries.limit))
    yield from _uncertainty(certified)
    yield from _poses(result, budget)
    stated = result.model.cell.tracker.noise
    noise = "none stated" if result.observations.table.sigma is None else "stated with each reading"
    if stated is not None:
        # The numbers of three axes, or the one that all have.
        each = {name: dict.fromkeys(np.atleast_1d(v).tolist()) for name, v in vars(stated).items()}
        noise = ", ".join(
            f"{name.replace('_', ' ')} {', '.join(map(say.length, sizes))}"
            f"{' per m' * name.endswith('per_m')}"
            for name, sizes in each.items()
        )
    facts = say.Lines([
        ("Robot", printable(result.model.chain.name)),
        ("Joints", names_told(result.model.chain)),
        ("Instrument, standard deviations", noise),
        ("Readings", fitted.readings(result)),
        ("Loads", "; ".join(say.newtons(f) for f in measured_loads(result.observations))),
        ("Identified", fitted.what_was_identified(result)),
        ("Method", say.sentence(method_and_weights(result))),
        ("Expected error", fitted.at_new_poses(result.predicted)),
        ("Prediction", fitted.prediction_line(result)),
    ]).items  # fmt: skip
    yield say.ShownTable(("what", ""), facts, (0, 1), title="What was calibrated, and by what")


class Certified:
    """What the certificate and its XML state, lengths in m.

    `sources`: standard uncertainty of a coordinate by source (name, GUM's type, u), of the distance
    where distances were read; their root sum of squares is that of what the calibrated model
    predicts against one reading.  `coordinates`: how many a reading has, 3 or 1.  `error`: the
    largest distance between places meant and read, of `places` that were not fitted; or NaN.
    """

    def __init__(self, result: Calibration, budget: ErrorBudget | None) -> None:
        parts, own = result.uncertainty(), result.model.cell.certificate.instrument_uncertainty
        self.coordinates = 1 if result.observations.kind == "distance" else 3
        self.sources = [
            (name, kind, getattr(parts, key) / math.sqrt(self.coordinates))
            for key, (name, kind) in ({} if parts is None else PARTS).items()
        ]
        if own is not None:
            self.sources.append((INSTRUMENT, "B", own / K))
        # Of reading and instrument alone, since the arm's own errors are what is measured.
        alone = [u for name, _, u in self.sources if name in (READING, INSTRUMENT)]
        self.of_deviations = K * math.sqrt(self.coordinates * sum(u**2 for u in alone))
        self.error, self.places = math.nan, "each place left out of the fit"
        if result.test is not None and len(result.test.errors):
            self.error, self.places = float(result.test.errors.max()), "test data"
        elif budget is not None:
            apart = pose_accuracy(result.observations, budget.steps[-1].errors)
            self.error = float(apart.max())

    def conformity(self, limit: float) -> str:
        """The decision by ISO 14253-1, with a guard band of one expanded uncertainty."""
        what, guard = "position" if self.coordinates == 3 else "distance", self.of_deviations
        if math.isnan(self.error):
            return f"No statement: no {what} error was measured at places that were not fitted."
        text = "No statement: the limit lies within the guard band of the error"
        if self.error + guard <= limit:
            text = "Conforms: the error and its guard band are within the limit"
        elif self.error - guard > limit:
            text = "Does not conform: the error exceeds the limit by more than its guard band"
        return (
            f"{text}. Decision rule of ISO 14253-1: largest {what} error {say.length(self.error)} "
            f"({self.places}), limit {say.length(limit)}, guard band {say.length(guard)} (U, k = "
            "2, of a measured distance)."
        )


READING, INSTRUMENT = "reading", "calibration of the instrument"
# Parts of the error of a predicted reading, in the words of a certificate.
PARTS = {
    "instrument": (READING, "A"),
    "repeatability": ("repeatability of the arm", "A"),
    "parameters": ("model: estimated parameters", "A"),
    "lack_of_fit": ("model: lack of fit", "A"),
    "open_parameters": ("choice of parameters: those left open", "B"),
}


def pose_repeatability(result: Calibration) -> Array:
    """RP = l̄ + 3 S_l (places,) in m of the distances l of the readings of a place from their mean
    (ISO 9283), where there are enough."""
    observed = result.observations
    if observed.kind not in ("position", "pose"):
        return np.zeros(0)
    parts = result.residual.reshape(-1, observed.size)[:, :3]
    found = []
    for place in np.flatnonzero(np.bincount(observed.place) >= FEWEST):
        own = parts[observed.place == place]
        away = np.linalg.norm(own - own.mean(axis=0), axis=1)
        found.append(away.mean() + 3 * away.std(ddof=1))
    return np.array(found)


def _uncertainty(certified: Certified) -> Iterator[say.Block]:
    if not (sources := certified.sources):
        return
    square = sum(u**2 for *_, u in sources)
    rows = [
        (name, kind, say.length(u), f"{100 * u**2 / square if square else 0:.0f} %")
        for name, kind, u in sources
    ]
    rows.append(("combined", "", say.length(math.sqrt(square)), "100 %"))
    rows.append(("expanded, U with k = 2", "", say.length(K * math.sqrt(square)), ""))
    heads = ("source", "type", "standard uncertainty", "share of the variance")
    of_what = "coordinate of a position" if certified.coordinates == 3 else "distance"
    note = f"Of a {of_what} that the calibrated model predicts, against one reading (GUM, JCGM "
    note += "100). U covers about 95 %."
    if all(name != INSTRUMENT for name, *_ in sources):
        note += " Without the instrument's own calibration, which [certificate] does not state."
    yield say.ShownTable(heads, rows, (0, 1), title="Uncertainty", note=note)


def _poses(result: Calibration, budget: ErrorBudget | None) -> Iterator[say.Block]:
    if found := fitted.before_and_after(result, budget):
        apart = {name: pose_accuracy(result.observations, e) for name, e in found.items()}
        yield fitted.spread_table(apart, "places", "Pose accuracy before and after")
        yield say.Sentence(
            "In the sense of ISO 9283: the distance between the place that was meant and the mean "
            "of what was read there, at every configuration, marker and load. “Calibrated” is what "
            "the calibrated model predicts for a configuration that was left out of the fit; both "
            "include the instrument's noise, as far as repeats leave it in the mean. The poses are "
            "those of the measurement session, not the standard's five.",
            soft=True,
        )
    else:
        none = "no configuration can be left out of the fit"
        yield say.Sentence(f"Pose accuracy is not known: {none}.")
    if len(rp := pose_repeatability(result)):
        yield say.Sentence(
            f"Pose repeatability RP (ISO 9283): {say.length(float(rp.mean()))} in the mean of "
            f"{len(rp)} places read {FEWEST} times or more, {say.length(float(rp.max()))} at most; "
            "the instrument's noise is included."
        )


SI = {"m": "metre", "rad": "radian", "N": "newton", "kg": "kilogram", "s": "second", "K": "kelvin"}
NAMED = '<dcc:name><dcc:content lang="en">%s</dcc:content></dcc:name>'
QUANTITY = f"{NAMED}<dcc:data><dcc:quantity>{NAMED}%s</dcc:quantity></dcc:data>"
REAL = "<si:real><si:value>%.9g</si:value><si:unit>%s</si:unit>%s</si:real>"
COVERED = (
    "<si:measurementUncertaintyUnivariate><si:expandedMU>"
    "<si:valueExpandedMU>%.3g</si:valueExpandedMU><si:coverageFactor>%g</si:coverageFactor>"
    "<si:coverageProbability>0.95</si:coverageProbability><si:distribution>normal</si:distribution>"
    "</si:expandedMU></si:measurementUncertaintyUnivariate>"
)


def dcc_text(result: Calibration) -> str:
    c, name = result.model.cell.certificate, result.model.chain.name
    if c.missing:
        raise InputError(
            "a digital calibration certificate needs [certificate] in the cell with "
            f"{listed(c.missing)}; without them write the report as .html"
        )
    certified = Certified(result, gap_budget(result))
    statement, u = judgement(result).sentence, certified.of_deviations
    if c.limit is not None:
        statement = f"{certified.conformity(c.limit)} {statement}"
    found = [
        ("root mean square position error at poses not fitted", result.heldout_rms, "m", u),
        ("largest position error at places not fitted", certified.error, "m", u),
        *((e.name, e.value, e.unit, K * e.std)
          for e in result.ordinary if e.value is not None and e.std is not None),
    ]  # fmt: skip
    results = [
        f"<dcc:result>{_quantity(name, value, _unit(unit), expanded)}</dcc:result>"
        for name, value, unit, expanded in found
    ]
    told = {
        **vars(c), "version": __version__, "robot": name, "statement": statement,
        "location": "customer" if c.place == c.customer else "other",
    }  # fmt: skip
    text = Template(say.resource("dcc.xml")).substitute(
        {key: _xml("" if value is None else str(value)) for key, value in told.items()},
        ambient=_quantity("temperature", c.temperature, "\\degreecelsius"),
        results="".join(results),
    )
    for prefix in ("dcc", "si"):
        ElementTree.register_namespace(prefix, f"https://ptb.de/{prefix}")
    root = ElementTree.fromstring(text)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _unit(unit: str) -> str:
    """As D-SI has it: "rad/(N*m)^3" → \\radian\\newton\\tothe{-3}\\metre\\tothe{-3}."""
    over, _, under = unit.partition("/")
    power = f"\\tothe{{-{under.partition('^')[2] or 1}}}"
    found = [(SI.get(name), "") for name in over.split("*") if name != "1"]
    found += [(SI.get(name), power) for name in re.findall("[A-Za-z]+", under)]
    known = found and all(name for name, _ in found)
    return "".join(f"\\{name}{power}" for name, power in found) if known else "\\one"


def _xml(text: str) -> str:
    return escape(printable(text))


def _quantity(name: str, value: float | None, unit: str, expanded: float | None = None) -> str:
    what, name = "<dcc:noQuantity/>", _xml(name)
    if value is not None and math.isfinite(value):
        what = REAL % (value, unit, "" if expanded is None else COVERED % (expanded, K))
    return QUANTITY % (name, name, what)
