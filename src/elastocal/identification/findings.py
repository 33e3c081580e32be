"""What a result is worth: each judgement with its numbers, its threshold and what to do."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy import linalg, special

from elastocal.errors import option
from elastocal.identification.far_values import STATED_BY_FILE, far_values
from elastocal.identification.marker_names import exchanged
from elastocal.identification.mistakes import CELL, KILOGRAMS, load_ratio
from elastocal.identification.noise_structure import CONFIGURATION, JOINTS, TIME, Kind
from elastocal.identification.noise_summary import Drift, NoiseSize
from elastocal.identification.outliers import kept_of
from elastocal.identification.prediction import unread_markers
from elastocal.identification.residuals import ResidualSummary
from elastocal.identification.result import Calibration, Estimate, Finding, Number, Severity
from elastocal.identification.solve import Solution
from elastocal.measurements import Measurements, firsts, numbered
from elastocal.model.arm import Parameter
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.effects.compliances import JointCompliance
from elastocal.text import listed

# Judged once: terminal, page, notebook and JSON print these findings and judge nothing of their
# own.  A threshold stands here, or with the values far from nominal.

STATED = (0.005, 0.995)  # quantiles of χ² between which the residual agrees with the stated noise
# Beside a stated variance of more than twice what the residual shows, an effect as large as all of
# the noise would pass for noise.
FAR_TOO_LARGE = math.sqrt(0.5)
LACK_OF_FIT = 0.01  # p-value below which configurations scatter more than their repeats
FLATTERS = 1.2  # held-out over fitted error, above which the fit flatters itself
LITTLE = 1.25  # times better than the nominal arm, below which little was gained
# Test data lie where the calibration was not made, or the arm has changed, where their errors are
# this much larger than held-out poses' and chance allows for it in one table of a hundred.
WORSE, CHANCE = 1.25, 0.01
# Factor to which the compliances of an arm are known before: those of the KR 270 are 0.8 times what
# its links' weights let expect, and 1.5 times what its length does.
EXPECTED_TO = 2.0
MANY = 0.05  # share of the readings fitted, above which those beyond the noise are no accidents
SCATTERS = 0.01  # p-value below which joints settle anew at each visit, or something drifts
NOT_NORMAL = 0.01  # p-value below which standardised residuals are not normal
# Excess kurtosis of the t distribution with 10 degrees of freedom, of which least squares uses
# 94.5 % of the information: beyond it a robust method is worth its while.
HEAVY = 1.0
FEW_DOF_PER_PARAMETER = 1.0
MOSTLY = 0.5  # share of its information from which an estimate owes more to the prior
ILL_CONDITIONED = 1e3  # intervals this many times as wide as if each stood alone

# How a parameter stands, in the order in which they are told.
ALONE, COMBINED, ABSORBED, INVISIBLE, FIXED = "alone", "combined", "absorbed", "invisible", "fixed"
WEAK, BEYOND, UNREAD = "weak", "beyond", "unread"

LACKING = (
    "Ask what the model lacks: elastocal diagnose with the same cell and data. Where it finds "
    "nothing, the excess is the robot's repeatability, or noise larger than stated ([tracker])."
)
NAMED = (
    "The cell has {} already. If diagnose named that, it has no name for what is left: repeat some "
    "poses, which tell noise and repeatability from what the model lacks."
)
STATE_NOISE = (
    "State the tracker's noise ([tracker] sigma_um, or range_um and transverse_um): only beside "
    "it does the residual say whether the model lacks something. elastocal diagnose looks for "
    "that either way."
)
COMPARE = (
    "Compare the test poses with those fitted: where they lie elsewhere (joints, load), fit some "
    "like them; where they do not, the arm or the tracker has changed in between."
)
WANDERS = (
    " It may last as long as the campaign: these readings do not tell it from a random walk, "
    "nor where the base is on another day; measure for longer, or on several days."
)
USE = (
    "Use it (elastocal compensate, elastocal export) where poses and loads are like those measured."
)
# These come from the solver and stay when a result is judged anew.
OF_SOLUTION = ("ill_conditioned", "beyond_bound", "exchanged_markers")


def judged(result: Calibration, of_solution: tuple[Finding, ...] | None = None) -> Calibration:
    """The same result with its findings, the overall one ("trust") first.

    `of_solution` are those that only the solver can tell; by default the result's own are kept.
    """
    if of_solution is None:
        of_solution = tuple(f for f in result.findings if f.kind in OF_SOLUTION)
    compared = tuple(_against_stated_noise(result))
    fits = any(f.kind == "residual_agrees_with_stated_noise" for f in compared)
    noise = (*compared, *_repeats(result, fits))
    explained = _explained(result, noise)
    visits = tuple(_visits(result, fits))
    far = tuple(far_values(result, explained, _lacking(result)))
    # Where all lengths are others than the cell's, so are the compliances to expect.
    scaled = any(f.kind == "scale" for f in far)
    found = [
        *_spoilt(result),
        *(f for f in of_solution if f.kind == "exchanged_markers"),
        *_impossible(result),
        *far,
        *_copies(result),
        *(() if scaled else _load_unit(result)),
        *_hardly_shown(result),
        *(f for f in visits if f.kind == "scatter_not_counted"),
        *_alike_in_time(result, explained),
        *_few_poses(result),
        *(f for f in of_solution if f.kind == "ill_conditioned"),
        *noise,
        *(f for f in visits if f.kind != "scatter_not_counted"),
        *_prediction(result, explained),
        *_new_poses(result, explained),
        *(f for f in of_solution if f.kind == "beyond_bound"),
        *_faulty(result),
        *_undetermined(result),
        *_prior(result),
        *_shape(result),
        *_test(result),
    ]
    return replace(result, findings=(_trust(found), *found))


def _trust(found: list[Finding]) -> Finding:
    """Can the calibration be used?  As the worst finding says."""
    worst: Severity = "good"
    for severity in ("care", "poor"):
        if any(f.severity == severity for f in found):
            worst = severity
    doubts = tuple(f.kind for f in found if f.severity == worst) if worst != "good" else ()
    return Finding("trust", worst, {"because": doubts}, USE if worst == "good" else "")


def _um(metres: float) -> float:
    return float(metres) * 1e6


def _spoilt(result: Calibration) -> Iterator[Finding]:
    """What makes the result worthless."""
    if not result.converged:
        yield Finding(
            "not_converged", "poor", {"reason": result.reason},
            "Give start hints in [model.nominal], fit fewer effects, or measure more poses.",
        )  # fmt: skip
    held, nominal = result.heldout_rms, result.nominal_rms
    if held < math.inf and nominal < math.inf and held >= nominal and not only_placed(result):
        numbers: dict[str, Number] = {"heldout_rms_um": _um(held), "nominal_rms_um": _um(nominal)}
        yield Finding("no_better_than_nominal", "poor", numbers)


def _explained(result: Calibration, noise: tuple[Finding, ...]) -> bool:
    """Whether the noise explains what is left, by the findings on it, and held-out poses agree.

    Of n equations for p parameters the held-out error is that of the fit times n / (n - p) or more.
    """
    told = {f.kind for f in noise}
    lacking = any(f.kind == "lack_of_fit" and f.severity == "care" for f in noise)
    stated = told & {
        "residual_agrees_with_stated_noise", "residual_below_stated_noise",
        "residual_agrees_with_readings",
    }  # fmt: skip
    agrees = bool(stated) or ("noise_not_compared" in told and "repeats_agree" in told)
    n, held = len(result.observations.value), result.heldout_rms
    expected = result.residual_rms * n / max(result.dof, 1)
    return agrees and not lacking and held <= FLATTERS * expected


# What an identification takes for granted.


def _copies(result: Calibration) -> Iterator[Finding]:
    if result.copies:
        n = len(result.copies)
        yield Finding(
            "copied_readings", "note",
            {"copies": n, "fitted": len(result.observations.lead), "lines": result.copies},
            "Find out how lines came to be in the table twice; readings that were rounded until "
            "they agree should be given with all their digits.",
        )  # fmt: skip


def _load_unit(result: Calibration) -> Iterator[Finding]:
    """Are all compliances about as much too large as kilograms for newtons make them, or too small?

    Without a load there is no unit of one.  The ratio has to be that factor to within what arms
    differ from what is expected of them (EXPECTED_TO).  By the links' weights alone, a rule of
    thumb, it is worth a look, and no more.
    """
    if not result.observations.table.force.any():
        return
    known = {e.name: e.value for e in result.ordinary if e.value is not None}
    # Turned round, the loads may be in another unit as well: then the sizes tell.
    known |= {p.name: abs(e.held) for p, e in impossible(result)}
    found = load_ratio(result.model, known)
    if found is None:
        return
    ratio, by = found
    if abs(abs(math.log(ratio)) - math.log(KILOGRAMS)) > math.log(EXPECTED_TO):
        return
    unit, cause, undo = (
        ("kilograms", "the force columns hold kilograms", "multiply")
        if ratio > 1
        else ("newtons times 9.81", "newtons were multiplied by 9.81", "divide")
    )
    yield Finding(
        "load_unit", "care" if by == CELL else "note", {"ratio": ratio, "by": by, "unit": unit},
        f"Check the unit of the loads: the compliances are {ratio:.2g} times those expected from "
        f"{by}, as where {cause}. If so, {undo} force_x_N, force_y_N and force_z_N by 9.81.",
    )  # fmt: skip


# Standard deviations beyond a physical bound, by which no estimate errs by chance.
SURELY = 5.0
TURN_ROUND = (
    "Check the sign of the force columns: where z points up, force_z_N of a hanging load is "
    "negative. Turn the sign round in the table if it is wrong (torque columns too), and identify "
    "again."
)
AT_BOUND = (
    "Check load direction and torque signs, measure poses that load it more, or fit with bounds."
)


def impossible(result: Calibration) -> list[tuple[Parameter, Estimate]]:
    """Those more than SURELY standard deviations beyond a physical bound (of the interval of 95 %,
    half is 1.96 of them or more)."""
    return [
        (p, e)
        for p, e in zip(result.model.parameters, result.estimates, strict=True)
        if e.limits is not None
        and max(p.lower - e.held, e.held - p.upper) > SURELY / 1.96 * np.ptp(e.limits) / 2
    ]


def _impossible(result: Calibration) -> Iterator[Finding]:
    """Values that no arm has.  Where most compliances are among them, no missing effect explains
    it, but loads in the opposite direction do, and no load is compensated rightly."""
    found = impossible(result)
    if not found:
        return
    springs = [p for p in result.model.parameters if p.effect == JointCompliance.name]
    turned = [p for p, _ in found if p.effect == JointCompliance.name]
    signs = 2 * len(turned) > len(springs) and bool(result.observations.table.force.any())
    yield Finding(
        "impossible_values", "poor" if signs else "care",
        {
            "parameters": tuple(p.name for p, _ in found),
            "values": tuple(e.held for _, e in found), "units": tuple(p.unit for p, _ in found),
            "likely": "the sign of the force columns" if signs else "",
        },
        TURN_ROUND if signs else AT_BOUND,
    )  # fmt: skip


def _hardly_shown(result: Calibration) -> Iterator[Finding]:
    names = tuple(name for name, standing in standings(result).items() if standing == WEAK)
    if names:
        yield Finding(
            "hardly_shown", "note", {"parameters": names},
            "Measure poses and loads that strain what the readings hardly show (elastocal design "
            "plans them), or give it a prior.",
        )  # fmt: skip


def _alike_in_time(result: Calibration, explained: bool) -> Iterator[Finding]:
    """Residuals of visits that follow each other, by a permutation test.

    Where the noise explains the residual, what they share is a small part of it, for which the
    error at new poses has room.
    """
    found = result.autocorrelation
    if found is None or found.p >= SCATTERS:
        return
    counted = result.noise.drift is not None
    yield Finding(
        "autocorrelated", "note" if counted or explained else "care",
        {
            "lag1": found.correlations[0], "p": found.p, "visits": found.visits, "by": found.by,
            "counted": "yes" if counted else "no",
        },
        ""
        if counted
        else "Visit poses and loads in random order and return to a reference pose every ten "
        "poses: residuals of visits that follow each other are alike, as where something drifts, "
        "or where the model lacks what neighbouring poses have in common.",
    )  # fmt: skip


def _few_poses(result: Calibration) -> Iterator[Finding]:
    n = len(result.observations.value) - result.dof
    if result.dof < FEW_DOF_PER_PARAMETER * n:
        yield Finding(
            "few_degrees_of_freedom", "note", {"dof": result.dof, "parameters": n},
            "Measure more poses.",
        )  # fmt: skip
    if not math.isfinite(result.heldout_rms):
        # Test data check it; it matters little where it is the smaller part of the error.
        found, numbers = result.predicted, dict[str, Number]()
        if found is not None and math.isfinite(found.unchecked):
            numbers = {"unchecked_um": _um(found.unchecked), "rms_um": _um(found.rms)}
        little = found is not None and found.unchecked**2 <= MOSTLY * found.rms**2
        severity: Severity = "note" if little or result.test is not None else "care"
        yield Finding(
            "not_held_out", severity, numbers, _more_poses() if severity == "care" else ""
        )


def _more_poses() -> str:
    return (
        f"Measure more poses: elastocal design with {option('augment')} plans what these data lack."
    )


def _against_stated_noise(result: Calibration) -> Iterator[Finding]:
    """The residual's mean square against the stated noise, by its χ² distribution."""
    ratio = result.noise.ratio_to_stated
    if ratio is None:
        remedy = "" if _lacks_fit(result) else STATE_NOISE
        yield Finding("noise_not_compared", "note", {}, remedy)
        return
    # A mean square varies by (2 + excess kurtosis) / n.
    told = result.dof / (1 + max(_stated_kurtosis(result), 0.0) / 2)
    low, high = np.sqrt(special.chdtri(told, 1 - np.array(STATED)) / told)
    numbers: dict[str, Number] = {
        "ratio": float(ratio), "by_chance_from": float(low), "by_chance_to": float(high),
        "dof": result.dof,
    }  # fmt: skip
    single = result.noise.single
    if single is not None and single.above:
        times = ratio if single.explains else single.ratio
        yield Finding(
            "stated_noise_too_small", "note",
            {"ratio": single.ratio, "dof": single.dof, "by": single.by, "p_rest": single.rest},
            f"Correct [tracker]: by {single.by} single readings scatter {times:.2g} times as much "
            "as cell or table state.",
        )  # fmt: skip
    if ratio > high and not (single is not None and single.explains):
        yield Finding("residual_above_stated_noise", "care", numbers, _lacking(result))
    elif ratio > high:
        yield Finding("residual_agrees_with_readings", "good", numbers)
    elif ratio < low:
        severity: Severity = "care" if ratio < FAR_TOO_LARGE else "note"
        yield Finding(
            "residual_below_stated_noise", severity, numbers,
            "State the tracker's true noise: with noise stated too large, a missing effect does "
            "not show.",
        )  # fmt: skip
    else:
        yield Finding("residual_agrees_with_stated_noise", "good", numbers)


