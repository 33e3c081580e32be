"""What a result is worth: each judgement with its numbers, threshold and remedy; in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy import linalg, special

from elastocal.identification import mistakes, noise_summary
from elastocal.identification.faulty_readings import CONVERT, exchanged
from elastocal.identification.noise_structure import CONFIGURATION, JOINTS, TIME, Kind
from elastocal.identification.noise_summary import ResidualSummary
from elastocal.identification.outliers import FEW, kept_of, named_runs
from elastocal.identification.prediction import anywhere, unread_markers
from elastocal.identification.result import Calibration, Finding, made, more_poses
from elastocal.identification.solve import Solution
from elastocal.identification.start import FITS
from elastocal.measurements import Measurements, numbered, told_of_rounding
from elastocal.messages import EXACT, counted, gathered, listed, option, rounded, size_of, together
from elastocal.model.calibrated import MOSTLY, mostly_prior
from elastocal.model.effects.catalogue import effect_of
from elastocal.units import display

# Judged once: terminal, page, notebook and JSON print these findings and judge nothing of their
# own.  A threshold stands here.

STATED = (0.005, 0.995)  # quantiles of χ² between which the residual agrees with the stated noise
# Beside a stated variance of more than twice what the residual shows, an effect as large as all of
# the noise would pass for noise.
FAR_TOO_LARGE = math.sqrt(0.5)
LACK_OF_FIT = 0.01  # p-value below which configurations scatter more than their repeats
# Held-out over fitted error above which the fit flatters itself: as expected, or over what is.
FLATTERS = 1.2
LITTLE = 1.25  # times better than the nominal arm, below which little was gained
# Test data lie where the calibration was not made, or the arm has changed, where their errors are
# this much larger than held-out poses' and chance allows for it in one table of a hundred.
WORSE, CHANCE = 1.25, 0.01
MANY = 0.05  # share of the readings fitted, above which those beyond the noise are no accidents
SCATTERS = 0.01  # p-value below which joints settle anew at each visit, or something drifts
NOT_NORMAL = 0.01  # p-value below which standardised residuals are not normal
# Excess kurtosis of the t distribution with 10 degrees of freedom, of which least squares uses
# 94.5 % of the information: beyond it a robust method is worth its while.
HEAVY = 1.0
FEW_DOF_PER_PARAMETER = 1.0
ILL_CONDITIONED = 1e3  # intervals this many times as wide as if each stood alone
# Equations left between configurations from which their scatter says to a factor of 1.25, with
# 95 % probability, what errors there are beyond the parameters: √(ν/χ²_ν(5 %)) ≤ 1.25; and from
# which it says it to a factor of 1.5.
ENOUGH, COARSE = (
    next(n for n in range(1, 1000) if n <= factor**2 * special.chdtri(n, 0.95))
    for factor in (1.25, 1.5)
)

# How a parameter stands, in the order in which they are told.
ALONE, COMBINED, ABSORBED, INVISIBLE, FIXED = "alone", "combined", "absorbed", "invisible", "fixed"
WEAK, BEYOND, UNREAD = "weak", "beyond", "unread"

_good, _note, _care, _poor = (partial(made, s) for s in ("good", "note", "care", "poor"))


def judged(
    result: Calibration, solution: Solution | None = None, whole: Measurements | None = None
) -> Calibration:
    """The same result with its findings, the overall one ("trust") first.  Without `solution` and
    `whole` table those findings stay that only these can tell."""
    of_solution = list(result.findings)
    if solution is not None and whole is not None:
        of_solution += [*_conditioning(result, solution), *_exchanged(result, whole)]
    found = tuple(_found(result, of_solution))
    poor, care = (tuple(f.kind for f in found if f.severity == s) for s in ("poor", "care"))
    say, doing = (_poor if poor else _care, "") if poor or care else (_good, None)
    return replace(result, findings=(say("trust", doing, because=poor or care), *found))


def _found(result: Calibration, of_solution: list[Finding]) -> Iterator[Finding]:
    compared = list(_against_stated_noise(result))
    fits = any(f.kind == "residual_agrees_with_stated_noise" for f in compared)
    noise = [*compared, *_repeats(result, fits)]
    explained = _explained(result, noise)
    visits, far = (
        list(_visits(result, fits)),
        list(mistakes.far_values(result, explained, _lacking(result))),
    )
    held, nominal, shares = result.heldout_rms, result.nominal_rms, result.prior_share
    if not result.converged:
        yield _poor("not_converged", reason=result.reason)
    if nominal <= held < math.inf and not only_placed(result):
        yield _poor("no_better_than_nominal", heldout_rms_um=held, nominal_rms_um=nominal)
    first = ("knowledge_contradicted", "exchanged_markers")
    yield from (f for f in of_solution if f.kind in first)
    yield from mistakes.impossible_values(result)
    yield from far
    if copies := result.copies:
        fitted = len(result.observations.lead)
        yield _note("copied_readings", copies=len(copies), fitted=fitted, lines=copies)
    # Where all lengths are others than the cell's, so are the compliances to expect.
    if not any(f.kind == "scale" for f in far):
        yield from mistakes.load_unit(result)
    if weak := tuple(name for name, standing in standings(result).items() if standing == WEAK):
        yield _note("hardly_shown", parameters=weak)
    yield from (f for f in visits if f.kind == "scatter_not_counted")
    yield from _alike_in_time(result, explained)
    yield from _few_poses(result)
    yield from (f for f in of_solution if f.kind == "ill_conditioned")
    yield from noise
    yield from (f for f in visits if f.kind != "scatter_not_counted")
    yield from _prediction(result, explained)
    yield from _new_poses(result, explained)
    yield from _bounds(result)
    yield from _faulty(result)
    yield from _undetermined(result)
    if mostly := mostly_prior(shares):
        yield _note("mostly_prior", parameters=mostly, share=tuple(shares[n] for n in mostly))
    if (summary := result.residual_summary) is not None:
        shape = shape_of(summary)  # its remedy, a robust fit, takes no knowledge
        yield replace(shape, remedy="") if result.prior_share or result.active else shape
        if n := sum(g.n_deviating for g in summary.groupings):
            yield _note("scatter_unlike_noise_model", groups=n)
    yield from _test(result)


# Of the residual: known noise explains it.
KNOWN_NOISE = {
    "residual_agrees_with_stated_noise", "residual_below_stated_noise",
    "residual_agrees_with_readings",
}  # fmt: skip


def _explained(result: Calibration, noise: list[Finding]) -> bool:
    """Whether the noise explains what is left, by the findings on it, and held-out poses agree: of
    n equations for p parameters the held-out error is that of the fit times n / (n - p) or more."""
    told = {f.kind for f in noise}
    lacking = any(f.kind == "lack_of_fit" and f.severity == "care" for f in noise)
    agrees = bool(told & KNOWN_NOISE) or {"noise_not_compared", "repeats_agree"} <= told
    expected = result.residual_rms * (len(result.observations.value) / max(result.dof, 1))
    return agrees and not lacking and result.heldout_rms <= FLATTERS * expected


def _alike_in_time(result: Calibration, explained: bool) -> Iterator[Finding]:
    """Residuals of visits that follow each other, by a permutation test.  Where noise explains the
    residual, what they share is a small part, for which the error at new poses has room."""
    found = result.autocorrelation
    if found is None or found.p >= SCATTERS:
        return
    counted = result.noise.drift is not None
    yield (_note if counted or explained else _care)(
        "autocorrelated", "" if counted else None, lag1=found.correlations[0], p=found.p,
        visits=found.visits, by=found.by, counted="yes" if counted else "no",
    )  # fmt: skip


def _few_poses(result: Calibration) -> Iterator[Finding]:
    n = len(result.observations.value) - result.dof
    if result.dof < FEW_DOF_PER_PARAMETER * n:
        yield _note("few_degrees_of_freedom", dof=result.dof, parameters=n)
    if not np.isfinite(result.held_out).all():
        # Test data check it; it matters little where it is the smaller part of the error.
        found, numbers = result.predicted, {}
        if found is not None and math.isfinite(found.unchecked):
            numbers = {"unchecked_um": found.unchecked, "rms_um": found.rms}
        little = found is not None and found.unchecked**2 <= MOSTLY * found.rms**2
        checked = little or result.test is not None
        say, doing = (_note, "") if checked else (_care, more_poses())
        yield say("not_held_out", doing, **numbers)


def _against_stated_noise(result: Calibration) -> Iterator[Finding]:
    if (ratio := result.noise.ratio_to_stated) is None:
        test = result.noise.lack_of_fit
        lacking = test is not None and test.p < LACK_OF_FIT
        yield _note("noise_not_compared", "" if lacking else _state_noise(result))
        return
    tails, size, kurtosis = result.model.cell.noise.tails, result.observations.size, 0.0
    if tails is not None:
        values = (len(result.observations.lead) + len(result.excluded)) * size
        kurtosis = max(kept_of(tails, values, size).excess_kurtosis, 0.0)
    told = result.dof / (1 + kurtosis / 2)  # a mean square varies by (2 + excess kurtosis) / n
    low, high = np.sqrt(special.chdtri(told, 1 - np.array(STATED)) / told).tolist()
    single = result.noise.single
    if single is not None and single.above:
        times = ratio if single.explains else single.ratio
        yield _note(
            "stated_noise_too_small",
            f"Correct [tracker]: by {single.by} single readings scatter {rounded(times, 2)} times "
            "as much as cell or table state.",
            ratio=single.ratio, dof=single.dof, by=single.by, p_rest=single.rest,
        )  # fmt: skip
    say, kind, doing = _good, "residual_agrees_with_stated_noise", None
    readings = result.observations, result.residual
    spent = len(result.residual) - result.dof
    if (share := noise_summary.less_in_common(*readings, result.model.cell, spent)) is not None:
        doing, remedy = "", noise_summary.TOO_LARGE_IN_COMMON.format(share)
        far = _care if share < FAR_TOO_LARGE else _note
        yield far("common_noise_too_large", remedy, ratio=share)
    if ratio > high and not (single is not None and single.explains):
        say, kind, doing = _care, "residual_above_stated_noise", _lacking(result)
    elif ratio > high:
        kind = "residual_agrees_with_readings"
    elif ratio < low:
        say = _care if ratio < FAR_TOO_LARGE else _note
        kind = "residual_below_stated_noise"
    chance = {"by_chance_from": low, "by_chance_to": high}
    yield say(kind, doing, ratio=float(ratio), **chance, dof=result.dof)


def _named(result: Calibration) -> list[str]:
    effects = dict.fromkeys(p.effect for p in result.model.parameters)
    usual = [e for e in effects if e in mistakes.STATED_BY_FILE or effect_of(e).registered]
    return [e.replace("_", " ") for e in effects if e not in usual]


def _state_noise(result: Calibration) -> str:
    keys, ask = "sigma_um, or range_um and transverse_um", "elastocal diagnose looks for that"
    keys = "distance_um" if result.model.observe == "distance" else keys
    keys = f"{keys}, and rotation_urad" if result.model.observe == "pose" else keys
    return (
        f"State the tracker's noise ([tracker] {keys}): only beside it does the residual say "
        f"whether the model lacks something.{'' if _named(result) else f' {ask} either way.'}"
    )


def _rounded(result: Calibration) -> str | None:
    scatter = np.array([s.sigma for s in result.noise.sizes or () if s.joints and s.sigma])
    if not len(scatter):
        return None
    return told_of_rounding(result.observations.table, result.model.chain.turning, scatter)


def _lacking(result: Calibration) -> str:
    if rounding := _rounded(result):
        return rounding
    if named := _named(result):
        return (
            f"The cell has {listed(named, 3)} already. If diagnose named that, it has no name for "
            "what is left: repeat some poses, which tell noise and repeatability from what the "
            "model lacks."
        )
    ask = "Ask what the model lacks: elastocal diagnose with the same cell and data."
    if result.excess is None:  # no noise is known that the residual could exceed
        return ask
    return (
        f"{ask} Where it finds nothing, the excess is the robot's repeatability"
        f"{', or noise larger than stated ([tracker])' * bool(result.noise.ratio_to_stated)}."
    )


def _repeats(result: Calibration, fits: bool) -> Iterator[Finding]:
    """Do configurations scatter more than their repeats?  Where the residual `fits` a stated noise
    of which readings share some, nothing is missing."""
    noise, test = result.noise, result.noise.lack_of_fit
    sizes = [s for s in noise.sizes or () if s.part == CONFIGURATION]
    shared = {s.name: s.sigma for s in sizes if s.sigma is not None}
    if test is not None:
        # These hold where the readings of a configuration are correlated.
        counted = "the intervals" if noise.interval_kind.lower().startswith("cr") else "nothing"
        if shared or noise.drift is not None:
            counted = "the noise model"
        say, kind, doing = _good, "repeats_agree", ""
        if test.p < LACK_OF_FIT:
            known = fits and result.model.cell.noise.shared and counted == "the noise model"
            say, kind = _note if known else _care, "lack_of_fit"
            doing = "" if known else _lacking(result)
        dofs = {"dof_between": test.dof_between, "dof_pure": test.dof_pure}
        yield say(kind, doing, F=test.F, **dofs, p=test.p, counted_by=counted)
    if shared:
        yield _note("common_deviation", of=tuple(shared), sigma_um=tuple(shared.values()))


def _visits(result: Calibration, fits: bool) -> Iterator[Finding]:
    """Joints that settle anew at each visit, and a drift: what a test of false-alarm rate SCATTERS
    finds, whether the noise model has it or not."""
    noise, stated = result.noise, result.model.cell.noise
    ask = "Repeat some poses" if _named(result) else "Ask what the model lacks (elastocal diagnose)"
    sizes = [s for s in noise.sizes or () if s.sigma]
    scatter = stated.of_joints(result.model.chain.n_joints)
    joints = [s for s in sizes if s.joints]
    for test in noise.tests:
        if test.p >= SCATTERS:
            continue
        if test.part == JOINTS and joints:
            said = [(s, float(np.sqrt((scatter[list(s.joints)] ** 2).mean()))) for s in joints]
            remedy = (
                "Measure more poses, not more repeats, and approach each from the same side: the "
                f"joints settle anew at every visit. {_beside_stated('joints_urad', said, fits)}"
            )
            of, sigma = zip(*((s.name, s.sigma) for s in joints), strict=True)
            remedy = _rounded(result) or remedy
            yield _note("joint_scatter", remedy, of=of, p=test.p, sigma_urad=sigma)
        elif test.part == TIME and (drift := noise.drift) is not None:
            for size in [s for s in sizes if s.part == TIME][:1]:
                timed = drift.seconds is not None
                remedy = (
                    "Measure poses and loads in random order, return to a reference pose every ten "
                    f"poses, {'' if timed else 'record times, '}and let arm and tracker warm up. "
                    f"{_beside_stated('drift_um', [(size, stated.drift)], fits)}"
                )
                if not drift.ends:
                    remedy += (
                        " It may last as long as the campaign: these readings do not tell it from "
                        "a random walk, nor where the base is on another day; measure for longer, "
                        "or on several days."
                    )
                yield _care(
                    "drift", remedy, sigma_um=size.sigma, p=test.p, lasting_s=drift.seconds,
                    lasting_share=drift.share, by="times" if timed else "order of the rows",
                )  # fmt: skip
        else:
            known = scatter.any() if test.part == JOINTS else stated.drift > 0
            remedy = (
                "Fit with the scatter that [noise] of the cell states: "
                f"{option('noise', Kind.parsed(noise.kind).with_stated(stated).name)}."
                if known
                else f"{ask}: residuals change from visit to visit or in time, and noise that "
                "does so does not predict poses better."
            )
            yield _care("scatter_not_counted", remedy, part=test.part, p=test.p)


def _beside_stated(key: str, found: list[tuple[noise_summary.NoiseSize, float]], fits: bool) -> str:
    if not (said := listed([rounded(1e6 * size) for _, size in found if size])):
        return f"State it as [noise] {key} in the cell for design and simulate."
    if all(size.agrees_with(stated) for size, stated in found):
        return f"It agrees with [noise] {key} of the cell ({said})."
    if fits:  # parts of the noise that are alike have their sum alone told
        return f"The cell states it: [noise] {key} ({said})."
    return f"Correct [noise] {key} of the cell ({said}) for design and simulate."


def _prediction(result: Calibration, explained: bool) -> Iterator[Finding]:
    held, fitted, nominal = result.heldout_rms, result.residual_rms, result.nominal_rms
    placed = only_placed(result)
    # Under a drift the held-out error is that of another day, which more poses make no better.
    # Of base and tool alone, what each point takes of the fit is all that it can flatter by.
    # What n and p let expect decides, so that the noise of a campaign does not; and what exceeds
    # it: at 25 poses held / (fitted · expected) has a standard deviation of 0.04.
    expected = len(result.observations.value) / max(result.dof, 1)
    flatters = expected > FLATTERS or held > FLATTERS * expected * fitted
    flatters = flatters and EXACT < held < math.inf and not (placed and explained)
    if flatters and result.noise.drift is None:
        yield _care("fit_flatters", heldout_rms_um=held, residual_rms_um=fitted)
    if held < nominal < LITTLE * held < math.inf and not placed:
        yield _care("little_gain", heldout_rms_um=held, nominal_rms_um=nominal)


def _new_poses(result: Calibration, explained: bool) -> Iterator[Finding]:
    """Is what is said of poses that nobody measured founded: on enough configurations, on a noise
    that is known, on parameters that the readings show?"""
    # Where base and tool alone are sought, as by a dozen touches of a tip, the stated noise judges
    # the fit, and no scatter has to be learnt from it: a coarser look is enough.
    wanted = COARSE if explained and only_placed(result) else ENOUGH
    # A rigid body's place is six numbers in each load state, however many markers it has and
    # however often they are read.
    observed, table, lead = result.observations, result.observations.table, result.observations.lead
    code = numbered(observed.configuration, observed.load)
    seen = code[np.unique(numbered(code, table.marker[lead]), return_index=True)[1]]
    size = 1 if observed.kind == "distance" else observed.size
    equations = int(np.minimum(size * np.bincount(seen), 6).sum())
    left = equations - int(np.sum(~result.model.shrunk[result.columns]))
    if left < wanted:
        yield _care(
            "few_configurations", configurations=result.observations.n_configurations,
            parameters=len(result.observations.value) - result.dof,
            equations_left=left, needed=wanted,
        )  # fmt: skip
    if result.excess is None:
        yield _care("noise_unknown", _state_noise(result))
    found = result.predicted
    if found is None:
        return
    low, high = found.ci95
    numbers = {"from_um": low, "to_um": high, "poses": found.poses, "source": found.source}
    yield _note("new_poses", rms_um=found.rms, **numbers)
    if found.open**2 > MOSTLY * found.rms**2:
        numbers = {"open_um": found.open, "heldout_rms_um": result.heldout_rms}
        told = " For a part of the joint ranges alone, state test poses in the cell."
        remedy = more_poses() + told * (not result.model.cell.design.states_test_poses)
        yield _care("new_poses_not_shown", remedy, **numbers, parameters=found.blamed)
    if found.rms > result.nominal_rms / LITTLE and not only_placed(result):
        yield _care("new_poses_no_gain", rms_um=found.rms, nominal_rms_um=result.nominal_rms)


def _faulty(result: Calibration) -> Iterator[Finding]:
    fitted, kept = len(result.observations.lead), len(result.outliers)
    many = (gone := len(result.excluded)) > FEW * (fitted + gone)
    if n := kept + gone:
        remedy = f"Check the {counted(n, 'reading')} beyond the noise."
        shifted = result.faulty_report.shifted if result.faulty_report else []
        if shifted:
            remedy += f" One common shift{' each' * (len(shifted) > 1)} explains "
            remedy += f"{listed(map(str, shifted), 4)}: look for what moved there, a marker or the "
            remedy += "tracker."
        if many:
            lines = [o.line for o in result.excluded]
            sound = result.observations.table.row[result.observations.lead]
            if min(lines) > sound.max() or max(lines) < sound.min():
                remedy += " All stand at one end of the table, as after "
                far = np.median([o.residual for o in result.excluded]) > FITS
                remedy += f"the tracker was moved. {CONVERT}." if far else "a jump: ask diagnose."
        numbers = {"left_out": gone, "heldout_all_rms_um": result.heldout_all_rms}
        numbers["shifted"] = sum(len(f.readings) for f in shifted)
        yield _note("faulty_readings", remedy, fitted=kept, **numbers)
    if kept > MANY * fitted:
        yield _care("many_faulty_readings", faulty=kept, fitted=fitted)
    if many:
        yield _care("many_left_out", left_out=gone, fitted=fitted)


def _undetermined(result: Calibration) -> Iterator[Finding]:
    all_of_them = standings(result)
    lacking = [e.name for e in result.ordinary if all_of_them[e.name] in (INVISIBLE, ABSORBED)]
    redundant = () if result.left is None else result.left.redundant
    shown = tuple(name for name in lacking if name not in redundant)
    if n := len(lacking) - len(shown):
        yield _good("redundant", parameters=n)
    if unread := tuple(name for name, standing in all_of_them.items() if standing == UNREAD):
        none = no_reading(result)
        it = "them" if "of markers " in none else "it"
        remedy = f"There is {none}: measure {it}, or delete {it} from [tool.markers_m]."
        yield _note("markers_not_read", remedy, parameters=unread)
    if n := len(shown):
        remedy = (
            f"{counted(n, 'parameter')} cannot be determined from these data "
            f"({listed(shown, 4)}). Predictions hold for poses and loads like those measured; for "
            "others, measure what shows them."
        )
        still = np.flatnonzero(np.ptp(result.observations.table.q, axis=0) == 0)
        if len(still) and not all(name.endswith(".compliance") for name in shown):
            names, its = f"Joint {still[0] + 1} never moves", "move it, or check its column"
            if len(still) > 1:
                names = f"Joints {together([str(j + 1) for j in still])} never move"
                its = "move them, or check their columns"
            remedy = f"{names} in these data: {its}. {remedy}"
        yield _note("undetermined", remedy, parameters=n, names=shown)


def _unread(result: Calibration) -> list[str]:
    excluded = {f"marker:{o.marker}" for o in result.excluded}
    return [p for p in unread_markers(result.model, result.observations.table) if p not in excluded]


def no_reading(result: Calibration) -> str:
    names = [place.removeprefix("marker:") for place in _unread(result)]
    s, itself = ("s", "themselves") if len(names) > 1 else ("", "itself")
    source = result.observations.table.source
    return f"no reading of marker{s} {listed(names, 4)} {itself} in {source}"


def standings(result: Calibration) -> dict[str, str]:
    """Parameter name → ALONE, COMBINED (first of a combination), ABSORBED, WEAK (hardly shown),
    BEYOND (its physical bound), UNREAD (of a marker without readings), INVISIBLE or FIXED."""
    unread = _unread(result)
    first, found = {next(iter(c.terms)) for c in result.combinations}, {}
    for p, e in zip(result.model.parameters, result.estimates, strict=True):
        found[p.name] = UNREAD if p.where in unread else INVISIBLE
        if e.limits is not None:
            found[p.name] = BEYOND if p.beyond(e.limits) else WEAK
        elif e.identifiable:
            found[p.name] = ALONE
        elif e.name in first:
            found[p.name] = COMBINED
        elif e.combined_with:
            found[p.name] = ABSORBED
        elif e.note.startswith("fixed"):
            found[p.name] = FIXED
    return found


def shape_of(summary: ResidualSummary) -> Finding:
    whole = summary.whole
    skew, kurtosis, p = whole.skewness, whole.excess_kurtosis, whole.normality_p
    say, kind = _note, "residuals_too_few"
    if p is not None and p >= NOT_NORMAL:
        say, kind = _good, "residuals_normal"
    elif p is not None:
        # Of a normal sample, kurtosis has twice the standard deviation of skewness.
        skewed = abs(skew) > abs(kurtosis) / 2
        tails = "residuals_heavy_tailed" if kurtosis > 0 else "residuals_light_tailed"
        kind = "residuals_skew" if skewed else tails
        say = _care if kind == "residuals_heavy_tailed" and kurtosis > HEAVY else _note
    return say(kind, skewness=skew, excess_kurtosis=kurtosis, p=p)


def _test(result: Calibration) -> Iterator[Finding]:
    """Test data against held-out poses, by an F-test; a reading's components count as one."""
    test, held = result.test, result.heldout_rms
    if test is None:
        yield _note("untested")
        return
    if math.isfinite(held):
        allowed = math.sqrt(special.fdtri(test.n, result.dof, 1 - CHANCE))
        if test.rms > max(WORSE, allowed) * held:
            yield _care("test_data_worse", test_rms_um=test.rms, heldout_rms_um=held)
    if test.p_far < CHANCE:
        yield _care(
            "test_data_far", far=test.far, configurations=test.configurations, p=test.p_far,
            predicted_std_um=test.std, fitted_std_um=test.most_fitted,
        )  # fmt: skip


