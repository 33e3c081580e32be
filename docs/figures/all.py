"""Every figure of the documentation: make docs-figures."""

from __future__ import annotations

import causes
import certificate
import chain
import coverage
import diagnosis_distance
import house
import tutorial_valley
from style import draw

if __name__ == "__main__":
    for module in (
        chain,
        house,
        tutorial_valley,
        coverage,
        certificate,
        diagnosis_distance,
        causes,
    ):
        draw(module.__name__, module.figure)
