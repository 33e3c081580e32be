"""How to diagnose."""

from __future__ import annotations

from dataclasses import dataclass

from elastocal.errors import InputError, option, require
from elastocal.manipulator.effects import CATALOGUE
from elastocal.text import did_you_mean, listed


@dataclass(frozen=True)
class DiagnosisOptions:
    """How to diagnose.

    `false_alarm`: probability that something is claimed where nothing is, for the whole family of
    hypotheses.  `without`: effects taken out of the catalogue.  `seed`: of the sign flips and of
    the draws behind intervals.
    """

    seed: int = 0
    without: tuple[str, ...] = ()
    false_alarm: float = 0.05

    def __post_init__(self) -> None:
        require(
            0 < self.false_alarm < 0.5,
            f"{option('false_alarm')} takes a number between 0 and 0.5; found {self.false_alarm:g}",
        )
        for name in self.without:
            if name not in CATALOGUE:
                raise InputError(
                    f"{option('without')}: unknown effect '{name}'"
                    f"{did_you_mean(name, list(CATALOGUE))}; "
                    f"the catalogue has: {listed(list(CATALOGUE))}"
                )
