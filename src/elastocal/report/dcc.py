"""The certificate as a digital calibration certificate: DCC 3.2.1 of PTB, quantities by D-SI.

https://gitlab.com/ptb/dcc/xsd-dcc has the schema.  Languages and countries are coded by ISO 639-1
and ISO 3166-1.
"""

from __future__ import annotations

from typing import Any
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
# Elements in their order: tag (si: of D-SI, @en with this language), text or what it holds.
Inside = list[tuple[str, Any]]


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
    root = ElementTree.Element(f"{{{DCC}}}digitalCalibrationCertificate", schemaVersion="3.2.1")
    measured = [("measurementResult", _results(result))]
    _write(
        root, [("administrativeData", _administration(result)), ("measurementResults", measured)]
    )
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _write(parent: ElementTree.Element, inside: Inside) -> None:
    for tag, what in inside:
        name, _, lang = tag.partition("@")
        space = SI if name.startswith("si:") else DCC
        how = {"lang": lang} if lang else {}
        found = ElementTree.SubElement(parent, f"{{{space}}}{name.removeprefix('si:')}", how)
        if isinstance(what, list):
            _write(found, what)
        elif what is not None:
            found.text = printable(what)


def _name(text: str | None) -> tuple[str, Any]:
    return "name", [("content@en", text)]


def _known(issuer: str, value: str | None) -> tuple[str, Any]:
    return "identifications", [("identification", [("issuer", issuer), ("value", value)])]


def _administration(result: Calibration) -> Inside:
    c = result.model.cell.certificate
    robot, tool = (result.model.chain.name, c.robot_serial), ("tool", c.tool_serial)
    country = ("location", [("countryCode", c.country)])
    place = ("location", [("further", [("content@en", f"calibrated at: {c.place}")])])
    signer = [("person", [_name(c.operator)]), ("mainSigner", "true")]
    return [
        ("dccSoftware", [("software", [_name("elastocal"), ("release", __version__)])]),
        ("coreData", [
            ("countryCodeISO3166_1", c.country),
            ("usedLangCodeISO639_1", "en"),
            ("mandatoryLangCodeISO639_1", "en"),
            ("uniqueIdentifier", c.number),
            ("beginPerformanceDate", c.measured_on),
            ("endPerformanceDate", c.measured_on),
            ("performanceLocation", "customer" if c.place == c.customer else "other"),
        ]),
        ("items", [("item", [_name(name), _known("manufacturer", serial)])
                   for name, serial in (robot, tool)]),
        ("calibrationLaboratory", [("contact", [_name(c.laboratory), country])]),
        ("respPersons", [("respPerson", signer)]),
        ("customer", [_name(c.customer), place]),
    ]  # fmt: skip


def _results(result: Calibration) -> Inside:
    c = result.model.cell.certificate
    certified = certified_values(result, gap_budget(result))
    u, rms = certified.of_deviations, result.heldout_rms
    found = [
        _result("root mean square position error at poses not fitted", rms, "\\metre", u),
        _result("largest position error at places not fitted", certified.error, "\\metre", u),
        *(_result(e.name, e.value, UNITS.get(e.unit, "\\one"), K * e.std)
          for e in result.ordinary if e.value is not None and e.std is not None),
    ]  # fmt: skip
    statement = judgement(result).headline
    if c.limit is not None:
        statement = f"{certified.conformity(c.limit)} {statement}"
    equipment = [_name(c.instrument), _known("calibrationLaboratory", c.instrument_calibration)]
    ambient = _quantity("temperature", c.temperature, "\\degreecelsius")
    return [
        _name("Calibration of the robot's kinematics and compliance"),
        ("usedMethods", [("usedMethod", [_name(c.procedure)])]),
        ("measuringEquipments", [("measuringEquipment", equipment)]),
        ("influenceConditions", [("influenceCondition", [_name("temperature"), ambient])]),
        ("results", found),
        ("measurementMetaData", [("metaData", [("declaration", [("content", statement)])])]),
    ]


def _result(name: str, value: float | None, unit: str, expanded: float) -> tuple[str, Any]:
    return "result", [_name(name), _quantity(name, value, unit, expanded)]


def _quantity(
    name: str, value: float | None, unit: str, expanded: float | None = None
) -> tuple[str, Any]:
    """A value with its expanded uncertainty, k = 2; none where there is no value."""
    what: tuple[str, Any] = "noQuantity", None
    if value is not None:
        what = "si:real", [("si:value", f"{value:.9g}"), ("si:unit", unit)]
    if value is not None and expanded is not None:
        covered = [
            ("si:valueExpandedMU", f"{expanded:.3g}"), ("si:coverageFactor", f"{K:g}"),
            ("si:coverageProbability", f"{PROBABILITY}"), ("si:distribution", "normal"),
        ]  # fmt: skip
        what[1].append(("si:measurementUncertaintyUnivariate", [("si:expandedMU", covered)]))
    return "data", [("quantity", [_name(name), what])]