def _stated_kurtosis(result: Calibration) -> float:
    """Of what is kept of noise with the tails that the cell states; normal noise has none."""
    tails, size = result.model.cell.noise.tails, result.observations.size
    if tails is None:
        return 0.0
    values = (len(result.observations.lead) + len(result.excluded)) * size
    return kept_of(tails, values, size).excess_kurtosis


def _lacking(result: Calibration) -> str:
    """What to do where much is left: ask diagnose, unless the cell has what it names."""
    usual = set(STATED_BY_FILE)
    named = {
        p.effect.replace("_", " "): None
        for p in result.model.parameters
        if p.effect not in usual and not effect_of(p.effect).registered
    }
    return NAMED.format(listed(named, 3)) if named else LACKING


def _lacks_fit(result: Calibration) -> bool:
    found = result.noise.lack_of_fit
    return found is not None and found.p < LACK_OF_FIT


def _repeats(result: Calibration, fits: bool) -> Iterator[Finding]:
    """Do configurations scatter more than their repeats, and does anything count with it?

    Where the residual `fits` a stated noise of which readings share some, nothing is missing.
    """
    noise, test = result.noise, result.noise.lack_of_fit
    shared = [s for s in noise.sizes or () if s.part == CONFIGURATION and s.sigma is not None]
    if test is not None:
        counted = "the intervals" if noise.intervals_by_configuration else "nothing"
        if shared or noise.drift is not None:
            counted = "the noise model"
        numbers: dict[str, Number] = {
            "F": test.F, "dof_between": test.dof_between, "dof_pure": test.dof_pure, "p": test.p,
            "counted_by": counted,
        }  # fmt: skip
        if _lacks_fit(result):
            known = fits and result.model.cell.noise.shared and counted == "the noise model"
            severity: Severity = "note" if known else "care"
            yield Finding("lack_of_fit", severity, numbers, "" if known else _lacking(result))
        else:
            yield Finding("repeats_agree", "good", numbers)
    if shared:
        yield Finding(
            "common_deviation", "note",
            {
                "of": tuple(s.name for s in shared),
                "sigma_um": tuple(_um(s.sigma) for s in shared if s.sigma is not None),
            },
        )  # fmt: skip


