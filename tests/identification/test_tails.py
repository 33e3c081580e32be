"""Are readings set apart mistakes, or the far end of the noise itself?"""

import numpy as np
import pytest

from elastocal.identification.tails import kept_of, rejection_point, tails_of

N, SIZE = 300, 3


def drawn(rng, dof):
    """Errors in units of those that are kept, and which of them are: no component too far off."""
    z = rng.normal(size=(N, SIZE)) if dof is None else rng.standard_t(dof, size=(N, SIZE))
    kept = np.ones(N, dtype=bool)
    for _ in range(10):
        sigma = np.sqrt(np.mean(z[kept] ** 2))
        kept = (np.abs(z) < rejection_point(z.size) * sigma).all(axis=1)
    return z / sigma, kept


def test_normal_noise_has_no_tails_whatever_mistakes_there_are():
    rng = np.random.default_rng(1)
    found = [drawn(rng, None) for _ in range(20)]
    mistakes = rng.uniform(30, 300, size=(15, SIZE))
    assert sum(tails_of(z[kept], mistakes) is not None for z, kept in found) <= 1


def test_the_far_end_of_t_is_told_from_mistakes():
    rng, dofs = np.random.default_rng(2), []
    for _ in range(8):
        z, kept = drawn(rng, 3)
        mistakes = np.full((5, SIZE), 1000.0)
        apart = np.concatenate([z[~kept], mistakes])
        tails = tails_of(z[kept], apart)
        assert len(z[~kept]) and tails.counted[: -len(mistakes)].mean() > 0.8
        assert not tails.counted[-len(mistakes) :].any()
        # With those counted the t has the size of the noise: of which the kept ones have less.
        sigma = np.sqrt(np.mean(z**2))
        assert tails.scale * np.sqrt(3) == pytest.approx(sigma, rel=0.25)
        dofs.append(tails.dof)
    assert np.median(dofs) == pytest.approx(3, rel=0.2)


def test_few_readings_say_nothing():
    z = np.random.default_rng(3).standard_t(2, size=(10, 3))
    assert tails_of(z, np.full((1, 3), 9.0)) is None


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


def test_normal_noise_loses_nothing():
    said = kept_of(1e6, 540, SIZE)
    assert said.variance == pytest.approx(1, abs=1e-3) and said.sigma == pytest.approx(1, abs=1e-3)
