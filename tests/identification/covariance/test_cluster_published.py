"""Cluster-robust covariance against published values and closed forms.

The reference values are outputs printed in the documentation of the R package clubSandwich
(Pustejovsky; reference pages vcovCR.lm and vcovCR.lm_robust) for R's data set
ChickWeight (Crowder & Hand 1990): growth curves of 50 chicks on four diets, clusters of 2 to 12.
"""

from pathlib import Path

import numpy as np

from elastocal.identification.covariance import cluster_robust


def chicks():
    """weight (578,), time (578,), chick (578,), diet (578,)."""
    lines = (Path(__file__).parent / "chick_weight.csv").read_text().splitlines()[1:]
    days = [*range(0, 21, 2), 21]
    rows = []
    for chick, line in enumerate(lines, start=1):
        diet, weights = line.split(",")
        rows += [
            (float(w), d, chick, int(diet)) for w, d in zip(weights.split(), days, strict=False)
        ]
    weight, time, chick, diet = np.array(rows).T
    return weight, time, chick.astype(int), diet.astype(int)


def residual(B, y):
    return y - B @ np.linalg.lstsq(B, y, rcond=None)[0]


def test_clubsandwich_vcov_of_chick_weights():
    """lm(weight ~ Time + Diet:Time), vcovCR(type = "CR2") as printed, 7 decimals; SE and d.f. as
    conf_int prints them for the same fit by lm_robust."""
    weight, time, chick, diet = chicks()
    assert len(weight) == 578
    B = np.column_stack([np.ones(578), time, *(time * (diet == d) for d in (2, 3, 4))])
    order = np.random.default_rng(1).permutation(578)
    found = cluster_robust(B[order], residual(B, weight)[order], chick[order], "CR2")
    printed = [
        [3.9317840, -0.7851508, -0.2560762, -0.0750498, 0.2695861],
        [-0.7851508, 0.4360726, -0.3314209, -0.3436398, -0.3665016],
        [-0.2560762, -0.3314209, 1.3680862, 0.3475327, 0.3482061],
        [-0.0750498, -0.3436398, 0.3475327, 1.1195632, 0.3483146],
        [0.2695861, -0.3665016, 0.3482061, 0.3483146, 0.5416587],
    ]
    np.testing.assert_allclose(found.matrix, printed, rtol=0, atol=5.1e-8)
    np.testing.assert_allclose(found.std, [1.983, 0.660, 1.170, 1.058, 0.736], atol=5.1e-4)
    np.testing.assert_allclose(found.dof, [48.7, 31.4, 19.0, 19.0, 18.4], atol=0.051)
    x = np.linalg.lstsq(B, weight, rcond=None)[0]
    low, high = found.interval(x).T
    np.testing.assert_allclose(low, [23.874, 5.703, -0.837, 1.524, 1.317], atol=5.1e-4)
    np.testing.assert_allclose(high[[0, 1]], [31.84, 8.40], atol=5.1e-3)
