"""What results show in a notebook: HTML, figures and data frames (found by elastocal.above)."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np

from elastocal.compensation.compensate import commands_csv, in_file_units, joint_columns
from elastocal.errors import InputError
from elastocal.model.effects.catalogue import effect_of
from elastocal.report.blocks import Figure, Fold, ShownArm, unfolded
from elastocal.report.formatting import first_stops
from elastocal.report.page import html_of
from elastocal.report.terminal import report_of
from elastocal.text import cell_meaning, did_you_mean, listed, quoted

if TYPE_CHECKING:
    import pandas as pd

    from elastocal.compensation.compensate import Compensation
    from elastocal.diagnosis.changes import Comparison
    from elastocal.diagnosis.diagnosis import Diagnosis
    from elastocal.identification.result import Calibration
    from elastocal.planning.plan import Plan

# What `plot` draws where nothing else is asked for, if not the first figure.
DEFAULTS = {"Calibration": "residuals", "Diagnosis": "budget"}


def html(result: object) -> str:
    """A result as HTML; every text is escaped."""
    return html_of(report_of(result).blocks, 4, pictures=False)


def plot(result: object, kind: str | None, interactive: bool, ax: Any = None) -> Any:
    """The figure `kind` of a result: matplotlib's, in the place of `ax` where that is given, or of
    the arm plotly's where `interactive`.

    Raises InputError for a kind that the result does not have, and one that cannot be turned.
    """
    folds = [block for block in report_of(result).blocks if isinstance(block, Fold)]
    every = [name for fold in folds for name in fold.figures]
    arms = [name for name in every if name in ("space", "poses")]
    chosen = kind or DEFAULTS.get(type(result).__name__, every[0])
    if interactive and kind is None and arms:
        chosen = arms[0]
    opened = unfolded(folds, lambda fold: chosen in fold.figures)
    found = [b for b in opened if isinstance(b, Figure | ShownArm) and b.name == chosen]
    if not found:
        opened = unfolded(folds, lambda fold: bool(fold.figures))
        there = [block.name for block in opened if isinstance(block, Figure | ShownArm)]
        raise InputError(
            f"no figure {quoted(chosen)}{did_you_mean(chosen, there)}; there are {listed(there)}"
        )
    if interactive:
        if not isinstance(found[0], ShownArm):
            told = f"; interactive=True turns the arm: {listed(arms)}" if arms else ""
            raise InputError(f"the figure {quoted(chosen)} stands still{told}")
        from elastocal.report.arm_view import turned

        return turned(found[0].space)
    from elastocal.report.arm_view import space_figure
    from elastocal.report.figures import figure_of

    block = found[0]
    drawn = space_figure(block) if isinstance(block, ShownArm) else block
    if ax is not None:
        return figure_of(drawn, _instead(ax))
    figure: Any = figure_of(drawn)
    # So that a notebook shows it although pyplot, whose hooks do so, is not loaded.
    figure._repr_png_ = partial(_png, figure)
    return figure


def _instead(ax: Any) -> Any:
    spot = getattr(ax, "get_subplotspec", lambda: None)()
    if spot is None:
        raise InputError("`ax` takes axes that plt.subplots or Figure.subplots made")
    ax.remove()
    return spot.get_gridspec().figure.add_subfigure(spot)


def _png(figure: Any) -> bytes:
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=100, facecolor="white")
    return picture.getvalue()


def frame(result: object) -> pd.DataFrame:
    return FRAMES[type(result).__name__](result)


def _estimates(result: Calibration) -> pd.DataFrame:
    """One row per parameter, SI units: NaN where the data do not determine it alone."""
    import pandas as pd

    rows = [
        {"parameter": e.name, "unit": e.unit, "value": e.value, "std": e.std}
        | dict(zip(("ci95_low", "ci95_high"), e.ci95 or (None, None), strict=True))
        | {"nominal": e.nominal, "held": e.held, "identifiable": e.identifiable}
        | {"combined_with": ", ".join(e.combined_with), "note": e.note}
        for e in result.estimates
    ]
    frame = pd.DataFrame(rows)
    numbers = ["value", "std", "ci95_low", "ci95_high", "nominal", "held"]
    return frame.astype(dict.fromkeys(numbers, float))


def _plan_frame(plan: Plan | None) -> pd.DataFrame:
    """One row per pose: joints in ° or mm, place in the order, and the load where it states one."""
    import pandas as pd

    if plan is None:
        return pd.DataFrame()
    columns: dict[str, Any] = {"configuration": list(plan.configurations)}
    kinds = plan.model.chain.kinds
    columns |= dict(zip(joint_columns(kinds), in_file_units(plan.q, kinds).T, strict=True))
    if plan.level_joint is not None:
        columns["level"] = plan.group + 1
    order = first_stops(plan)
    columns["order"] = [order.get(k) for k in range(len(plan.q))]
    return pd.DataFrame(columns)


def _candidates(d: Diagnosis) -> pd.DataFrame:
    """One row per hypothesis, best first; whether it is held to be real; `score` in nats.

    What was found only where all causes are judged together comes first, without a score.
    """
    import pandas as pd

    found = {(f.effect, f.where): f for f in d.effects}
    tried = {(c.effect, c.where): c for c in d.candidates}
    rows = []
    for key in dict.fromkeys([*(key for key in found if key not in tried), *tried]):
        f, c = found.get(key), tried.get(key)
        rows.append(
            {
                "effect": key[0], "where": key[1], "stage": effect_of(key[0]).stage,
                "probability": getattr(c or f, "probability", np.nan),
                "score": getattr(c, "score", np.nan),
                "detectable": getattr(c, "detectable", np.nan), "found": f is not None,
                "gap_reduction": getattr(f, "gap_reduction", np.nan),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def _commands(c: Compensation) -> pd.DataFrame:
    """One row per target: the columns of the commands file, NaN where a target is not reached."""
    import pandas as pd

    text = io.StringIO(commands_csv(c, c.chain.kinds))
    frame = pd.read_csv(text, dtype={"configuration": str}, keep_default_na=False, na_values=[""])
    if "configuration" in frame:
        frame["configuration"] = frame["configuration"].map(cell_meaning, na_action="ignore")
    return frame


def _changes(c: Comparison) -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame([vars(change) for change in c.changes])


FRAMES: dict[str, Callable[[Any], pd.DataFrame]] = {
    "Calibration": _estimates,
    "Plan": _plan_frame,
    "NextPoses": lambda found: _plan_frame(found.plan),
    "Diagnosis": _candidates,
    "Comparison": _changes,
    "Compensation": _commands,
    "Measurements": lambda table: table.to_dataframe(),
}