def _visits(result: Calibration, fits: bool) -> Iterator[Finding]:
    """Joints that settle anew at each visit, and a drift: what a test of false-alarm rate SCATTERS
    finds, whether the noise model has it or not.  `fits`: the residual agrees with the stated
    noise."""
    noise, sizes = result.noise, result.noise.sizes or ()
    stated = result.model.cell.noise
    scatter = stated.of_joints(result.model.chain.n_joints)
    for test in noise.tests:
        if test.p >= SCATTERS:
            continue
        joints = [s for s in sizes if s.joints and s.sigma]
        if test.part == JOINTS and joints:
            yield Finding(
                "joint_scatter", "note",
                {
                    "of": tuple(s.name for s in joints), "p": test.p,
                    "sigma_urad": tuple(_um(s.sigma or 0.0) for s in joints),
                },
                "Measure more poses, not more repeats, and approach each from the same side: the "
                "joints settle anew at every visit. "
                + _beside_stated("joints_urad", [
                    (s, float(np.sqrt((scatter[list(s.joints)] ** 2).mean()))) for s in joints
                ], fits),
            )  # fmt: skip
        elif test.part == TIME and noise.drift is not None:
            drifts = [s for s in sizes if s.part == TIME and s.sigma]
            if drifts:
                remedy = _beside_stated("drift_um", [(drifts[0], stated.drift)], fits)
                yield _drift(noise.drift, drifts[0], test.p, remedy)
        else:
            known = scatter.any() if test.part == JOINTS else stated.drift > 0
            yield Finding(
                "scatter_not_counted", "care",
                {"part": test.part, "p": test.p},
                "Fit with the scatter that [noise] of the cell states: "
                f"{option('noise', Kind.parsed(noise.kind).with_stated(stated).name)}."
                if known
                else "Ask what the model lacks (elastocal diagnose): residuals change from visit "
                "to visit or in time, and noise that does so does not predict poses better.",
            )  # fmt: skip


