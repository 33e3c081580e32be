"""Findings in sentences: what to do about each, the warnings of a result, the steps left."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from elastocal.identification.outliers import named_runs
from elastocal.identification.result import Calibration, Finding, Severity
from elastocal.messages import counted, gathered, listed, option, rounded, size_of
from elastocal.units import display

# What to do about a finding.

AT_BOUND = (
    "Check load direction and torque signs, measure poses that load it more, or fit with bounds."
)


def more_poses() -> str:
    return (
        f"Measure more poses: elastocal design with {option('augment')} plans what these data lack."
    )


# What to do about findings of a kind; of others it depends on more.
REMEDIES: dict[str, str | Callable[[], str]] = {
    "autocorrelated": "Visit poses and loads in random order and return to a reference pose every "
    "ten poses: residuals of visits that follow each other are alike, as where something drifts, "
    "or where the model lacks what neighbouring poses have in common.",
    "beyond_bound": AT_BOUND,
    "copied_readings": "Find out how lines came to be in the table twice; readings that were "
    "rounded until they agree should be given with all their digits.",
    "few_configurations": more_poses,
    "few_degrees_of_freedom": "Measure more poses.",
    "fit_flatters": more_poses,
    "hardly_shown": "Measure poses and loads that strain what the readings hardly show (elastocal "
    "design plans them), or give it a prior.",
    "ill_conditioned": "Measure poses in which the joints differ more, or fix one of these "
    "parameters.",
    "many_faulty_readings": "Check where they lie before excluding any.",
    "mostly_prior": "Measure poses that load them more.",
    "new_poses_no_gain": more_poses,
    "new_poses_not_shown": lambda: (
        f"{more_poses()} For a part of the joint ranges alone, state test poses in the cell."
    ),
    "not_converged": "Give start hints in [model.nominal], fit fewer effects, or measure more "
    "poses.",
    "residual_below_stated_noise": "State the tracker's true noise: with noise stated too large, a "
    "missing effect does not show.",
    "residuals_heavy_tailed": lambda: (
        f"Compare with a robust fit ({option('method')} huber or l1): where parameters differ by "
        "more than their intervals, far readings decide them; look for what makes single readings "
        "err (line of sight, vibration, a tracker that has not settled)."
    ),
    "test_data_far": "Measure poses there: the fit extrapolates.",
    "test_data_worse": "Compare the test poses with those fitted: where they lie elsewhere "
    "(joints, load), fit some like them; where they do not, the arm or the tracker has changed in "
    "between.",
    "untested": lambda: (
        "Validate on independent poses: measure some that are not fitted, and give "
        f"them with {option('test')}."
    ),
}


def made(severity: Severity, kind: str, remedy: str | None = None, /, **numbers: Any) -> Finding:
    """A finding with the remedy of its kind unless one is given; numbers whose names end in _um or
    _urad are given in m and rad."""
    if remedy is None:
        known = REMEDIES.get(kind, "")
        remedy = known if isinstance(known, str) else known()
    for name, value in numbers.items():
        if name.endswith(("_um", "_urad")):
            several = isinstance(value, tuple)
            numbers[name] = tuple(v * 1e6 for v in value) if several else float(value) * 1e6
    return Finding(kind, severity, numbers, remedy)


# What a warning says of a finding: its numbers and its remedy by name.
SENTENCES = {
    "copied_readings": (
        "{copies} readings repeat others to the last digit (lines {lines}) and were excluded: "
        "copies add no information and make intervals too narrow. {remedy}"
    ),
    "impossible_values": (
        "Impossible values: {parameters} beyond a physical bound by more than 5 standard "
        "deviations."
    ),
    **dict.fromkeys(("load_unit", "exchanged_markers", "scatter_not_counted"), "{remedy}"),
    "not_converged": "The fit did not converge: {reason}. {remedy}",
    "few_degrees_of_freedom": (
        "Only {dof} degrees of freedom for {parameters} determined parameters: intervals are wide "
        "and the residual is too small. {remedy}"
    ),
    "not_held_out": (
        "Some configuration alone determines a parameter, so there is no held-out error for "
        "it. Measure more configurations."
    ),
    "ill_conditioned": (
        "Ill-conditioned (condition number {condition_number} after scaling): the data barely "
        "separate {parameters}. {remedy}"
    ),
    "residual_above_stated_noise": (
        "The residual is {ratio:.1f} times the stated noise: an effect is missing or the stated "
        "noise is too small. Intervals use the residual, not the stated noise. {look}."
    ),
    "lack_of_fit": (
        "Configurations scatter more than their repeats (lack of fit: F = {F:.2f} on {dof_between} "
        "and {dof_pure} degrees of freedom, {p}): the arm does not return to the same "
        "place, or an effect is missing. The intervals do not include it and are too narrow: "
        "use {count}intervals by cr2; measure more configurations rather than more repeats."
    ),
    "drift": (
        "Base or tracker drift during the session ({sigma_um} µm{along}, by the "
        "{by}; {p}). Weights and intervals account for it, and whole blocks in time are "
        "held out. {remedy}"
    ),
    "joint_scatter": (
        "The joints settle anew at every visit of the arm (standard deviation {sigma_urad} µrad; "
        "{p}). Weights and intervals account for it. {remedy}"
    ),
    "beyond_bound": (
        "{parameter} = {value} ± {std} {unit} lies beyond its physical bound {bound}: {remedy}"
    ),
    "many_faulty_readings": (
        "Too many for reading errors: a shifted block of readings, or a missing effect in some "
        "load state, marker or region. {remedy}"
    ),
}
DIGITS = {"condition_number": 2, "sigma_um": 3}  # of numbers in them
# The same of several parameters, whose names are told together.
OF_SEVERAL = {
    "beyond_bound": "{named} lie beyond their physical bound {bound} {unit} ({values}): {remedy}",
}


def warning_sentences(result: Calibration) -> dict[str, str]:
    """The findings that call for attention as sentences that name the remedy, each with the kind of
    finding that it tells; of those that are alike one sentence."""
    groups: dict[Any, list[Finding]] = {}
    for k, f in enumerate(result.findings):
        alike = (f.kind, f.numbers["bound"], f.numbers["unit"]) if f.kind in OF_SEVERAL else k
        groups.setdefault(alike, []).append(f)
    return {text: same[0].kind for same in groups.values() for text in _told(result, same)}


def _told(result: Calibration, same: list[Finding]) -> Iterator[str]:
    f = same[0]
    if f.kind == "faulty_readings":
        if kept := result.outliers:
            yield (
                f"{counted(len(kept), 'reading lies', 'readings lie')} beyond what the noise "
                f"explains (lines {_runs(o.line for o in kept)}); they are in the fit. Check "
                f"them; {option('outliers', 'drop')} excludes them."
            )
        if apart := result.excluded:
            yield (
                f"{counted(len(apart), 'reading was', 'readings were')} excluded as outliers "
                f"(lines {_runs(o.line for o in apart)}). They are mistakes, or signs of a missing "
                "effect. All are listed in the result under 'excluded'; "
                f"{option('outliers', 'keep')} keeps them."
            )
    elif f.kind in SENTENCES and f.numbers.get("counted_by", "nothing") == "nothing":
        words = {
            k: ", ".join(one if isinstance(one, str) else rounded(one) for one in v)
            if isinstance(v, tuple) else rounded(v, DIGITS[k]) if k in DIGITS else v
            for k, v in f.numbers.items()
        }  # fmt: skip
        words["along"] = "" if result.model.observe == "distance" else " in each direction"
        words["p"] = size_of(f.number("p")) if "p" in words else ""
        within = f.kind == "beyond_bound"  # there the remedy ends a sentence
        words |= _shown(f) if within else {}
        default = "the default method, whose noise model has this scatter, or "
        words["count"] = "" if result.noise.estimated else default
        ask = f.remedy.startswith("Ask")
        words["look"] = "Look for missing effects (diagnose)" if ask else "Repeat some poses"
        words["remedy"] = f.remedy[:1].lower() + f.remedy[1:] if within else f.remedy
        if f.kind == "copied_readings":
            words["lines"] = _runs(result.copies)
        if len(same) == 1:
            yield SENTENCES[f.kind].format(**words)
            return
        pairs = ("{value} ± {std}".format(**_shown(other)) for other in same)
        words["named"] = gathered(str(other.numbers["parameter"]) for other in same)
        yield OF_SEVERAL[f.kind].format(**words, values=listed(pairs, 4))


def _shown(f: Finding) -> dict[str, str]:
    """Value, standard deviation and bound of a parameter in the unit that people think in."""
    unit = str(f.numbers["unit"])
    digits = {"value": 3, "std": 2, "bound": 3}
    sizes = {k: rounded(display(f.number(k), unit)[0], n) for k, n in digits.items()}
    return sizes | {"unit": display(0.0, unit)[1]}


def _runs(lines: Iterable[int]) -> str:
    runs = named_runs(list(lines))
    return f"{', '.join(runs[:8])}{' …' if len(runs) > 8 else ''}"


# Of these the warning, or the line on the prior, says what to do.
TOLD_ELSEWHERE = {"mostly_prior"} | {k for k, text in SENTENCES.items() if "{remedy}" in text}


SLIGHT = 0.1  # of the error at new poses: what is open by less raises it by half a percent


def next_steps(result: Calibration) -> list[Finding]:
    """Findings whose remedy is still to be told, each remedy once, the worthiest first: what speaks
    against the result, what is worth knowing, what to do with it, and last what hardly matters."""
    steps = {f.remedy: f for f in reversed(result.findings) if f.kind not in TOLD_ELSEWHERE}
    # One that begins with another says that too.
    whole = {r for r in steps if r and not any(s != r and s.startswith(r) for s in steps)}
    order = [f for f in result.findings if f.remedy in whole and steps[f.remedy] is f]
    found, ranks = result.predicted, ("poor", "care", "note", "good", "trust", "undetermined")
    slight = found is not None and found.open < SLIGHT * found.rms
    last = {"trust", "undetermined"} if slight else {"trust"}
    return sorted(order, key=lambda f: ranks.index(f.kind if f.kind in last else f.severity))
