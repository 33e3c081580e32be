"""Groups of readings that are wrong together, in words: marker, configuration, run of lines."""

from __future__ import annotations

import math
from statistics import median

from elastocal.identification.result import Calibration
from elastocal.identification.robust.report import Finding
from elastocal.report.method import method_of
from elastocal.report.units import length, significant
from elastocal.report.words import printable

MOST_TOLD = 3  # in the terminal's summary
FULL_WEIGHT = ("reml", "ols", "wls", "eq14")  # methods that let far readings bend the fit
PLACE = {
    "block": "Block of lines {}",
    "marker": "Marker {}",
    "configuration": "Configuration {}",
}


def fault_lines(result: Calibration, most: int | None = None) -> list[str]:
    """A sentence per group of readings beyond the noise, the largest first; of more, how many."""
    report = result.faulty_report
    groups = [] if report is None else [f for f in report.findings if f.level != "reading"]
    lines = [_sentence(result, finding) for finding in groups[:most]]
    more = len(groups) - len(lines)
    return [*lines, f"And {more} more."] if more else lines


def false_alarm_line(result: Calibration) -> str | None:
    """How often the search would accuse readings of a table in which nothing is wrong."""
    report = result.faulty_report
    if report is None or not fault_lines(result):
        return None
    share = 100 * report.false_alarm
    return f"Of tables in which nothing is wrong, at most {share:g} % would yield any finding."


def _sentence(result: Calibration, finding: Finding) -> str:
    n, beyond = len(finding.lines), finding.beyond
    how = "err in common by" if finding.pattern == "common" else "scatter by"
    size, noise = _metres(result, finding), f"{significant(finding.sigmas, 2)} times the noise"
    text = f"{PLACE[finding.level].format(printable(finding.name))}: {n} readings {how} "
    text += noise if size is None else f"{length(size)} ({noise})"
    if beyond < n:
        text += f", {beyond or 'none'} of them beyond the noise alone"
    return f"{text}{_influence(result, finding)}."


def _metres(result: Calibration, finding: Finding) -> float | None:
    """Typical error in m, None where most of the readings are not listed one by one.

    The median where they err in common, which those that do not leave alone; else the rms.  Where
    they bend the fit, the listed errors are smaller than those found.  Of a pose the list has the
    position's error only, and the finding may be one of rotation.
    """
    if result.observations.kind == "pose" or _bends(result, finding):
        return None
    lines = set(finding.lines)
    listed = [o.residual for o in result.faulty if o.line in lines]
    if not listed or 2 * len(listed) < len(lines):
        return None
    if finding.pattern == "common":
        return median(listed)
    return math.sqrt(sum(r * r for r in listed) / len(listed))


def _influence(result: Calibration, finding: Finding) -> str:
    """What they do, or would do if fitted along, to the parameter that they move most."""
    names = () if result.faulty_report is None else result.faulty_report.names
    name = printable(names[finding.column]) if names else "a parameter"
    if not math.isfinite(finding.influence):
        return f"; the other readings leave {name} undetermined"
    how = "in the fit they move" if _bends(result, finding) else "fitted along they would move"
    count = significant(finding.influence, 2)
    return f"; {how} {name} by {count} standard deviation{'' if count == '1.0' else 's'}"


def _bends(result: Calibration, finding: Finding) -> bool:
    """Whether the readings have their full weight in the fit."""
    apart = {o.line for o in result.excluded} & set(finding.lines)
    return method_of(result) in FULL_WEIGHT and not apart
