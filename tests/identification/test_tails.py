"""What setting far readings apart makes of an estimate."""

import numpy as np
import pytest

from elastocal.identification.outliers import kept_of, rejection_point

N, SIZE = 300, 3


@pytest.mark.parametrize("dof", [3, 8])
def test_what_setting_far_readings_apart_makes_of_a_mean(dof):
    """Means of readings of which those beyond the rejection point are set apart, as identification
    does it: of the variance, and the size of what is kept, that are said."""
    rng, readings, draws = np.random.default_rng(4), 180, 600
    z = rng.standard_t(dof, size=(draws, readings, SIZE)) * np.sqrt(1 - 2 / dof)
    kept = np.ones(z.shape[:2], dtype=bool)
    for _ in range(8):
        count = kept.sum(axis=1)[:, None]
        mean = (z * kept[..., None]).sum(axis=1) / count
        off = z - mean[:, None]
        sigma = np.sqrt((off**2 * kept[..., None]).sum(axis=(1, 2)) / (SIZE * (count[:, 0] - 1)))
        kept = (np.abs(off) < rejection_point(readings * SIZE) * sigma[:, None, None]).all(axis=2)
    said = kept_of(dof, readings * SIZE, SIZE)
    assert readings * np.mean(mean**2) == pytest.approx(said.variance, rel=0.1)
    assert np.sqrt(np.mean(sigma**2)) == pytest.approx(said.sigma, rel=0.03)
    # No estimate knows more than the Fisher information of t, (dof + 1)/(dof + 3) over its scale.
    assert said.variance > (1 - 2 / dof) * (dof + 3) / (dof + 1)
