"""The certificate as a digital calibration certificate: DCC 3.2.1 of PTB, quantities by D-SI.

https://gitlab.com/ptb/dcc/xsd-dcc has the schema.  Languages and countries are coded by ISO 639-1
and ISO 3166-1.
"""

from __future__ import annotations

from xml.etree import ElementTree

from elastocal import __version__
from elastocal.errors import InputError
from elastocal.identification.error_budget import gap_budget
from elastocal.identification.result import Calibration
from elastocal.report.certificate_view import K, certified_values
from elastocal.report.judgement_view import judgement
from elastocal.text import listed, printable

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
PROBABILITY = 0.95  # that U covers, of a normal distribution
Element = ElementTree.Element


def dcc_text(result: Calibration) -> str:
    """The XML document.

    Raises InputError where [certificate] of the cell lacks entries: there is no DCC without them.
    """
    entries = result.model.cell.certificate
    if entries.missing:
        raise InputError(
            "a digital calibration certificate needs [certificate] in the cell with "
            f"{listed(entries.missing)}; without them write the report as .html"
        )
    for prefix, space in (("dcc", DCC), ("si", SI)):
        ElementTree.register_namespace(prefix, space)
    root = Element(f"{{{DCC}}}digitalCalibrationCertificate", schemaVersion="3.2.1")
    _administration(_add(root, "administrativeData"), result)
    _results(_add(_add(root, "measurementResults"), "measurementResult"), result)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _administration(data: Element, result: Calibration) -> None:
    cell = result.model.cell
    c = cell.certificate
    software = _add(_add(data, "dccSoftware"), "software")
    _named(software, "elastocal")
    _add(software, "release", __version__)
    core = _add(data, "coreData")
    _add(core, "countryCodeISO3166_1", c.country)
    _add(core, "usedLangCodeISO639_1", "en")
    _add(core, "mandatoryLangCodeISO639_1", "en")
    _add(core, "uniqueIdentifier", c.number)
    _add(core, "beginPerformanceDate", c.measured_on)
    _add(core, "endPerformanceDate", c.measured_on)
    _add(core, "performanceLocation", "customer" if c.place == c.customer else "other")
    items = _add(data, "items")
    for name, serial in ((result.model.chain.name, c.robot_serial), ("tool", c.tool_serial)):
        item = _add(items, "item")
        _named(item, name)
        known = _add(_add(item, "identifications"), "identification")
        _add(known, "issuer", "manufacturer")
        _add(known, "value", serial)
    at = _contact(_add(data, "calibrationLaboratory"), "contact", c.laboratory)
    _add(_add(at, "location"), "countryCode", c.country)
    person = _add(_add(data, "respPersons"), "respPerson")
    _contact(person, "person", c.operator)
    _add(person, "mainSigner", "true")
    at = _contact(data, "customer", c.customer)
    where = _add(_add(_add(at, "location"), "further"), "content", f"calibrated at: {c.place}")
    where.set("lang", "en")


def _contact(parent: Element, tag: str, name: str | None) -> Element:
    contact = _add(parent, tag)
    _named(contact, name)
    return contact


def _results(measured: Element, result: Calibration) -> None:
    c = result.model.cell.certificate
    _named(measured, "Calibration of the robot's kinematics and compliance")
    method = _add(_add(measured, "usedMethods"), "usedMethod")
    _named(method, c.procedure)
    used = _add(_add(measured, "measuringEquipments"), "measuringEquipment")
    _named(used, c.instrument)
    known = _add(_add(used, "identifications"), "identification")
    _add(known, "issuer", "calibrationLaboratory")
    _add(known, "value", c.instrument_calibration)
    ambient = _add(_add(measured, "influenceConditions"), "influenceCondition")
    _named(ambient, "temperature")
    _quantity(_add(ambient, "data"), "temperature", c.temperature, "\\degreecelsius")
    results = _add(measured, "results")
    certified = certified_values(result, gap_budget(result))
    values = {
        "root mean square position error at poses not fitted": result.heldout_rms,
        "largest position error at places not fitted": certified.error,
    }
    for name, value in values.items():
        found = _add(results, "result")
        _named(found, name)
        _quantity(_add(found, "data"), name, value, "\\metre", certified.of_deviations)
    for e in result.ordinary:
        if e.value is None or e.std is None:
            continue
        found = _add(results, "result")
        _named(found, e.name)
        unit = UNITS.get(e.unit, "\\one")
        _quantity(_add(found, "data"), e.name, e.value, unit, K * e.std)
    said = _add(_add(measured, "measurementMetaData"), "metaData")
    statement = judgement(result).headline
    if c.limit is not None:
        statement = f"{certified.conformity(c.limit)} {statement}"
    declared = _add(said, "declaration")
    _add(declared, "content", statement)


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


def _quantity(
    data: Element, name: str, value: float | None, unit: str, expanded: float | None = None
) -> None:
    """A value with its expanded uncertainty, k = 2; none where there is no value."""
    quantity = _add(data, "quantity")
    _named(quantity, name)
    if value is None:
        _add(quantity, "noQuantity")
        return
    real = _si(quantity, "real")
    _si(real, "value", f"{value:.9g}")
    _si(real, "unit", unit)
    if expanded is not None:
        uncertainty = _si(_si(real, "measurementUncertaintyUnivariate"), "expandedMU")
        _si(uncertainty, "valueExpandedMU", f"{expanded:.3g}")
        _si(uncertainty, "coverageFactor", f"{K:g}")
        _si(uncertainty, "coverageProbability", f"{PROBABILITY}")
        _si(uncertainty, "distribution", "normal")


def _named(parent: Element, name: str | None) -> None:
    content = _add(_add(parent, "name"), "content", name)
    content.set("lang", "en")


def _add(parent: Element, tag: str, text: str | None = None, space: str = DCC) -> Element:
    found = ElementTree.SubElement(parent, f"{{{space}}}{tag}")
    if text is not None:
        found.text = printable(text)
    return found


def _si(parent: Element, tag: str, text: str | None = None) -> Element:
    return _add(parent, tag, text, SI)
