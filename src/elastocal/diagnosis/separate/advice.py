"""What to do besides measuring the extra poses, in words."""

from __future__ import annotations

from collections.abc import Sequence

from elastocal.diagnosis.separate.rivals import RivalSet
from elastocal.errors import option
from elastocal.manipulator.effects import effect_of


def inseparable_advice(group: Sequence[str], distance: float, tried: int) -> str:
    """That no pose separates these rivals, neighbours among which are so far apart at most."""
    names = " and ".join([", ".join(group[:-1]), group[-1]])
    near = f"they would be {distance:.1f} standard deviations apart"
    if len(group) > 2:
        near = f"each would be within {distance:.1f} standard deviations of another of them"
    return f"no pose separates {names}: measured in all {tried} poses that were tried {near}"


def other_means(pairs: Sequence[tuple[str, str]]) -> list[str]:
    """What else tells the rivals of inseparable pairs apart."""
    effects = [name.partition(":")[0] for pair in pairs for name in pair]
    return list(dict.fromkeys(remedy for e in effects if (remedy := effect_of(e).remedy)))


def too_few_advice(n: int, probability: float, reachable: float) -> str:
    """That the plan stays below what was aimed at."""
    return (
        f"{n} poses reach a probability of {probability:.2f} only; many more would reach "
        f"{reachable:.2f}: allow more poses ({option('poses')}), or repeat each of them"
    )


def none_of_them(missed: float, nothing: float) -> str:
    """That the right answer may not be among the rivals."""
    return (
        f"with probability {missed:.2f} none of these rivals is at work (noise alone: "
        f"{nothing:.2f}), which the probabilities count with: measure more poses of any kind first"
    )


def pull_advice(n: int, newton: float, without: float, with_pull: float) -> str:
    """That pulling sideways would help, and how much."""
    return (
        f"pull horizontally: {n} poses that are also measured under {newton:.3g} N along x and "
        f"along y, e.g. by a rope over a pulley, raise the probability from {without:.2f} to "
        f"{with_pull:.2f}"
    )


def pull_separates(pairs: Sequence[tuple[str, str]], newton: float) -> str:
    """That pulling sideways tells apart what the load alone does not."""
    apart = ", ".join(f"{first} and {second}" for first, second in pairs)
    return (
        f"a horizontal pull of {newton:.3g} N along x and along y, e.g. by a rope over a pulley, "
        f"would separate {apart}: measure poses under it, too"
    )


def recording_advice(sets: Sequence[RivalSet]) -> list[str]:
    """What the extra visits must keep to, because rivals depend on it."""
    out = []
    if any(s.depends_on("approach") for s in sets):
        out.append("come to each extra pose with every joint from the side that the plan states")
    if any(s.depends_on("time") for s in sets):
        out.append(
            "leave arm and tracker as they are until the extra poses are measured, and record "
            "their times on the same clock"
        )
    return out