def _beside_stated(key: str, found: list[tuple[NoiseSize, float]], fits: bool) -> str:
    """What to do about `key` of [noise], by the sizes found and stated (m or rad)."""
    said = listed([f"{_um(size):.3g}" for _, size in found if size])
    if not said:
        return f"State it as [noise] {key} in the cell for design and simulate."
    if all(size.agrees_with(stated) for size, stated in found):
        return f"It agrees with [noise] {key} of the cell ({said})."
    if fits:  # parts of the noise that are alike have their sum alone told
        return f"The cell states it: [noise] {key} ({said})."
    return f"Correct [noise] {key} of the cell ({said}) for design and simulate."


def _drift(drift: Drift, size: NoiseSize, p: float, remedy: str) -> Finding:
    timed = drift.seconds is not None
    return Finding(
        "drift", "care",
        {
            "sigma_um": _um(size.sigma or 0.0), "p": p,
            "lasting_s": drift.seconds, "lasting_share": drift.share,
            "by": "times" if timed else "order of the rows",
        },
        "Measure poses and loads in random order, return to a reference pose every ten poses, "
        + ("" if timed else "record times, ")
        + f"and let arm and tracker warm up. {remedy}"
        + ("" if drift.ends else WANDERS),
    )  # fmt: skip


def _prediction(result: Calibration, explained: bool) -> Iterator[Finding]:
    held, fitted, nominal = result.heldout_rms, result.residual_rms, result.nominal_rms
    placed = only_placed(result)
    # Under a drift the held-out error is that of another day, which more poses make no better.
    # Of base and tool alone, what each point takes of the fit is all that it can flatter by.
    flatters = math.isfinite(held) and held > FLATTERS * fitted and not (placed and explained)
    if flatters and result.noise.drift is None:
        numbers: dict[str, Number] = {"heldout_rms_um": _um(held), "residual_rms_um": _um(fitted)}
        yield Finding("fit_flatters", "care", numbers, _more_poses())
    if held < nominal < LITTLE * held < math.inf and not placed:
        numbers = {"heldout_rms_um": _um(held), "nominal_rms_um": _um(nominal)}
        yield Finding("little_gain", "care", numbers)


