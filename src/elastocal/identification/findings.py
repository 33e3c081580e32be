"""What a result is worth: each judgement with its numbers, its threshold and what to do."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy import linalg, special

from elastocal.errors import option
from elastocal.identification import noise_summary
from elastocal.identification.mistakes import exchanged
from elastocal.identification.noise_structure import CONFIGURATION, JOINTS, TIME, Kind
from elastocal.identification.noise_summary import ResidualSummary
from elastocal.identification.outliers import kept_of
from elastocal.identification.prediction import unread_markers
from elastocal.identification.result import Calibration, Estimate, Finding
from elastocal.identification.sentences import AT_BOUND, made, more_poses
from elastocal.identification.solve import Solution, far_off
from elastocal.identification.start import OF_A_TARGET, SCALED, LinearFits
from elastocal.measurements import Measurements, numbered
from elastocal.model.arm import Parameter
from elastocal.model.calibrated import MOSTLY, mostly_prior
from elastocal.model.effects.base import index
from elastocal.model.effects.catalogue import effect_of
from elastocal.model.effects.compliances import (
    RATED_WIND_UP,
    JointCompliance,
    rated_torque,
    usual_over_stated_mass,
    weight_torque,
)
from elastocal.model.effects.gears import JointOffset
from elastocal.model.effects.placements import LinkGeometry, MarkerOrientation, TrackerDistortion
from elastocal.text import EXACT, counted, listed, rounded

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
# Factor to which the compliances of an arm are known before: those of the KR 270 are 0.8 times what
# its links' weights let expect, and 1.5 times what its length does.
EXPECTED_TO = 2.0
SURELY = 5.0  # standard deviations beyond a physical bound, by which no estimate errs by chance
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
    """The same result with its findings, the overall one ("trust") first.

    Some only the `solution` and the `whole` table can tell; without them those of the result stay.
    """
    of_solution = list(result.findings)
    if solution is not None and whole is not None:
        of_solution = [*_conditioning(result, solution), *_exchanged(result, whole)]
    found = tuple(_found(result, of_solution))
    return replace(result, findings=(_trust(found), *found))


def _found(result: Calibration, of_solution: list[Finding]) -> Iterator[Finding]:
    """All but the overall one, in the order in which they are told."""
    compared = list(_against_stated_noise(result))
    fits = any(f.kind == "residual_agrees_with_stated_noise" for f in compared)
    noise = [*compared, *_repeats(result, fits)]
    explained = _explained(result, noise)
    visits, far = list(_visits(result, fits)), list(_far_values(result, explained))
    held, nominal, shares = result.heldout_rms, result.nominal_rms, result.prior_share
    if not result.converged:
        yield _poor("not_converged", reason=result.reason)
    if nominal <= held < math.inf and not only_placed(result):
        yield _poor("no_better_than_nominal", heldout_rms_um=held, nominal_rms_um=nominal)
    yield from (f for f in of_solution if f.kind == "exchanged_markers")
    yield from _impossible(result)
    yield from far
    if copies := result.copies:
        fitted = len(result.observations.lead)
        yield _note("copied_readings", copies=len(copies), fitted=fitted, lines=copies)
    # Where all lengths are others than the cell's, so are the compliances to expect.
    if not any(f.kind == "scale" for f in far):
        yield from _load_unit(result)
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
        yield shape_of(summary)
        if n := sum(g.n_deviating for g in summary.groupings):
            yield _note("scatter_unlike_noise_model", groups=n)
    yield from _test(result)


def _trust(found: tuple[Finding, ...]) -> Finding:
    for say, severity in ((_poor, "poor"), (_care, "care")):
        if doubts := tuple(f.kind for f in found if f.severity == severity):
            return say("trust", "", because=doubts)
    use = (
        "Use it (elastocal compensate, elastocal export) where poses and loads are like those "
        "measured."
    )
    return _good("trust", use, because=())


# Of the residual: known noise explains it.
KNOWN_NOISE = {
    "residual_agrees_with_stated_noise", "residual_below_stated_noise",
    "residual_agrees_with_readings",
}  # fmt: skip


def _explained(result: Calibration, noise: list[Finding]) -> bool:
    """Whether the noise explains what is left, by the findings on it, and held-out poses agree.

    Of n equations for p parameters the held-out error is that of the fit times n / (n - p) or more.
    """
    told = {f.kind for f in noise}
    lacking = any(f.kind == "lack_of_fit" and f.severity == "care" for f in noise)
    agrees = bool(told & KNOWN_NOISE) or {"noise_not_compared", "repeats_agree"} <= told
    expected = result.residual_rms * _overfitted(result)
    return agrees and not lacking and result.heldout_rms <= FLATTERS * expected


def _overfitted(result: Calibration) -> float:
    return len(result.observations.value) / max(result.dof, 1)


# Loads in another unit.
#
# Deflections tell compliance times load: loads that are too small by a factor make every
# compliance too large by it, without a trace in the residual.

KILOGRAMS = 9.80665  # N, the weight of one


def _load_unit(result: Calibration) -> Iterator[Finding]:
    """Are all compliances about as much too large as kilograms for newtons make them, or too small?

    Without a load there is no unit of one.  What they should be about is what the cell states, else
    what winds each revolute joint up by RATED_WIND_UP at its rated torque, by the links' weights.
    The median of the ratios has to be that factor to within what arms differ from what is expected
    of them (EXPECTED_TO).  By the links' weights, a rule of thumb, it is worth a look, and no more.
    """
    model, chain = result.model, result.model.chain
    known = {e.name: e.value for e in result.ordinary if e.value is not None}
    # Turned round, the loads may be in another unit as well: then the sizes tell.
    known |= {p.name: abs(e.held) for p, e in impossible(result)}
    given, rated, heavier = list[float](), list[float](), usual_over_stated_mass(chain)
    for p in model.parameters if result.observations.table.force.any() else ():
        value = known.get(p.name, 0.0)
        if p.effect != JointCompliance.name or value <= 0:
            continue
        i = index(p.where)
        if p.nominal > 0:
            given.append(value / p.nominal)
        elif chain.kinds[i] == "revolute" and weight_torque(chain, i) > 0:
            torque = rated_torque(chain, model.cell, i) or 0.0
            rated.append(value * heavier * torque / RATED_WIND_UP)
    if not (ratios := given or rated):
        return
    ratio, by = float(np.median(ratios)), "the cell's nominal compliances"
    if not given:
        by = "the weights of the links" if heavier == 1 else "the length of the arm"
    if abs(abs(math.log(ratio)) - math.log(KILOGRAMS)) > math.log(EXPECTED_TO):
        return
    unit, cause, undo = (
        ("kilograms", "the force columns hold kilograms", "multiply")
        if ratio > 1
        else ("newtons times 9.81", "newtons were multiplied by 9.81", "divide")
    )
    remedy = (
        f"Check the unit of the loads: the compliances are {rounded(ratio, 2)} times those "
        f"expected from {by}, as where {cause}. If so, {undo} force_x_N, force_y_N "
        "and force_z_N by 9.81."
    )
    yield (_care if given else _note)("load_unit", remedy, ratio=ratio, by=by, unit=unit)


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
    if not (found := impossible(result)):
        return
    springs = [p for p in result.model.parameters if p.effect == JointCompliance.name]
    turned = [p for p, _ in found if p.effect == JointCompliance.name]
    signs = 2 * len(turned) > len(springs) and bool(result.observations.table.force.any())
    parameters, estimates = zip(*found, strict=True)
    turn_round = (
        "Check the sign of the force columns: where z points up, force_z_N of a hanging load is "
        "negative. Turn the sign round in the table if it is wrong (torque columns too), and "
        "identify again."
    )
    yield (_poor if signs else _care)(
        "impossible_values", turn_round if signs else AT_BOUND,
        parameters=tuple(p.name for p in parameters), values=tuple(e.held for e in estimates),
        units=tuple(p.unit for p in parameters),
        likely="the sign of the force columns" if signs else "",
    )  # fmt: skip


# Values far from nominal: a joint to remaster, a robot file of another arm, a missing effect.
#
# How large a value is says nothing by itself.  Where the noise explains what is left and held-out
# poses agree, the value is what the arm has; where much is left, a value that no arm has stands in
# for what the model lacks.

LARGEST = 0.5  # beyond it the points hardly move, as of a tip that touches one, or do so otherwise
NEARLY = 0.1  # share of the square that a scale leaves of what it explains
SOME = 400  # readings that are enough for it
FEWEST_POSES = 8
# What the nominal arm states and a first cell fits.  Base and markers are guesses, and any other
# effect is in the cell because someone named it: their sizes are findings, no evidence.
STATED_BY_FILE = (JointOffset.name, LinkGeometry.name, JointCompliance.name)


def _far_values(result: Calibration, explained: bool) -> Iterator[Finding]:
    """Values whose whole interval lies more than FAR typical deviations from nominal, of a
    combination all that it may hold; doubted unless the noise explains the residual, and held-out
    poses agree (`explained`)."""
    ends = {e.name: e.ci95 for e in result.estimates if e.ci95 is not None}
    typical = {p.name: p.typical or 0.0 for p in result.model.parameters}
    for c in result.combinations:
        name = next(iter(c.terms))
        ends[name] = c.ci95
        typical[name] = math.hypot(*(share * typical[n] for n, share in c.terms.items()))
    half = {name: (high - low) / 2 for name, (low, high) in ends.items()}
    far = [
        (p, x - p.nominal, times)
        for p, x in zip(result.model.parameters, result.x.tolist(), strict=True)
        if p.effect in STATED_BY_FILE and p.typical and p.name in half
        and (times := far_off(x - p.nominal, half[p.name], typical[p.name]))
    ]  # fmt: skip
    if zeros := [(p, off) for p, off, _ in far if p.effect == JointOffset.name]:
        told = [f"{p.where.replace('joint', 'joint ')} is off by {_size(off, p.unit)} (known to "
                f"{_size(half[p.name], p.unit)})" for p, off in zeros]  # fmt: skip
        turned = zeros[-1][0].where == f"joint{result.model.chain.n_joints}"
        turned &= result.observations.kind == "pose"
        turned &= MarkerOrientation.name not in {p.effect for p in result.model.parameters}
        yield _note(
            "joint_zero",
            f"The zero of {listed(told)}: remaster it, or command the arm by this calibration."
            + " Where the target is mounted at an angle, fit marker_orientation." * turned,
            joints=tuple(p.where for p, _ in zeros), values=tuple(v for _, v in zeros),
            units=tuple(p.unit for p, _ in zeros), ci95_half=tuple(half[p.name] for p, _ in zeros),
        )  # fmt: skip
    if (scale := scale_of(result)) is not None:
        other = abs(scale - 1) > OF_A_TARGET
        likely = "another robot" if other else "a scale error"
        remedy = (
            "Check that the cell describes the robot that was measured ([robot]): no target or "
            "scale bar is wrong by so much."
            if other
            else "Look for what scales the readings: the size stated of a tag or scale bar, or a "
            f"unit. Multiplied by {rounded(1 / scale, 4)} they have the robot's file's lengths."
        )
        yield _care("scale", remedy, readings_over_file=scale, likely=likely)
        return
    others = sorted((f for f in far if f[0].effect != JointOffset.name), key=lambda f: -f[2])
    if others:
        told = [f"{p.name} by {_size(off, p.unit)} ({_size(half[p.name], p.unit)})"
                for p, off, _ in others]  # fmt: skip
        compare = (
            "The arm is not the one of the robot's file: compare its lengths and angles with the "
            f"data sheet (off, and known to: {listed(told, 3)})."
        )
        yield (_note if explained else _care)(
            "far_from_nominal" if explained else "unheard_of",
            compare if explained else _lacking(result),
            parameters=tuple(p.name for p, *_ in others),
            typical_sizes=tuple(times for *_, times in others),
            values=tuple(off + p.nominal for p, off, _ in others),
            units=tuple(p.unit for p, *_ in others), readings_set_apart=len(result.excluded),
        )  # fmt: skip


def scale_of(result: Calibration) -> float | None:
    """By what factor all lengths that were read exceed those of the nominal arm; None where no such
    scale shows.

    The linear map A of the readings onto the nominal arm is a rotation with a scale where that is
    wrong.  One that takes nine tenths of the square away, differs less between directions than from
    one, and is larger than any arm's lengths err together, is one of the readings.
    """
    table = result.observations.table
    own = any(p.effect == TrackerDistortion.name for p in result.model.parameters)
    if table.position is None or own or len(np.unique(table.q, axis=0)) < FEWEST_POSES:
        return None
    extent = float(np.linalg.norm(np.ptp(table.position, axis=0)))
    if not SCALED * extent / 10 < result.nominal_rms < math.inf:
        return None
    table = table.take(result.observations.lead[:: max(len(result.observations.lead) // SOME, 1)])
    flange = result.model.rigid.flange_poses(table)
    found = LinearFits(flange[None], np.asarray(table.position), table.marker)
    if not 3 * found.left[0] ** 2 < NEARLY * result.nominal_rms**2:
        return None
    size = np.linalg.svd(found.matrix[0], compute_uv=False)
    off = abs(float(found.scale[0]) - 1)
    alike = found.determinant[0] > 0 and size[0] - size[-1] < off
    return 1 / float(found.scale[0]) if alike and SCALED < off < LARGEST else None


def _size(value: float, unit: str) -> str:
    number, unit = {"m": (value * 1e3, " mm"), "rad": (math.degrees(value), "°")}.get(
        unit, (value, f" {unit}")
    )
    return f"{abs(number):.{2 if abs(number) < 10 else 3}g}{unit}"


# Noise, repeats, and what changes with time.


def _alike_in_time(result: Calibration, explained: bool) -> Iterator[Finding]:
    """Residuals of visits that follow each other, by a permutation test.

    Where the noise explains the residual, what they share is a small part of it, for which the
    error at new poses has room.
    """
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
    if not math.isfinite(result.heldout_rms):
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
        yield _note("noise_not_compared", "" if _lacks_fit(result) else _state_noise(result))
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
        remedy = (
            f"Correct [tracker]: by {single.by} single readings scatter {rounded(times, 2)} times "
            "as much as cell or table state."
        )
        yield _note(
            "stated_noise_too_small", remedy,
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
    """Effects of the cell such as diagnose finds, which asked again would find no more."""
    effects = dict.fromkeys(p.effect for p in result.model.parameters)
    usual = [e for e in effects if e in STATED_BY_FILE or effect_of(e).registered]
    return [e.replace("_", " ") for e in effects if e not in usual]


def _state_noise(result: Calibration) -> str:
    keys, ask = "sigma_um, or range_um and transverse_um", "elastocal diagnose looks for that"
    keys = "distance_um" if result.model.observe == "distance" else keys
    return (
        f"State the tracker's noise ([tracker] {keys}): only beside it does the residual say "
        f"whether the model lacks something.{'' if _named(result) else f' {ask} either way.'}"
    )


def _lacking(result: Calibration) -> str:
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
        f"{ask} Where it finds nothing, the excess is the robot's repeatability, or noise larger "
        "than stated ([tracker])."
    )


def _lacks_fit(result: Calibration) -> bool:
    found = result.noise.lack_of_fit
    return found is not None and found.p < LACK_OF_FIT


def _repeats(result: Calibration, fits: bool) -> Iterator[Finding]:
    """Do configurations scatter more than their repeats, and does anything count with it?

    Where the residual `fits` a stated noise of which readings share some, nothing is missing.
    """
    noise, test = result.noise, result.noise.lack_of_fit
    sizes = [s for s in noise.sizes or () if s.part == CONFIGURATION]
    shared = {s.name: s.sigma for s in sizes if s.sigma is not None}
    if test is not None:
        # These hold where the readings of a configuration are correlated.
        clustered = noise.interval_kind.lower().startswith("cr")
        counted = "the intervals" if clustered else "nothing"
        if shared or noise.drift is not None:
            counted = "the noise model"
        say, kind, doing = _good, "repeats_agree", ""
        if _lacks_fit(result):
            known = fits and result.model.cell.noise.shared and counted == "the noise model"
            say, kind = _note if known else _care, "lack_of_fit"
            doing = "" if known else _lacking(result)
        dofs = {"dof_between": test.dof_between, "dof_pure": test.dof_pure}
        yield say(kind, doing, F=test.F, **dofs, p=test.p, counted_by=counted)
    if shared:
        yield _note("common_deviation", of=tuple(shared), sigma_um=tuple(shared.values()))


def _visits(result: Calibration, fits: bool) -> Iterator[Finding]:
    """Joints that settle anew at each visit, and a drift: what a test of false-alarm rate SCATTERS
    finds, whether the noise model has it or not.  `fits`: the residual agrees with the stated
    noise."""
    noise, stated = result.noise, result.model.cell.noise
    ask = "Ask what the model lacks (elastocal diagnose)"
    ask = "Repeat some poses" if _named(result) else ask
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
    """What to do about `key` of [noise], by the sizes found and stated (m or rad)."""
    if not (said := listed([rounded(1e6 * size) for _, size in found if size])):
        return f"State it as [noise] {key} in the cell for design and simulate."
    if all(size.agrees_with(stated) for size, stated in found):
        return f"It agrees with [noise] {key} of the cell ({said})."
    if fits:  # parts of the noise that are alike have their sum alone told
        return f"The cell states it: [noise] {key} ({said})."
    return f"Correct [noise] {key} of the cell ({said}) for design and simulate."


# Poses that were not fitted.


def _prediction(result: Calibration, explained: bool) -> Iterator[Finding]:
    held, fitted, nominal = result.heldout_rms, result.residual_rms, result.nominal_rms
    placed = only_placed(result)
    # Under a drift the held-out error is that of another day, which more poses make no better.
    # Of base and tool alone, what each point takes of the fit is all that it can flatter by.
    # What n and p let expect decides, so that the noise of a campaign does not; and what exceeds
    # it: at 25 poses held / (fitted · expected) has a standard deviation of 0.04.
    expected = _overfitted(result)
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
    placed = explained and only_placed(result)
    left, wanted = spare_equations(result), COARSE if placed else ENOUGH
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
        yield _care("new_poses_not_shown", **numbers, parameters=found.blamed)
    if found.rms > result.nominal_rms / LITTLE and not only_placed(result):
        yield _care("new_poses_no_gain", rms_um=found.rms, nominal_rms_um=result.nominal_rms)


def spare_equations(result: Calibration) -> int:
    """Equations that configurations give beyond the parameters fitted.

    A rigid body's place is six numbers in each load state, however many markers it has and however
    often they are read.
    """
    observed = result.observations
    table, lead = observed.table, observed.lead
    code = numbered(observed.configuration, *np.round(table.force[lead], 3).T)
    marked = numbered(code, table.marker[lead])
    seen = code[np.unique(marked, return_index=True)[1]]
    size = 1 if observed.kind == "distance" else observed.size
    told = np.minimum(size * np.bincount(seen), 6)
    return int(told.sum()) - int(np.sum(~result.model.shrunk[result.columns]))


def _faulty(result: Calibration) -> Iterator[Finding]:
    n, fitted, kept = len(result.faulty), len(result.observations.lead), len(result.outliers)
    if n:
        remedy = f"Check the {counted(n, 'reading')} beyond the noise."
        shifted = result.faulty_report.shifted if result.faulty_report else []
        if shifted:
            remedy += (
                f" One common shift{' each' * (len(shifted) > 1)} explains "
                f"{listed(map(str, shifted), 4)}: look for what "
                "moved there, a marker or the tracker."
            )
        numbers = {"left_out": len(result.excluded), "heldout_all_rms_um": result.heldout_all_rms}
        numbers["shifted"] = sum(len(f.readings) for f in shifted)
        yield _note("faulty_readings", remedy, fitted=kept, **numbers)
    if kept > MANY * fitted:
        yield _care("many_faulty_readings", faulty=kept, fitted=fitted)


# What the readings do not tell of the parameters.


def _undetermined(result: Calibration) -> Iterator[Finding]:
    """What these poses do not show, and what no pose shows: only the first is to be measured."""
    all_of_them = standings(result)
    lacking = [e.name for e in result.ordinary if all_of_them[e.name] in (INVISIBLE, ABSORBED)]
    redundant = () if result.left is None else result.left.redundant
    shown = tuple(name for name in lacking if name not in redundant)
    if n := len(lacking) - len(shown):
        yield _good("redundant", parameters=n)
    unread = tuple(name for name, standing in all_of_them.items() if standing == UNREAD)
    if unread:
        remedy = f"There is {no_reading(result)}: measure it, or delete it from [tool.markers_m]."
        yield _note("markers_not_read", remedy, parameters=unread)
    if n := len(shown):
        remedy = (
            f"{n} parameter{'' if n == 1 else 's'} cannot be determined from these data "
            f"({listed(shown, 4)}). Predictions hold for poses and loads like those measured; for "
            "others, measure what shows them."
        )
        yield _note("undetermined", remedy, parameters=n, names=shown)


def _unread(result: Calibration) -> list[str]:
    excluded = {f"marker:{o.marker}" for o in result.excluded}
    places = unread_markers(result.model, result.observations.table)
    return [place for place in places if place not in excluded]


def no_reading(result: Calibration) -> str:
    names = [place.removeprefix("marker:") for place in _unread(result)]
    several, source = "s" * (len(names) > 1), result.observations.table.source
    return f"no reading of marker{several} {listed(names, 4)} in {source}"


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


def shape_of(summary: ResidualSummary) -> Finding:
    skew, kurtosis, p = (
        summary.whole.skewness, summary.whole.excess_kurtosis, summary.whole.normality_p
    )  # fmt: skip
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
    """Test data against held-out poses, by an F-test of the two mean squares; the components of a
    reading count as one."""
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


# What only the solver can tell.


def _exchanged(result: Calibration, whole: Measurements) -> Iterator[Finding]:
    if (found := exchanged(result.model, whole)) is not None:
        lines = whole.row[found.rows]
        fitted = np.isin(lines, result.observations.table.row).any()
        yield (_care if fitted else _note)(
            "exchanged_markers", found.words, markers=found.markers, rows=len(lines),
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
        yield _note("ill_conditioned", condition_number=condition, parameters=worst)


def _bounds(result: Calibration) -> Iterator[Finding]:
    at = {name: k for k, name in enumerate(result.determined)}
    told = {p.name for p, _ in impossible(result)}
    for e, p in zip(result.estimates, result.model.parameters, strict=True):
        if e.limits is None or not p.beyond(e.limits) or p.name in told:
            continue
        std = float(np.sqrt(result.covariance[at[e.name], at[e.name]]))
        bound = p.lower if e.held <= p.lower else p.upper
        numbers = {"unit": e.unit, "bound": bound, "value": e.held, "std": std}
        yield _note("beyond_bound", parameter=e.name, **numbers)


def only_placed(result: Calibration) -> bool:
    """Whether nothing but base, markers and their like was fitted, as in a calibration of a tool
    or of hand and eye: then the nominal arm is placed by the same fit and no rival to it."""
    return all(
        effect_of(p.effect).registered or e.note.startswith("fixed")
        for p, e in zip(result.model.parameters, result.estimates, strict=True)
    )
