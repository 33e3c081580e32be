"""The calibration certificate: what was calibrated, by whom and by what, and how far off it is.

The entries of ISO/IEC 17025 (7.8.2) come from [certificate] of the cell; without them the document
is called a report.  Uncertainty as the GUM has it (JCGM 100), conformity by ISO 14253-1, accuracy
and repeatability of poses by ISO 9283.  As XML it is a digital one: DCC 3.2.1 of PTB, quantities by
D-SI (schema: https://gitlab.com/ptb/dcc/xsd-dcc), filled into the `dcc.xml` beside this module.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from string import Template
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import numpy as np

from elastocal import __version__
from elastocal.errors import InputError
from elastocal.identification.error_budget import ErrorBudget, gap_budget, pose_accuracy
from elastocal.identification.prediction import measured_loads
from elastocal.identification.result import Calibration
from elastocal.report.blocks import Block, Heading, Report, Sentence, ShownTable, ShownVerdict
from elastocal.report.formatting import length, newtons, resource, sentence, title_of
from elastocal.report.identification_view import (
    at_new_poses,
    before_and_after,
    joint_lines,
    prediction_lines,
    readings,
    spread_table,
    what_was_identified,
)
from elastocal.report.judgement_view import judgement, method_and_weights
from elastocal.text import listed, printable
from elastocal.units import Array

K = 2.0  # coverage factor: about 95 % of a normal distribution
FEWEST = 3  # readings of one place from which on a repeatability is told
SIDES = math.sqrt(3.0)  # a 3-D rms over that of one coordinate


def certificate_report(result: Calibration) -> Report:
    """A page to print and file: entries, verdict, conformity, uncertainty, pose accuracy."""
    cell = result.model.cell
    kind = "Calibration report" if cell.certificate.missing else "Calibration certificate"
    title = title_of(result.model.chain.name, cell.name)
    return Report(kind, title, _blocks(result), result.model.backend_report(), filed=True)


def _blocks(result: Calibration) -> Iterator[Block]:
    entries, budget = result.model.cell.certificate, gap_budget(result)
    verdict, certified = judgement(result), certified_values(result, budget)
    yield ShownVerdict(verdict.tone, verdict.headline)
    told = [
        (name.replace("_", " "), printable(value))
        for name, value in vars(entries).items() if isinstance(value, str)
    ]  # fmt: skip
    if entries.temperature is not None:
        told.append(("temperature", f"{entries.temperature:g} °C"))
    if (own := entries.instrument_uncertainty) is not None:
        told.append(("instrument's expanded uncertainty, k = 2", length(own)))
    yield ShownTable(("entry", ""), told, (0, 1), title="Entries")
    if told and entries.missing:
        yield Sentence(
            f"Not a certificate: [certificate] of the cell lacks {listed(entries.missing)}.",
            soft=True,
        )
    if entries.limit is not None:
        yield Heading("Statement of conformity")
        yield Sentence(certified.conformity(entries.limit))
    yield from _uncertainty(certified)
    yield from _poses(result, budget, certified)
    stated = result.model.cell.tracker.noise
    noise = "none stated" if result.observations.table.sigma is None else "stated with each reading"
    if stated is not None:
        noise = ", ".join(
            f"{name.replace('_', ' ')} {', '.join(map(length, _each(value)))}"
            + (" per m" if name.endswith("per_m") else "")
            for name, value in vars(stated).items()
        )
    facts = [
        ("Robot", printable(result.model.chain.name)),
        *joint_lines(result),
        ("Instrument, standard deviations", noise),
        ("Readings", readings(result)),
        ("Loads", "; ".join(newtons(f) for f in measured_loads(result.observations))),
        ("Identified", what_was_identified(result)),
        ("Method", sentence(method_and_weights(result))),
        *([("Expected error", at_new_poses(result.predicted))] if result.predicted else []),
        *prediction_lines(result),
    ]
    yield ShownTable(("what", ""), facts, (0, 1), title="What was calibrated, and by what")


def _each(value: float | Array) -> list[float]:
    """A number, the numbers of three axes, or the one that all have."""
    return [float(v) for v in dict.fromkeys(np.atleast_1d(value).tolist())]


@dataclass(frozen=True)
class Certified:
    """What the certificate and its XML state, lengths in m.

    `sources`: standard uncertainty of a coordinate by source (name, GUM's type, u); their root sum
    of squares is that of a position predicted by the calibrated model against one reading.
    `error`: the largest distance between places meant and read, of `places` that were not fitted.
    `repeatability`: RP of the places read often enough.
    """

    sources: tuple[tuple[str, str, float], ...]
    error: float | None
    places: str
    repeatability: Array

    @property
    def expanded(self) -> float:
        """U = k·√(Σ u²) of a coordinate."""
        return K * math.sqrt(sum(u**2 for *_, u in self.sources))

    @property
    def of_deviations(self) -> float:
        """Expanded uncertainty of a measured distance: of reading and instrument alone, since the
        arm's own errors are what is measured."""
        own = [u for name, _, u in self.sources if name in (READING, INSTRUMENT)]
        return K * SIDES * math.sqrt(sum(u**2 for u in own))

    def conformity(self, limit: float) -> str:
        """The decision by ISO 14253-1, with a guard band of one expanded uncertainty."""
        if self.error is None:
            return "No statement: no position error was measured at places that were not fitted."
        guard = self.of_deviations
        numbers = (
            f"largest position error {length(self.error)} ({self.places}), limit {length(limit)}, "
            f"guard band {length(guard)} (U, k = 2, of a measured distance)"
        )
        if self.error + guard <= limit:
            text = "Conforms: the error and its guard band are within the limit"
        elif self.error - guard > limit:
            text = "Does not conform: the error exceeds the limit by more than its guard band"
        else:
            text = "No statement: the limit lies within the guard band of the error"
        return f"{text}. Decision rule of ISO 14253-1: {numbers}."


READING, INSTRUMENT = "reading", "calibration of the instrument"
# Parts of the error of a predicted reading, in the words of a certificate.
PARTS = {
    "instrument": (READING, "A"),
    "repeatability": ("repeatability of the arm", "A"),
    "parameters": ("model: estimated parameters", "A"),
    "lack_of_fit": ("model: lack of fit", "A"),
    "open_parameters": ("choice of parameters: those left open", "B"),
}


def certified_values(result: Calibration, budget: ErrorBudget | None) -> Certified:
    parts, sources = result.uncertainty(), []
    for key, (name, kind) in PARTS.items() if parts is not None else ():
        sources.append((name, kind, getattr(parts, key) / SIDES))
    own = result.model.cell.certificate.instrument_uncertainty
    if own is not None:
        sources.append((INSTRUMENT, "B", own / K))
    error, places = None, ""
    if result.test is not None and len(result.test.errors):
        error, places = float(result.test.errors.max()), "test data"
    elif budget is not None:
        apart = pose_accuracy(result.observations, budget.steps[-1].errors)
        error, places = float(apart.max()), "each place left out of the fit"
    return Certified(tuple(sources), error, places, pose_repeatability(result))


def pose_repeatability(result: Calibration) -> Array:
    """RP (places,) in m as ISO 9283 has it, of places with enough readings.

    RP = l̄ + 3 S_l of the distances l of the readings from their mean.
    """
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


def _uncertainty(certified: Certified) -> Iterator[Block]:
    if not certified.sources:
        return
    square = sum(u**2 for *_, u in certified.sources)
    rows = [
        (name, kind, length(u), f"{100 * u**2 / square if square else 0:.0f} %")
        for name, kind, u in certified.sources
    ]
    rows.append(("combined", "", length(math.sqrt(square)), "100 %"))
    rows.append(("expanded, U with k = 2", "", length(certified.expanded), ""))
    heads = ("source", "type", "standard uncertainty", "share of the variance")
    note = (
        "Of a coordinate of a position that the calibrated model predicts, against one reading "
        "(GUM, JCGM 100). U covers about 95 %."
    )
    if all(name != INSTRUMENT for name, *_ in certified.sources):
        note += " Without the instrument's own calibration, which [certificate] does not state."
    yield ShownTable(heads, rows, (0, 1), title="Uncertainty", note=note)


def _poses(
    result: Calibration, budget: ErrorBudget | None, certified: Certified
) -> Iterator[Block]:
    if budget is not None and len(budget.steps) > 1:
        ends = (budget.steps[0], budget.steps[-1])
        found = {
            name: pose_accuracy(result.observations, step.errors)
            for name, step in zip(before_and_after(result, budget), ends, strict=False)
        }
        yield spread_table(found, "places", "Pose accuracy before and after")
        yield Sentence(
            "In the sense of ISO 9283: the distance between the place that was meant and the mean "
            "of what was read there, at every configuration, marker and load. “Calibrated” is what "
            "the calibrated model predicts for a configuration that was left out of the fit; both "
            "include the instrument's noise, as far as repeats leave it in the mean. The poses are "
            "those of the measurement session, not the standard's five.",
            soft=True,
        )
    else:
        yield Sentence("Pose accuracy is not known: no configuration can be left out of the fit.")
    if len(rp := certified.repeatability):
        yield Sentence(
            f"Pose repeatability RP (ISO 9283): {length(float(rp.mean()))} in the mean of "
            f"{len(rp)} places read {FEWEST} times or more, {length(float(rp.max()))} at most; the "
            "instrument's noise is included."
        )


# The certificate as XML

UNITS = {
    "m": "\\metre",
    "rad": "\\radian",
    "rad/(N*m)": "\\radian\\newton\\tothe{-1}\\metre\\tothe{-1}",
    "m/N": "\\metre\\newton\\tothe{-1}",
    "N/m": "\\newton\\metre\\tothe{-1}",
    "N": "\\newton",
    "kg": "\\kilogram",
    "m/s": "\\metre\\second\\tothe{-1}",
    "rad/s": "\\radian\\second\\tothe{-1}",
    "1/K": "\\kelvin\\tothe{-1}",
}
ONE = "\\one"  # of a unit that is not listed
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
    """The XML document.

    Raises InputError where [certificate] of the cell lacks entries: there is no DCC without them.
    """

    c, name = result.model.cell.certificate, result.model.chain.name
    if c.missing:
        raise InputError(
            "a digital calibration certificate needs [certificate] in the cell with "
            f"{listed(c.missing)}; without them write the report as .html"
        )
    certified = certified_values(result, gap_budget(result))
    statement, u = judgement(result).headline, certified.of_deviations
    if c.limit is not None:
        statement = f"{certified.conformity(c.limit)} {statement}"
    found = [
        ("root mean square position error at poses not fitted", result.heldout_rms, "m", u),
        ("largest position error at places not fitted", certified.error, "m", u),
        *((e.name, e.value, e.unit, K * e.std)
          for e in result.ordinary if e.value is not None and e.std is not None),
    ]  # fmt: skip
    results = [
        f"<dcc:result>{_quantity(name, value, UNITS.get(unit, ONE), expanded)}</dcc:result>"
        for name, value, unit, expanded in found
    ]
    told = {
        **vars(c), "version": __version__, "robot": name, "statement": statement,
        "location": "customer" if c.place == c.customer else "other",
    }  # fmt: skip
    text = Template(resource("dcc.xml")).substitute(
        {key: _xml("" if value is None else str(value)) for key, value in told.items()},
        ambient=_quantity("temperature", c.temperature, "\\degreecelsius"),
        results="".join(results),
    )
    for prefix in ("dcc", "si"):
        ElementTree.register_namespace(prefix, f"https://ptb.de/{prefix}")
    root = ElementTree.fromstring(text)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _xml(text: str) -> str:
    return escape(printable(text))


def _quantity(name: str, value: float | None, unit: str, expanded: float | None = None) -> str:
    """A value with its expanded uncertainty, k = 2; none where there is no value."""
    what, name = "<dcc:noQuantity/>", _xml(name)
    if value is not None:
        what = REAL % (value, unit, "" if expanded is None else COVERED % (expanded, K))
    return QUANTITY % (name, name, what)
