"""A plan on the terminal: every key figure, at any width."""

import io

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from elastocal.report.terminal import print_report


def printed(plan, width):
    stream = io.StringIO()
    print_report(Console(file=stream, width=width, highlight=False), plan)
    return stream.getvalue()


def words(text):
    """The text without line breaks, so that a sentence is found wherever it was folded."""
    return " ".join(text.split())


@pytest.mark.parametrize("width", [60, 140])
def test_every_key_figure_is_told_within_the_width(plan, width):
    text = printed(plan, width)
    assert max(cell_len(line) for line in text.splitlines()) <= width
    told = words(text)
    assert f"ρ₀ = {1e6 * plan.everywhere.test_poses:.4g} µm" in told
    assert f"{1e6 * plan.everywhere.elsewhere:.4g} µm rms over the joint ranges" in told
    assert f"certified on the pool: efficiency {plan.certificate.efficiency_pool:.4f}" in told
    assert (
        f"estimated on the continuum: efficiency {plan.certificate.efficiency_continuum:.4f}"
        in told
    )
    assert f"{plan.candidates.feasible} feasible of {plan.candidates.tried} tried" in told
    for p in plan.predicted:
        assert p.name in told
    for q in np.degrees(plan.q).ravel():
        assert f"{q:.2f}" in told or (width == 60 and f"{q:.1f}" in told)
    assert "no feasible pose shows joint1.compliance" in told
    assert f"{len(plan.execution.stops)} stops" in told
