"""Findings in sentences: the warnings of a result, and the steps that are left to be told."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from elastocal.errors import option
from elastocal.identification.outliers import Outlier, blocks
from elastocal.identification.result import Calibration, Finding
from elastocal.text import gathered, listed

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
    "load_unit": "{remedy}",
    "exchanged_markers": "{remedy}",
    "scatter_not_counted": "{remedy}",
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
        "Ill-conditioned (condition number {condition_number:.1e} after scaling): the data barely "
        "separate {parameters}. {remedy}"
    ),
    "residual_above_stated_noise": (
        "The residual is {ratio:.1f} times the stated noise: an effect is missing or the stated "
        "noise is too small. Intervals use the residual, not the stated noise. Look for missing "
        "effects (diagnose)."
    ),
    "lack_of_fit": (
        "Configurations scatter more than their repeats (lack of fit: F = {F:.2f} on {dof_between} "
        "and {dof_pure} degrees of freedom, p = {p:.1g}): the arm does not return to the same "
        "place, or an effect is missing. The intervals do not include it and are too narrow: "
        "use {count}intervals by cr2; measure more configurations rather than more repeats."
    ),
    "drift": (
        "Base or tracker drift during the session ({sigma_um:.3g} µm in each direction, by the "
        "{by}; p = {p:.1g}). Weights and intervals account for it, and whole blocks in time are "
        "held out. {remedy}"
    ),
    "joint_scatter": (
        "The joints settle anew at every visit of the arm (standard deviation {sigma_urad} µrad; "
        "p = {p:.1g}). Weights and intervals account for it. {remedy}"
    ),
    "beyond_bound": (
        "{parameter} = {value:.3g} ± {std:.2g} {unit} lies beyond its physical bound {bound:g}: "
        "{remedy}"
    ),
    "many_faulty_readings": (
        "Too many for reading errors: a shifted block of readings, or a missing effect in some "
        "load state, marker or region. {remedy}"
    ),
}
# The same of several parameters, whose names are told together.
OF_SEVERAL = {
    "beyond_bound": "{named} lie beyond their physical bound {bound:g} {unit} ({values}): {remedy}",
}


class Told(str):
    """A sentence that knows the `kind` of the finding it tells; in JSON a text as any other."""

    kind: str

    def __new__(cls, text: str, kind: str = "") -> Told:
        told = super().__new__(cls, text)
        told.kind = kind
        return told


def warning_sentences(result: Calibration) -> tuple[Told, ...]:
    """The findings that call for attention as sentences that name the remedy; of those that are
    alike one sentence."""
    groups: dict[Any, list[Finding]] = {}
    for k, f in enumerate(result.findings):
        alike = (f.kind, f.numbers["bound"], f.numbers["unit"]) if f.kind in OF_SEVERAL else k
        groups.setdefault(alike, []).append(f)
    return tuple(
        Told(text, same[0].kind) for same in groups.values() for text in _told(result, same)
    )


def _told(result: Calibration, same: list[Finding]) -> Iterator[str]:
    f = same[0]
    if f.kind == "faulty_readings":
        yield from _faulty_readings(result)
    elif f.kind in SENTENCES and f.numbers.get("counted_by", "nothing") == "nothing":
        words = {k: ", ".join(map(_word, v)) if isinstance(v, tuple) else v
                 for k, v in f.numbers.items()}  # fmt: skip
        within = f.kind == "beyond_bound"  # there the remedy ends a sentence
        default = "the default method, whose noise model has this scatter, or "
        words["count"] = "" if result.noise.estimated else default
        words["remedy"] = f.remedy[:1].lower() + f.remedy[1:] if within else f.remedy
        if f.kind == "copied_readings":
            words["lines"] = _runs(result.copies)
        if len(same) == 1:
            yield SENTENCES[f.kind].format(**words)
            return
        pairs = (f"{o.numbers.get('value', 0):.3g} ± {o.numbers.get('std', 0):.2g}" for o in same)
        words["named"] = gathered(str(other.numbers["parameter"]) for other in same)
        yield OF_SEVERAL[f.kind].format(**words, values=listed(pairs, 4))


def _word(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.3g}"


def _faulty_readings(result: Calibration) -> list[str]:
    found = []
    if result.outliers:
        found.append(
            f"{_count(result.outliers, 'lies', 'lie')} beyond what the noise explains "
            f"({_lines(result.outliers)}); they are in the fit. Check them; "
            f"{option('outliers', 'drop')} excludes them."
        )
    if result.excluded:
        found.append(
            f"{_count(result.excluded, 'was', 'were')} excluded as outliers "
            f"({_lines(result.excluded)}). They are mistakes, or signs of a missing effect. All "
            f"are listed in the result under 'excluded'; {option('outliers', 'keep')} keeps them."
        )
    return found


def _lines(readings: tuple[Outlier, ...]) -> str:
    return f"lines {_runs(o.line for o in readings)}"


def _runs(lines: Iterable[int]) -> str:
    """ "142–507, 610 …": runs of lines, the first eight."""
    runs = blocks(list(lines))
    shown = ", ".join(str(a) if a == b else f"{a}–{b}" for a, b in runs[:8])
    return f"{shown}{' …' if len(runs) > 8 else ''}"


def _count(readings: tuple[Outlier, ...], one: str, many: str) -> str:
    n = len(readings)
    return f"1 reading {one}" if n == 1 else f"{n} readings {many}"


# Of these the warning, or the line on the prior, says what to do.
TOLD_ELSEWHERE = {"mostly_prior"} | {k for k, text in SENTENCES.items() if "{remedy}" in text}


def next_steps(result: Calibration) -> list[Finding]:
    """Findings whose remedy is still to be told, each remedy once."""
    steps = {f.remedy: f for f in reversed(result.findings) if f.kind not in TOLD_ELSEWHERE}
    # One that begins with another says that too.
    whole = {r for r in steps if r and not any(s != r and s.startswith(r) for s in steps)}
    order = [f for f in result.findings if f.remedy in whole and steps[f.remedy] is f]
    trust = [f for f in order if f.kind == "trust"]
    return [f for f in order if f.kind != "trust"] + trust
