"""Why the arm still differs from its model: the whole diagnosis, step by step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from elastocal.diagnosis.baseline import Baseline, fit_baseline
from elastocal.diagnosis.budget import budget
from elastocal.diagnosis.confirm import shrinkage
from elastocal.diagnosis.curves import curves_of
from elastocal.diagnosis.evidence import exceedance
from elastocal.diagnosis.extend import settings_of
from elastocal.diagnosis.floor import noise_floor
from elastocal.diagnosis.found import Found
from elastocal.diagnosis.generic import generic_blocks
from elastocal.diagnosis.hypotheses import Hypothesis, possible
from elastocal.diagnosis.listing import candidates, too_small, warnings
from elastocal.diagnosis.locate import location, structure_tests
from elastocal.diagnosis.options import DiagnosisOptions
from elastocal.diagnosis.play_law import with_likelier_play
from elastocal.diagnosis.recorded_drivers import model_keys, with_recorded_drivers
from elastocal.diagnosis.refit import refit
from elastocal.diagnosis.result import Diagnosis, FoundEffect
from elastocal.diagnosis.scene import Scene, scene_of
from elastocal.diagnosis.screen import Screened, screen
from elastocal.diagnosis.search import Search
from elastocal.diagnosis.thin import thinned
from elastocal.diagnosis.truths import Confirmation
from elastocal.diagnosis.uncertain_settings import between_visits
from elastocal.diagnosis.verdict import Answer, judge
from elastocal.errors import InsufficientDataError
from elastocal.identification.checks import check_table
from elastocal.manipulator.model import Model
from elastocal.measurements import Measurements

Progress = Callable[[str], None]

FEWEST = 8  # configurations


def diagnose(
    model: Model,
    table: Measurements,
    options: DiagnosisOptions | None = None,
    progress: Progress = lambda message: None,
) -> Diagnosis:
    """Where the gap between model and measurement lies, what causes it, how far it shrinks.

    The cell's effects are fitted; noise floor and faulty readings come first; every effect of the
    catalogue at every place, and smooth dependences without a name, are then judged by their
    marginal likelihood; what is claimed has to beat the whole family under sign flips.

    Raises InputError for data that contradict robot or cell, InsufficientDataError where there
    are too few configurations to tell an effect from noise.
    """
    options = options or DiagnosisOptions()
    given, source = model, table.source
    check_table(model, table)
    _check_enough(table)
    table, left_out = thinned(table)
    model = with_recorded_drivers(model, table)
    progress("fitting the model as it is")
    base = fit_baseline(model, table, options.seed)
    hypotheses, untested = possible(model, table, options.without)
    progress("columns of what could be missing")
    scene = with_likelier_play(scene_of(base, hypotheses))
    base = scene.base
    scene, found, screened = _searched(scene, options, progress)
    answer = judge(found)
    progress("confirming")
    rng = np.random.default_rng(options.seed)
    gap, steps = budget(scene, found, rng)
    findings = _findings(found, answer, base, rng)
    tests = structure_tests(found.first)
    chosen = found.chosen
    nothing = found.slots[0].probabilities()[1]
    p_first = exceedance(found.first.flipped, found.first.odds)
    return Diagnosis(
        verdict=answer.verdict,
        gap=gap,
        budget=steps,
        effects=findings,
        candidates=candidates(scene, found, answer),
        indistinguishable=answer.indistinguishable,
        location=location(found, tests),
        noise=noise_floor(found.scene, chosen.data, chosen.noise),
        structure=tests,
        probability_nothing=nothing,
        probability_unknown=_unknown(found),
        p_value=found.p_values[0] if found.p_values else p_first,
        curves=curves_of(found.scene, chosen),
        untested=(*untested, *too_small(scene, found)),
        warnings=(*filter(None, [left_out]), *warnings(scene, found, screened)),
        n_readings=scene.blocks.n,
        n_configurations=len(scene.blocks.member),
        model_keys=model_keys(base.model, findings),
        model=given,
        data=source,
        calibrated=base,
    )


def _unknown(found: Found) -> float:
    """Probability that something without a name is at work, in whichever slot it is likeliest."""
    shares = []
    for slot in found.slots:
        each = slot.probabilities()[0]
        blocks = [p for item, p in zip(slot.items, each, strict=True) if not item.known]
        shares.append(min(float(np.sum(blocks)), 1.0))  # a sum of hundreds may exceed it
    return max(shares)


def _searched(
    scene: Scene, options: DiagnosisOptions, progress: Progress
) -> tuple[Scene, Found, Screened]:
    """What is missing, and the scene without the faulty readings, which are sought twice: beside a
    large effect nothing looks faulty, or the wrong readings do."""
    progress("noise floor")
    screened = screen(scene, scene.data)
    progress("searching for what is missing")
    search = _search(scene.without(screened.faulty), options)
    found = search.run()
    if found.chosen.items:
        before = screened.faulty
        screened = screen(found.scene, found.chosen.data.without(np.zeros_like(before)))
        if (screened.faulty != before).any():
            progress("searching again without faulty readings")
            search = _search(scene.without(screened.faulty), options)
            found = search.run()
    return scene.without(screened.faulty), search.settled(found), screened


def _search(scene: Scene, options: DiagnosisOptions) -> Search:
    blocks = generic_blocks(scene)
    return Search(scene, blocks, scene.noise, options.false_alarm, options.seed)


def _check_enough(table: Measurements) -> None:
    n = len(np.unique(table.configuration))
    if n < FEWEST:
        raise InsufficientDataError(
            f"{table.source}: {n} configurations are too few to tell a missing effect from noise; "
            f"measure {FEWEST} at least, better 30 or more"
        )


def _findings(
    found: Found, answer: Answer, plain: Baseline, rng: np.random.Generator
) -> tuple[FoundEffect, ...]:
    """The known items with their probabilities, parameters and confirmed shrinkage."""
    chosen, scene = found.chosen, found.scene
    known = [k for k, item in enumerate(chosen.items) if item.known]
    if not known:
        return ()
    confirmation = Confirmation.of(found, plain, rng)
    parameters = refit(confirmation.parameters, [chosen.items[k] for k in known])
    findings = []
    for k in known:
        what = chosen.items[k].what
        assert isinstance(what, Hypothesis)
        truths = confirmation.truths(k, answer.rivals[k])
        change = between_visits(scene, chosen, k)
        measured = len(scene.blocks.member)
        fall = shrinkage(truths, measured, confirmation.unnamed, change, rng)
        findings.append(
            FoundEffect(
                what.name,
                what.where,
                answer.probability[k],
                fall.reduction,
                fall.ci90,
                fall.ci95,
                parameters[what.name, what.where],
                settings_of(chosen.items[k]),
            )
        )
    return tuple(findings)