def _new_poses(result: Calibration, explained: bool) -> Iterator[Finding]:
    """Is what is said of poses that nobody measured founded: on enough configurations, on a noise
    that is known, on parameters that the readings show?"""
    # Where base and tool alone are sought, as by a dozen touches of a tip, the stated noise judges
    # the fit, and no scatter has to be learnt from it: a coarser look is enough.
    placed = explained and only_placed(result)
    left, wanted = spare_equations(result), COARSE if placed else ENOUGH
    if left < wanted:
        numbers: dict[str, Number] = {
            "configurations": result.observations.n_configurations,
            "parameters": len(result.observations.value) - result.dof,
            "equations_left": left, "needed": wanted,
        }  # fmt: skip
        yield Finding("few_configurations", "care", numbers, _more_poses())
    if result.excess is None:
        yield Finding("noise_unknown", "care", {}, STATE_NOISE)
    found = result.predicted
    if found is None:
        return
    numbers = {
        "rms_um": _um(found.rms), "from_um": _um(found.ci95[0]), "to_um": _um(found.ci95[1]),
        "poses": found.poses, "source": found.source,
    }  # fmt: skip
    yield Finding("new_poses", "note", numbers)
    if found.open**2 > MOSTLY * found.rms**2:
        yield Finding(
            "new_poses_not_shown", "care",
            {
                "open_um": _um(found.open), "heldout_rms_um": _um(result.heldout_rms),
                "parameters": found.blamed,
            },
            f"{_more_poses()} For a part of the joint ranges alone, state test poses in the cell.",
        )  # fmt: skip
    if found.rms > result.nominal_rms / LITTLE and not only_placed(result):
        numbers = {"rms_um": _um(found.rms), "nominal_rms_um": _um(result.nominal_rms)}
        yield Finding("new_poses_no_gain", "care", numbers, _more_poses())