def _exchanged(result: Calibration, whole: Measurements) -> Iterator[Finding]:
    if (found := exchanged(result.model, whole)) is not None:
        rows, markers, words = found
        lines = whole.row[rows]
        fitted = np.isin(lines, result.observations.table.row).any()
        yield (_care if fitted else _note)(
            "exchanged_markers", words, markers=markers, rows=len(lines),
            lines=tuple(lines.tolist()),
        )  # fmt: skip


def _conditioning(result: Calibration, solution: Solution) -> Iterator[Finding]:
    # Unit columns: what is judged is how far they are from parallel, not their units.  What has a
    # prior of its own is noise to the others.
    reduction, factor = solution.reduction, solution.fit.r_factor
    random = np.isin(reduction.kept, reduction.with_prior)
    own = np.flatnonzero(~random)
    if factor.columns > len(own):
        factor = factor.of_columns(np.append(np.flatnonzero(random), own))
    scaled = factor.R[factor.columns - len(own) :, factor.columns - len(own) :]
    _, singular, Vt = linalg.svd(scaled / np.linalg.norm(scaled, axis=0))
    if singular[0] > ILL_CONDITIONED * singular[-1]:
        worst = tuple(result.determined[own[i]] for i in np.argsort(-np.abs(Vt[-1]))[:3])
        condition = float(singular[0] / singular[-1])
        remedy = None
        if (B := anywhere(solution)) is not None:
            B = B[:, reduction.kept[own]]
            if np.linalg.cond(B / np.maximum(np.linalg.norm(B, axis=0), EXACT)) > ILL_CONDITIONED:
                remedy = "Fix one of these: no poses separate them better under these loads."
        yield _note("ill_conditioned", remedy, condition_number=condition, parameters=worst)


