"""The cluster-robust covariance of a large table, in parts, equals the one of the whole table."""

import numpy as np
from support.calibration import PLACED, cell_of, measured, planar_chain, table_at, true_values
from support.cells import random_poses

from elastocal.identification.covariance import cluster_robust
from elastocal.identification.intervals import cluster_by_parts
from elastocal.identification.least_squares import Problem, fit
from elastocal.identification.weighted_problem import Partition, Weights
from elastocal.model.manipulator import Model
from elastocal.model.observations import observe

MARKERS = {"M1": np.array([0.1, 0, 0]), "M2": np.array([0, 0.1, 0.1])}


def fitted():
    model = Model.assembled(planar_chain(), cell_of(PLACED, MARKERS))
    rng = np.random.default_rng(0)
    truth = true_values(model, rng)
    plan = table_at(random_poses(model.chain, 40, 0), markers=("M1", "M2"))
    table = measured(model, plan, truth, 5e-5, rng)
    observed = observe(table, "position")
    columns = np.arange(len(model.parameters))
    weights = Weights("none", None, False, "")
    sizes = np.ones(len(columns))
    problem = Problem(model, observed, weights, truth, columns)
    return fit(problem, columns, truth, sizes), observed, weights


def test_equals_the_whole_table_however_it_is_cut():
    found, observed, weights = fitted()
    cluster = np.repeat(observed.configuration, 3)
    whole = cluster_robust(found.B, found.whitened, cluster, "CR1").matrix
    order = np.argsort(observed.configuration, kind="stable")
    for spans in (((0, 80),), ((0, 30), (30, 80)), ((0, 20), (20, 60), (60, 80))):
        parts = Partition(observed, weights, order, spans)
        np.testing.assert_allclose(cluster_by_parts(found, parts).matrix, whole, rtol=1e-7,
                                   atol=1e-9 * np.abs(whole).max())  # fmt: skip