# Equations left between configurations from which their scatter says to a factor of 1.25, with
# 95 % probability, what errors there are beyond the parameters: √(ν/χ²_ν(5 %)) ≤ 1.25; and from
# which it says it to a factor of 1.5.
ENOUGH, COARSE = (
    next(n for n in range(1, 1000) if n <= factor**2 * special.chdtri(n, 0.95))
    for factor in (1.25, 1.5)
)


def spare_equations(result: Calibration) -> int:
    """Equations that configurations give beyond the parameters fitted.

    A rigid body's place is six numbers in each load state, however many markers it has and however
    often they are read.
    """
    observed = result.observations
    table, lead = observed.table, observed.lead
    code = numbered(observed.configuration, *np.round(table.force[lead], 3).T)
    marked = numbered(code, table.marker[lead])
    seen = code[firsts(marked, int(marked.max()) + 1)]
    size = 1 if observed.kind == "distance" else observed.size
    told = np.minimum(size * np.bincount(seen), 6)
    return int(told.sum()) - int(np.sum(~result.model.shrunk[result.columns]))


def _faulty(result: Calibration) -> Iterator[Finding]:
    n, fitted = len(result.faulty), len(result.observations.lead)
    if n:
        named = "1 reading" if n == 1 else f"{n} readings"
        yield Finding(
            "faulty_readings", "note",
            {
                "fitted": len(result.outliers), "left_out": len(result.excluded),
                "heldout_all_rms_um": _um(result.heldout_all_rms),
            },
            f"Check the {named} beyond the noise.",
        )  # fmt: skip
    if len(result.outliers) > MANY * fitted:
        yield Finding(
            "many_faulty_readings", "care", {"faulty": len(result.outliers), "fitted": fitted},
            "Check where they lie before excluding any.",
        )  # fmt: skip


