"""The calibration certificate: what was calibrated, by what, and how far off it is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from elastocal.identification.error_budget import gap_budget, pose_accuracy
from elastocal.identification.prediction import measured_loads
from elastocal.identification.result import Calibration
from elastocal.report.blocks import Block, Report, Table, Text, Verdict
from elastocal.report.formatting import length, sentence, title_of
from elastocal.report.identification_view import (
    at_new_poses,
    before_and_after,
    joint_lines,
    prediction_lines,
    readings,
    spread_table,
    what_was_identified,
)
from elastocal.report.judgement_view import judgement
from elastocal.report.method_and_noise import method_and_weights
from elastocal.text import printable
from elastocal.units import Array


def certificate_report(result: Calibration) -> Report:
    """A page to print and file: verdict, pose accuracy before and after, what was measured."""
    title = title_of(result.model.chain.name, result.model.cell.name)
    backend = result.model.backend_report()
    return Report("Calibration certificate", title, _blocks(result), backend, filed=True)


def _blocks(result: Calibration) -> Iterator[Block]:
    verdict = judgement(result)
    yield Verdict(verdict.tone, verdict.headline)
    errors = before_and_after(result, budget := gap_budget(result))
    if budget is not None and len(errors) > 1:
        ends = (budget.steps[0], budget.steps[-1])
        of_places = {
            name: pose_accuracy(result.observations, step.errors)
            for name, step in zip(errors, ends, strict=False)
        }
        yield spread_table(of_places, "places", "Pose accuracy before and after")
        yield Text(
            "In the sense of ISO 9283: the distance between the place that was meant and the mean "
            "of what was read there, at every configuration, marker and load. “Calibrated” is what "
            "the calibrated model predicts for a configuration that was left out of the fit; both "
            "include the instrument's noise, as far as repeats leave it in the mean. The poses are "
            "those of the measurement session, not the standard's five.",
            soft=True,
        )
    else:
        yield Text("Pose accuracy is not known: no configuration can be left out of the fit.")
    facts = [
        ("Robot", printable(result.model.chain.name)),
        *joint_lines(result),
        ("Instrument, standard deviations", _stated_noise(result)),
        ("Readings", readings(result)),
        ("Loads", "; ".join(_newtons(f) for f in measured_loads(result.observations))),
        ("Identified", what_was_identified(result)),
        ("Method", sentence(method_and_weights(result))),
        *([("Expected error", at_new_poses(result.predicted))] if result.predicted else []),
        *prediction_lines(result),
    ]
    yield Table(("what", ""), facts, (0, 1), title="What was calibrated, and by what")


def _stated_noise(result: Calibration) -> str:
    stated = result.model.cell.tracker.noise
    if stated is None:
        given = result.observations.table.sigma is not None
        return "stated with each reading" if given else "none stated"
    return ", ".join(
        f"{name.replace('_', ' ')} {', '.join(length(float(v)) for v in _each(value))}"
        + (" per m" if name.endswith("per_m") else "")
        for name, value in vars(stated).items()
    )


def _newtons(force: Array) -> str:
    return f"({', '.join(f'{v:g}' for v in force)}) N"


def _each(value: Any) -> Array:
    """A number, the numbers of three axes, or the one that all have."""
    values: Array = np.atleast_1d(value)
    return values if np.ptp(values) else values[:1]
