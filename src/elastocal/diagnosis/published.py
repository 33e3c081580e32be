"""A diagnosis as JSON: schema elastocal/diagnosis/1."""

from __future__ import annotations

from typing import Any

from elastocal.diagnosis.result import (
    Candidate,
    Curve,
    Diagnosis,
    EffectAt,
    FaultyReading,
    FoundEffect,
    Location,
    NoiseFloor,
)
from elastocal.diagnosis.separate.result import ExtraPlan
from elastocal.identification.error_budget import BudgetStep
from elastocal.manipulator.model import Model
from elastocal.text import plain

SCHEMA = "elastocal/diagnosis/1"
MICRO = 1e6
NORMAL_95 = 1.959964


def publish(diagnosis: Diagnosis, model: Model, data: str) -> dict[str, Any]:
    """The diagnosis as a JSON-ready dictionary (DESIGN: diagnose → JSON).

    `model` is the arm that was diagnosed, `data` names its measurements.  Lengths are in µm where
    the key says _um, everything else in the SI unit that stands beside it.  A number that is not
    known or not finite is null, as JSON has none.
    """
    d = diagnosis
    content = {
        "schema": SCHEMA,
        "robot": model.chain.name,
        "cell": model.cell.name,
        "data": data,
        "verdict": d.verdict,
        "p_value": d.p_value,
        "probability_nothing": d.probability_nothing,
        "probability_unknown": d.probability_unknown,
        "gap": {
            "nominal_um": d.gap.nominal * MICRO,
            "calibrated_um": d.gap.calibrated * MICRO,
            "explained_um": d.gap.explained * MICRO,
            "noise_floor_um": d.gap.noise_floor * MICRO,
        },
        "budget": [_step(step) for step in d.budget],
        "effects": [_finding(finding) for finding in d.effects],
        "candidates": [_candidate(candidate) for candidate in d.candidates],
        "indistinguishable": [[_place(e) for e in rivals] for rivals in d.indistinguishable],
        "location": None if d.location is None else _location(d.location),
        "structure": [vars(test) for test in d.structure],
        "curves": [_curve(curve) for curve in d.curves],
        "noise": _noise(d.noise, model.chain.kinds),
        "untested": [vars(u) for u in d.untested],
        "extra_plan": None if d.extra is None else _extra(d.extra),
        "model_keys": d.model_keys,
        "warnings": list(d.warnings),
        "findings": [f.to_json() for f in d.findings],
        "backend": model.backend_report(),
        "n_readings": d.n_readings,
        "n_configurations": d.n_configurations,
    }
    return {key: plain(value) for key, value in content.items()}


def _step(step: BudgetStep) -> dict[str, Any]:
    return {
        "step": step.step,
        "heldout_rms_um": step.heldout_rms * MICRO,
        "ci95": [end * MICRO for end in step.ci95],
    }


def _place(e: EffectAt | FoundEffect | Candidate) -> dict[str, Any]:
    return {"effect": e.effect, "where": e.where}


def _finding(f: FoundEffect) -> dict[str, Any]:
    return _place(f) | {
        "probability": f.probability,
        "gap_reduction": f.gap_reduction,
        "gap_reduction_ci90": f.gap_reduction_ci90,
        "gap_reduction_ci95": f.gap_reduction_ci95,
        "parameters": [
            {
                "name": p.name,
                "value": p.value,
                "unit": p.unit,
                "std": p.std,
                "ci95": [p.value - NORMAL_95 * p.std, p.value + NORMAL_95 * p.std],
            }
            for p in f.parameters
        ],
        "settings": f.settings,
    }


def _candidate(c: Candidate) -> dict[str, Any]:
    return _place(c) | {
        "stage": c.stage,
        "probability": c.probability,
        "score": c.score,
        "detectable": c.detectable,
        "settings": c.settings,
    }


def _location(location: Location) -> dict[str, Any]:
    return {
        "stage": location.stage,
        "where": location.where,
        "probability": location.probability,
        "evidence": {
            "stages": location.stages,
            "places": location.places,
            "drivers": location.drivers,
        },
    }


def _curve(c: Curve) -> dict[str, Any]:
    return vars(c) | {name: list(getattr(c, name)) for name in ("x", "y", "sd")}


def _noise(noise: NoiseFloor, kinds: tuple[str, ...]) -> dict[str, Any]:
    return {
        "stated": noise.stated,
        "stated_factor": noise.stated_factor,
        "reading_sigma_um": noise.reading_sigma * MICRO,
        "repeatability": [
            {
                "where": f"joint{i + 1}",
                "value": value,
                "unit": "rad" if kind == "revolute" else "m",
            }
            for i, (value, kind) in enumerate(zip(noise.repeatability, kinds, strict=True))
        ],
        "shared": noise.shared,
        "pure_error_um": None if noise.pure_error is None else noise.pure_error * MICRO,
        "faulty": [_faulty(reading) for reading in noise.faulty],
    }


def _faulty(reading: FaultyReading) -> dict[str, Any]:
    return {
        "line": reading.line,
        "configuration": reading.configuration,
        "marker": reading.marker,
        "error_um": reading.error * MICRO,
        "sigmas": reading.sigmas,
    }


def _extra(extra: ExtraPlan) -> dict[str, Any]:
    return {
        "separable": extra.separable,
        "inseparable": [list(group) for group in extra.inseparable],
        "n_poses": extra.n_poses,
        "rivals": list(extra.rivals),
        "pairs": [vars(pair) for pair in extra.pairs],
        "probability_before": extra.probability_before,
        "probability_after": extra.probability_after,
        "probability_random": extra.probability_random,
        "advice": list(extra.advice),
    }