def _undetermined(result: Calibration) -> Iterator[Finding]:
    """What these poses do not show, and what no pose shows: only the first is to be measured."""
    all_of_them = standings(result)
    lacking = [e.name for e in result.ordinary if all_of_them[e.name] in (INVISIBLE, ABSORBED)]
    redundant = () if result.left is None else result.left.redundant
    shown = [name for name in lacking if name not in redundant]
    if n := len(lacking) - len(shown):
        yield Finding("redundant", "good", {"parameters": n})
    unread = tuple(name for name, standing in all_of_them.items() if standing == UNREAD)
    if unread:
        yield Finding(
            "markers_not_read", "note", {"parameters": unread},
            f"There is {no_reading(result)}: measure it, or delete it from [tool.markers_m].",
        )  # fmt: skip
    if n := len(shown):
        yield Finding(
            "undetermined", "note", {"parameters": n, "names": tuple(shown)},
            f"{n} parameter{'' if n == 1 else 's'} cannot be determined from these data "
            f"({listed(shown, 4)}). Predictions hold for poses and loads like those measured; for "
            "others, measure what shows them.",
        )  # fmt: skip


def _unread(result: Calibration) -> list[str]:
    """Places of the markers that the table has no reading of, not even one that was excluded."""
    excluded = {f"marker:{o.marker}" for o in result.excluded}
    places = unread_markers(result.model, result.observations.table)
    return [place for place in places if place not in excluded]


def no_reading(result: Calibration) -> str:
    """ "no reading of marker M2 in data.csv" """
    names = [place.removeprefix("marker:") for place in _unread(result)]
    several, source = "s" * (len(names) > 1), result.observations.table.source
    return f"no reading of marker{several} {listed(names, 4)} in {source}"


def _prior(result: Calibration) -> Iterator[Finding]:
    """Parameters of which the prior says more than the readings, the most so first."""
    shares = result.prior_share
    names = sorted((n for n, s in shares.items() if s > MOSTLY), key=lambda n: -shares[n])
    if names:
        yield Finding(
            "mostly_prior", "note",
            {"parameters": tuple(names), "share": tuple(shares[n] for n in names)},
            "Measure poses that load them more.",
        )  # fmt: skip


def standings(result: Calibration) -> dict[str, str]:
    """Parameter name → ALONE, COMBINED (first of a combination), ABSORBED, WEAK (hardly shown),
    BEYOND (its physical bound), UNREAD (of a marker without readings), INVISIBLE or FIXED."""
    unread = _unread(result)
    first = {next(iter(c.terms)) for c in result.combinations}

    def standing(p: Parameter, e: Estimate) -> str:
        if e.limits is not None:
            return BEYOND if p.beyond(e.limits) else WEAK
        if e.identifiable:
            return ALONE
        if e.name in first:
            return COMBINED
        if e.combined_with:
            return ABSORBED
        if e.note.startswith("fixed"):
            return FIXED
        return UNREAD if p.where in unread else INVISIBLE

    pairs = zip(result.model.parameters, result.estimates, strict=True)
    return {p.name: standing(p, e) for p, e in pairs}


def _shape(result: Calibration) -> Iterator[Finding]:
    if result.residual_summary is not None:
        yield shape_of(result.residual_summary)
        n = sum(g.n_deviating for g in result.residual_summary.groupings)
        if n:
            yield Finding("scatter_unlike_noise_model", "note", {"groups": n})


def shape_of(summary: ResidualSummary) -> Finding:
    """Are the standardised residuals normal?"""
    whole = summary.whole
    numbers: dict[str, Number] = {
        "skewness": whole.skewness, "excess_kurtosis": whole.excess_kurtosis,
        "p": whole.normality_p,
    }  # fmt: skip
    if whole.normality_p is None:
        return Finding("residuals_too_few", "note", numbers)
    if whole.normality_p >= NOT_NORMAL:
        return Finding("residuals_normal", "good", numbers)
    # Of a normal sample, kurtosis has twice the standard deviation of skewness.
    if abs(whole.skewness) > abs(whole.excess_kurtosis) / 2:
        return Finding("residuals_skew", "note", numbers)
    if whole.excess_kurtosis <= 0:
        return Finding("residuals_light_tailed", "note", numbers)
    severity: Severity = "care" if whole.excess_kurtosis > HEAVY else "note"
    return Finding(
        "residuals_heavy_tailed", severity, numbers,
        f"Compare with a robust fit ({option('method')} huber or l1): where parameters "
        "differ by more than their intervals, far readings decide them; look for what makes single "
        "readings err (line of sight, vibration, a tracker that has not settled).",
    )  # fmt: skip


