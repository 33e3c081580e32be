"""Large tables are looked at in part: what more readings would add is time and memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from elastocal.measurements import Measurements

# Evidence grows with the readings, and an effect worth finding has hundreds of nats in so many.
MOST_ROWS = 12_000
# Within one configuration noise is dense: its cost grows with the square of what it holds.
MOST_IN_ONE = 60


def thinned(table: Measurements) -> tuple[Measurements, str | None]:
    """The table, or a part of it that is large enough, and what was left out.

    Of each configuration the first readings of every marker under every load; of too many
    configurations those evenly spaced in the order they were measured, so that whatever changes
    with time still does.
    """
    kept = table.take(_first_of_each(table))
    labels, first, rows = np.unique(kept.configuration, return_index=True, return_counts=True)
    order = labels[np.argsort(first)]
    wanted = int(MOST_ROWS / rows.mean())
    if len(order) > wanted:
        chosen = order[np.linspace(0, len(order) - 1, wanted).round().astype(int)]
        kept = kept.take(np.isin(kept.configuration, chosen))
    if len(kept) == len(table):
        return table, None
    return kept, (
        f"the table is large: {len(kept)} of {len(table)} rows were looked at, from "
        f"{min(len(order), wanted)} of {len(order)} configurations, evenly spaced"
    )


def _first_of_each(table: Measurements) -> NDArray[np.bool_]:
    """Rows that are among the first of their configuration, load and marker, as many of each as
    leave MOST_IN_ONE in the configuration."""
    force = np.unique(table.force.round(6), axis=0, return_inverse=True)[1].ravel()
    kinds = np.column_stack([table.configuration, force, table.marker])
    _, kind, count = np.unique(kinds, axis=0, return_inverse=True, return_counts=True)
    kind = kind.ravel()
    order = np.argsort(kind, kind="stable")
    rank = np.empty(len(table), dtype=np.int64)
    rank[order] = np.arange(len(table)) - np.repeat(np.cumsum(count) - count, count)
    _, at = np.unique(table.configuration, return_inverse=True)
    at = at.ravel()
    n_kinds = np.bincount(at[order[np.cumsum(count) - count]])
    allowed = np.maximum(MOST_IN_ONE // n_kinds, 1)
    return np.asarray(rank < allowed[at])
