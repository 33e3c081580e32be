"""All figures of the identification page by name: SVG elements, empty where there is none."""

from __future__ import annotations

from elastocal.identification.residual_summary import ResidualSummary
from elastocal.identification.result import Calibration
from elastocal.report.gap_budget import Budget
from elastocal.report.residuals import Residuals
from elastocal.report.space import Space


def drawn_for(
    result: Calibration,
    residuals: Residuals,
    summary: ResidualSummary | None,
    budget: Budget | None,
    space: Space,
) -> dict[str, str]:
    """Name → SVG."""
    from elastocal.report import figures, noise_figures, place_figures
    from elastocal.report.residual_space import marker_positions
    from elastocal.report.space_picture import space_picture
    from elastocal.report.waterfall import waterfall

    distribution = {} if summary is None else {
        "histogram": noise_figures.histogram(summary),
        "scores": noise_figures.scores(summary),
        "groups": noise_figures.scatter_by_group(summary),
        "histograms": noise_figures.histograms_by_group(summary),
    }  # fmt: skip
    positions = marker_positions(result.model, result.observations, result.x)
    steps = () if budget is None else budget.steps
    return {
        **distribution,
        "waterfall": "" if budget is None else waterfall(
            [(step.name, step.rms, step.ci95) for step in steps], budget.floor, budget.floor_name
        ),
        "errors": figures.errors(result),
        "held_out": figures.held_out(result, residuals),
        "by_configuration": figures.by_configuration(residuals),
        "against_joints": figures.against_joints(result.model.chain.kinds, residuals),
        "over_time": place_figures.over_time(result.observations, residuals),
        "by_region": place_figures.by_region(positions, residuals.value[:, : residuals.positions]),
        "matrix": place_figures.correlation_matrix(result),
        "space": space_picture(space, "Residuals as arrows on the posed arm"),
    }  # fmt: skip
