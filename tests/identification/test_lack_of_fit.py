"""The lack-of-fit test: pure error from repeats against the scatter between configurations."""

from dataclasses import replace

import numpy as np
from support.calibration import cell_of, planar_chain, table_at
from support.cells import random_poses

from elastocal.identification.identify import identify
from elastocal.identification.noise_summary import lack_of_fit
from elastocal.identification.options import Options
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe

PLACED = ("base_frame", "marker_position")
SIGMA, POSES, REPEATS = 5e-5, 14, 4
SENTENCE = "Configurations scatter more than their repeats"


def campaign(seed, effect=0.0, repeats=REPEATS):
    """Readings of a planar arm, each pose repeated, with an error common to a configuration."""
    model = Model.assembled(planar_chain(), cell_of(PLACED))
    once = table_at(random_poses(model.chain, POSES, seed), [[0, 0, 0]])
    n = len(once)
    table = once.take(np.repeat(np.arange(n), repeats))
    table = replace(table, row=np.arange(n * repeats) + 2, repeat=np.tile(np.arange(repeats), n))
    rng = np.random.default_rng([seed, 1])
    exact = model.predict(table).reshape(-1, 3)
    common = effect * rng.normal(size=(len(table.configuration_labels), 3))
    noise = SIGMA * rng.normal(size=exact.shape) + common[table.configuration]
    return model, replace(table, position=exact + noise)


def test_it_is_the_textbook_decomposition():
    """Against the sums written out for one mean fitted to groups of unequal size."""
    _, table = campaign(0)
    table = table.take(np.arange(len(table)) % 7 != 3)
    observed = observe(table, "position")
    e = np.random.default_rng(1).normal(size=(len(table), 3))
    e -= e.mean(axis=0)
    found = lack_of_fit(observed, e.ravel(), 3)
    key = table.configuration * 100 + table.marker
    groups = [e[key == k] for k in np.unique(key)]
    pure = sum(((g - g.mean(axis=0)) ** 2).sum() for g in groups)
    between = sum(len(g) * (g.mean(axis=0) ** 2).sum() for g in groups)
    dof_pure = 3 * sum(len(g) - 1 for g in groups)
    dof_between = 3 * (len(groups) - 1)
    assert (found.dof_pure, found.dof_between) == (dof_pure, dof_between)
    np.testing.assert_allclose(found.F, between / dof_between / (pure / dof_pure), rtol=1e-12)


def test_a_configuration_effect_is_told_and_the_default_counts_with_it():
    """There the effect is in the noise model, so intervals are wider and nobody warns."""
    model, table = campaign(3, effect=1e-4)
    plain, result = identify(model, table, Options(method="ols")), identify(model, table)
    # The effect's variance is 4 times a reading's; means of 4 readings carry it whole.
    assert plain.noise.lack_of_fit.p < 1e-6 and 5 < plain.noise.lack_of_fit.F < 50
    assert any(w.startswith(SENTENCE) for w in plain.warnings)
    assert result.noise.kind.endswith("+configuration")
    assert result.noise.lack_of_fit.p < 1e-6
    assert not any(w.startswith(SENTENCE) for w in result.warnings)
    assert np.trace(result.covariance) > 2 * np.trace(plain.covariance)
    (common,) = (s for s in result.noise.sizes if s.name == "common to each configuration")
    assert 50e-6 < common.sigma < 200e-6  # 100 µm, from a handful of configurations
