"""About the exact fit the linear data leaves exactly what the exact fit leaves."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from support.diagnosis_data import campaign

from elastocal.diagnosis import (
    Baseline,
    DiagnosisData,
    Item,
    ModelSet,
    diagnosis_data_of,
    fit_baseline,
    fit_extended,
    fit_set,
    from_centre,
    is_far,
    possible,
    prior_deviations,
    relinearised,
)

SPRING = ("gravity_compensator", "joint2")


@lru_cache
def about_the_spring() -> tuple[DiagnosisData, DiagnosisData, ModelSet, Baseline]:
    """The data before and after, the set with the spring, and the exact fit with it."""
    model, table = campaign(":".join(SPRING))
    base = fit_baseline(model, table)
    dataset = diagnosis_data_of(base, possible(model, table)[0])
    (h,) = (h for h in dataset.hypotheses if (h.name, h.where) == SPRING)
    chosen = fit_set(dataset, (Item(h, np.zeros(0), 0.0),))
    return (
        dataset,
        relinearised(dataset, chosen),
        chosen,
        fit_extended(dataset, chosen, chosen.items),
    )


def test_the_residual_at_the_exact_fit_is_that_of_the_exact_fit() -> None:
    """A spring makes a signal of hundreds of deviations: a thousandth of it would not do."""
    dataset, about_fit, chosen, exact = about_the_spring()
    assert is_far(dataset, chosen)
    h = chosen.items[0].what
    x = dict(zip(exact.model.names, exact.x, strict=True))
    moved = np.array([x[f"{h.where}.{p.key}"] - p.nominal for p in h.parameters])
    moved[1:] = 0.0  # the spring may be anchored and as long as it likes: no size from the example
    explained = about_fit.packed(h, np.zeros(0)) @ (moved / about_fit.sizes[SPRING])
    beta = np.zeros(about_fit.data.X.shape[2])
    n = len(from_centre(about_fit.base))
    shown = np.abs(exact.model.regressor(exact.observed.table, exact.x).B[:, :n]).max(axis=0) > 0
    assert shown.sum() <= len(beta)
    beta[: shown.sum()] = (from_centre(about_fit.base) / prior_deviations(about_fit.base))[shown]
    left = about_fit.data.r - about_fit.data.X @ beta - explained
    expected = about_fit.blocks.pack(exact.residual.reshape(-1, 3, 1))[:, :, 0]
    np.testing.assert_allclose(left, expected, atol=1e-9)


def test_the_spring_leaves_nothing_for_its_imitators() -> None:
    """Before, its geometry is linearised where it is not, and eccentricity takes up the rest."""
    _, about_fit, chosen, _ = about_the_spring()
    (other,) = (h for h in about_fit.hypotheses if h.label == "gear_eccentricity at joint2")
    alone = fit_set(about_fit, chosen.items, chosen.noise)
    both = fit_set(about_fit, (*chosen.items, Item(other, np.zeros(0), 0.0)), chosen.noise)
    assert both.score < alone.score + 5