def _bounds(result: Calibration) -> Iterator[Finding]:
    at = {name: k for k, name in enumerate(result.determined)}
    told = {p.name for p, _ in mistakes.impossible(result)}
    for e, p in zip(result.estimates, result.model.parameters, strict=True):
        if e.limits is None or not p.beyond(e.limits) or p.name in told:
            continue
        std = float(np.sqrt(result.covariance[at[e.name], at[e.name]]))
        bound = p.lower if e.held <= p.lower else p.upper
        numbers = {"unit": e.unit, "bound": bound, "value": e.held, "std": std}
        yield _note("beyond_bound", parameter=e.name, **numbers)


def only_placed(result: Calibration) -> bool:
    """Whether nothing but base, markers and their like was fitted: then the nominal arm is placed
    by the same fit and no rival to it."""
    return all(
        effect_of(p.effect).registered or e.note.startswith("fixed")
        for p, e in zip(result.model.parameters, result.estimates, strict=True)
    )


# What a warning says of a finding: its numbers and its remedy by name.
SENTENCES = {
    "copied_readings": "Readings that repeat others to the last digit were excluded ({lines}): "
    "copies add no information and make intervals too narrow. {remedy}",
    "impossible_values": "Impossible values: {parameters} beyond a physical bound by more than 5 "
    "standard deviations.",
    **dict.fromkeys(("load_unit", "exchanged_markers", "scatter_not_counted"), "{remedy}"),
    "not_converged": "The fit did not converge: {reason}. {remedy}",
    "knowledge_contradicted": "The readings contradict {stated}: without, they are fitted better "
    "than noise explains (F = {F:.1f} on {dof_stated} and {dof_readings:.0f} degrees of freedom, "
    "{p}). {remedy}",
    "few_degrees_of_freedom": "Only {dof} degrees of freedom for {parameters} determined "
    "parameters: intervals are wide and the residual is too small. {remedy}",
    "not_held_out": "Some configuration alone determines a parameter, so there is no held-out "
    "error for it. Measure more configurations.",
    "ill_conditioned": "Ill-conditioned (condition number {condition_number} after scaling): the "
    "data barely separate {parameters}. {remedy}",
    "residual_above_stated_noise": "The residual is {ratio:.1f} times the stated noise: an effect "
    "is missing or the stated noise is too small. Intervals use the residual, not the stated "
    "noise. {look}.",
    "lack_of_fit": "Configurations scatter more than their repeats (lack of fit: F = {F:.2f} on "
    "{dof_between} and {dof_pure} degrees of freedom, {p}): the arm does not return to the same "
    "place, or an effect is missing. The intervals do not include it and are too narrow: "
    "{use}measure more configurations rather than more repeats.",
    "drift": "Base or tracker drift during the session ({sigma_um} µm{along}, by the {by}; {p}). "
    "Weights and intervals account for it, and whole blocks in time are held out. {remedy}",
    "joint_scatter": "The joints settle anew at every visit of the arm (standard deviation "
    "{sigma_urad} µrad; {p}). Weights and intervals account for it. {remedy}",
    "many_faulty_readings": "Too many for reading errors: a shifted block of readings, or a "
    "missing effect in some load state, marker or region. {remedy}",
}
DIGITS = {"condition_number": 2, "sigma_um": 3}  # of numbers in them