def _test(result: Calibration) -> Iterator[Finding]:
    """Test data against held-out poses, by an F-test of the two mean squares; the components of a
    reading count as one."""
    test, held = result.test, result.heldout_rms
    if test is None:
        yield Finding(
            "untested", "note", {},
            "Validate on independent poses: measure some that are not fitted, and give them with "
            f"{option('test')}.",
        )  # fmt: skip
    elif math.isfinite(held):
        allowed = math.sqrt(special.fdtri(test.n, result.dof, 1 - CHANCE))
        if test.rms > max(WORSE, allowed) * held:
            numbers: dict[str, Number] = {"test_rms_um": _um(test.rms), "heldout_rms_um": _um(held)}
            yield Finding("test_data_worse", "care", numbers, COMPARE)
    if test is not None and test.p_far < CHANCE:
        yield Finding(
            "test_data_far", "care",
            {
                "far": test.far, "configurations": test.configurations, "p": test.p_far,
                "predicted_std_um": _um(test.std), "fitted_std_um": _um(test.most_fitted),
            },
            "Measure poses there: the fit extrapolates.",
        )  # fmt: skip


# What only the solver can tell.


def of_solution(
    result: Calibration, solution: Solution, whole: Measurements
) -> tuple[Finding, ...]:
    """Conditioning of the fit, parameters beyond their physical bounds, and in the `whole` table
    readings with another marker's name."""
    return (*_conditioning(result, solution), *_bounds(result), *_exchanged(result, whole))


def _exchanged(result: Calibration, whole: Measurements) -> Iterator[Finding]:
    """Names of markers that are exchanged: a note where the readings were set apart."""
    found = exchanged(result.model, whole)
    if found is not None:
        lines = whole.row[found.rows]
        fitted = np.isin(lines, result.observations.table.row).any()
        yield Finding(
            "exchanged_markers", "care" if fitted else "note",
            {"markers": found.markers, "rows": len(lines), "lines": tuple(lines.tolist())},
            found.words,
        )  # fmt: skip


def _conditioning(result: Calibration, solution: Solution) -> Iterator[Finding]:
    kept = solution.reduction.kept
    # Unit columns: what is judged is how far they are from parallel, not their units.
    scaled = solution.fit.r_factor.R
    scaled = scaled / np.linalg.norm(scaled, axis=0)
    _, singular, Vt = linalg.svd(scaled[: min(len(kept), scaled.shape[1])])
    if singular[0] <= ILL_CONDITIONED * singular[-1]:
        return
    worst = np.argsort(-np.abs(Vt[-1]))[:3]
    yield Finding(
        "ill_conditioned", "note",
        {
            "condition_number": float(singular[0] / singular[-1]),
            "parameters": tuple(result.determined[i] for i in worst),
        },
        "Measure poses in which the joints differ more, or fix one of these parameters.",
    )  # fmt: skip


def _bounds(result: Calibration) -> Iterator[Finding]:
    at = {name: k for k, name in enumerate(result.determined)}
    told = {p.name for p, _ in impossible(result)}
    for e, p in zip(result.estimates, result.model.parameters, strict=True):
        if e.limits is None or not p.beyond(e.limits) or p.name in told:
            continue
        std = float(np.sqrt(result.covariance[at[e.name], at[e.name]]))
        yield Finding(
            "beyond_bound", "note",
            {
                "parameter": e.name, "unit": e.unit,
                "bound": p.lower if e.held <= p.lower else p.upper, "value": e.held, "std": std,
            },
            AT_BOUND,
        )  # fmt: skip


def only_placed(result: Calibration) -> bool:
    """Whether nothing but base, markers and their like was fitted, as in a calibration of a tool
    or of hand and eye: then the nominal arm is placed by the same fit and no rival to it."""
    return all(
        effect_of(p.effect).registered or e.note.startswith("fixed")
        for p, e in zip(result.model.parameters, result.estimates, strict=True)
    )
