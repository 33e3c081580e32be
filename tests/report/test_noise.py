"""What the report says of noise, method and intervals: everything named, nothing claimed twice."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.pages import Page

from elastocal.identification.constrained import ActiveConstraint
from elastocal.identification.findings import judged
from elastocal.identification.noise_choice import Trial
from elastocal.identification.noise_summary import LackOfFit, NoiseSize
from elastocal.identification.residuals import summarise_residuals
from elastocal.report.page import page_of
from elastocal.report.terminal import printed_text

MISFIT = LackOfFit(F=9.31, p=2e-9, dof_between=30, dof_pure=60)
AXES = tuple(NoiseSize(n, v * 1e-6) for n, v in (("x", 12.0), ("y", 31.4), ("rz", 5.0)))
TRIED = (Trial("independent", 1, -90.0), Trial("axis+configuration", 4, -104.25))


def changed(result: Any, noise: dict[str, Any] | None = None, **fields: Any) -> Any:
    """The result with other fields, judged anew."""
    return judged(replace(result, noise=replace(result.noise, **(noise or {})), **fields))


@pytest.fixture(scope="module")
def noisy(case: Any) -> Any:
    """A result with everything that the report can tell of noise."""
    observed = case.result.observations
    e = np.random.default_rng(0).normal(size=len(observed.value))
    e[np.repeat(observed.configuration, 3) == 3] *= 4
    noise = {
        "kind": "axis+configuration",
        "description": "one variance per axis, and a deviation common to each configuration",
        "reason": "smallest of all",
        "sizes": (*AXES, NoiseSize("common to each configuration", 40e-6)),
        "tried": TRIED,
        "lack_of_fit": MISFIT,
        "interval_kind": "kenward-roger",
        "interval_description": "adjusted",
    }
    name = "joint2.compliance"
    active = (ActiveConstraint(f"{name} >= 0", "lower", (name,), 0.0, 1.0),)
    share = {"joint4.offset": 0.83, "joint5.offset": 0.2, "joint6.offset": float("nan")}
    return changed(
        case.result, noise, method="reml", active=active, prior_share=share,
        residual_summary=summarise_residuals(observed, e),
    )  # fmt: skip


def test_names_from_the_result_are_text(noisy: Any, no_figures: None) -> None:
    script = "<script>\x1b[31m"
    sizes = (NoiseSize(script, 1e-6),)
    tried = tuple(Trial(script, 1, float(k)) for k in range(2))
    noise = {"sizes": sizes, "tried": tried, "description": script, "reason": script}
    page = page_of(changed(noisy, noise))
    found = Page(page)
    found.check_harmless(page)
    assert script.replace("\x1b", "\\x1b") in found.text
    assert "\x1b" not in printed_text(changed(noisy, noise))