def warning_sentences(result: Calibration) -> dict[str, str]:
    """The findings that call for attention as sentences, with the kind of each; alike ones once."""
    groups: dict[Any, list[Finding]] = {}
    for k, f in enumerate(result.findings):
        beyond = f.kind == "beyond_bound"
        alike = (f.numbers["bound"], f.numbers["unit"]) if beyond else k
        groups.setdefault(alike, []).append(f)
    return {text: same[0].kind for same in groups.values() for text in _told(result, same)}


def _told(result: Calibration, same: list[Finding]) -> Iterator[str]:
    f = same[0]
    if f.kind == "faulty_readings":
        if kept := result.outliers:
            yield (
                f"{counted(len(kept), 'reading lies', 'readings lie')} beyond what the noise "
                f"explains ({_runs(o.line for o in kept)}), and in the fit. Check the table there; "
                f"{option('outliers', 'drop')} excludes such readings."
            )
        if apart := result.excluded:
            yield (
                f"{counted(len(apart), 'outlier was', 'outliers were')} excluded "
                f"({_runs(o.line for o in apart)}) as mistakes. If the arm was there, its error at "
                f"new poses is larger than told: {option('outliers', 'keep')} tells it. "
                "All are listed in the result as 'excluded'."
            )
    elif f.kind in SENTENCES and f.numbers.get("counted_by", "nothing") == "nothing":
        words = {
            k: ", ".join(one if isinstance(one, str) else rounded(one) for one in v)
            if isinstance(v, tuple) else rounded(v, DIGITS[k]) if k in DIGITS else v
            for k, v in f.numbers.items()
        }  # fmt: skip
        words["along"] = "" if result.model.observe == "distance" else " in each direction"
        words["p"] = size_of(f.number("p")) if "p" in words else ""
        default = "the default method, whose noise model has this scatter"
        use = [default] * (not result.noise.estimated)
        use += ["intervals by cr2"] * (not (result.prior_share or result.active))
        words["use"] = f"use {', or '.join(use)}; " if use else ""
        ask = f.remedy.startswith("Ask")
        words["look"] = "Look for missing effects (diagnose)" if ask else "Repeat some poses"
        words["remedy"] = f.remedy
        if f.kind == "copied_readings":
            words["lines"] = _runs(result.copies)
        yield SENTENCES[f.kind].format(**words)
    elif f.kind == "beyond_bound":
        yield _beyond(same)


