"""Where the gap lies: stage, place, and what the residual depends on, whatever the effect."""

from __future__ import annotations

import numpy as np

from elastocal.diagnosis.evidence import exceedance
from elastocal.diagnosis.found import Found
from elastocal.diagnosis.result import Location, StructureTest
from elastocal.diagnosis.scan import Scan


def structure_tests(seen: Scan) -> tuple[StructureTest, ...]:
    """One test per driver, most telling first; none names an effect.

    The statistic is the largest evidence among the driver's blocks; its distribution without
    structure comes from flipping the signs of whole configurations.
    """
    if not seen.driver_flips:
        return ()
    largest = np.max(list(seen.driver_flips.values()), axis=0)
    tests = [
        StructureTest(
            driver,
            exceedance(seen.driver_flips[driver], odds),
            exceedance(largest, odds),
        )
        for driver, odds in seen.driver_odds.items()
    ]
    order = sorted(tests, key=lambda t: (t.p_family, t.p_value, -seen.driver_odds[t.driver]))
    return tuple(order)


def location(found: Found, tests: tuple[StructureTest, ...]) -> Location | None:
    """Probabilities of stage and place, from all that could stand in the place of the unknown
    effect, or of the first one found."""
    if not found.chosen.items:
        return None
    items = found.chosen.items
    unknown = [k for k, item in enumerate(items) if not item.known]
    own = unknown[0] if unknown else 0
    slot = found.slots[own]
    each, _ = slot.probabilities()
    total = max(float(each.sum()), 1e-300)
    stages: dict[str, float] = {}
    places: dict[str, float] = {}
    for item, p in zip(slot.items, each / total, strict=True):
        stages[item.what.stage] = stages.get(item.what.stage, 0.0) + float(p)
        places[item.what.where] = places.get(item.what.where, 0.0) + float(p)
    what = items[own].what
    shown = {t.driver: t.p_value for t in tests}
    return Location(
        what.stage, what.where, places.get(what.where, 0.0), _sorted(stages), _sorted(places), shown
    )


def _sorted(shares: dict[str, float]) -> dict[str, float]:
    return {k: v for k, v in sorted(shares.items(), key=lambda kv: -kv[1]) if v > 1e-6}