def _beyond(same: list[Finding]) -> str:
    """Of parameters beyond one bound."""
    names, unit = [f.numbers["parameter"] for f in same], str(same[0].numbers["unit"])
    values, stds, (bound, *_) = (
        [rounded(display(f.number(name), unit)[0], digits) for f in same]
        for name, digits in (("value", 3), ("std", 2), ("bound", 3))
    )
    unit, remedy = display(0.0, unit)[1], same[0].remedy
    each = listed(map("{} ± {}".format, values, stds), 4)
    text = f"{gathered(names)} lie beyond their physical bound {bound} {unit} ({each})"
    if len(same) == 1:
        text = f"{names[0]} = {each} {unit} lies beyond its physical bound {bound}"
    return f"{text}: {remedy[:1].lower()}{remedy[1:]}"


def _runs(lines: Iterable[int]) -> str:
    runs = named_runs(numbers := list(lines))
    word = "line" if len(numbers) == 1 else "lines"
    return f"{word} {', '.join(runs[:8])}{' …' if len(runs) > 8 else ''}"


# Of these the warning says what to do.
TOLD_ELSEWHERE = {"beyond_bound"} | {kind for kind, text in SENTENCES.items() if "{remedy}" in text}


SLIGHT = 0.1  # of the error at new poses: what is open by less raises it by half a percent


def next_steps(result: Calibration) -> list[Finding]:
    """Findings whose remedy is still to be told, each remedy once, the worthiest first."""
    steps = {f.remedy: f for f in reversed(result.findings) if f.kind not in TOLD_ELSEWHERE}
    # One that begins with another says that too.
    order = [f for f in result.findings if f.remedy and steps.get(f.remedy) is f
             and not any(s != f.remedy and s.startswith(f.remedy) for s in steps)]  # fmt: skip
    found, ranks = result.predicted, ("poor", "care", "note", "good", "trust", "undetermined")
    slight = found is not None and found.open < SLIGHT * found.rms
    last = {"trust", "undetermined"} if slight else {"trust"}
    return sorted(order, key=lambda f: ranks.index(f.kind if f.kind in last else f.severity))
