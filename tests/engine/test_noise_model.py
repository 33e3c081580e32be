"""Noise models of one's own: the same likelihood as a built-in one, and what is refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from engine.dense import Table, readings
from support.registered import forgotten

from elastocal.identification.noise_choice import estimate_noise, own_noise
from elastocal.identification.noise_structure import NoiseModel, Readings
from elastocal.messages import InputError
from elastocal.plugins import register_noise_model

UNBALANCED = readings(Table(configurations=10, markers=3, repeats=3), 4)


class Twin(NoiseModel):
    """Variances per axis, as the built-in "axis" has them."""

    name = "twin"
    description = "one variance per axis"

    def components(self, readings: Readings) -> Mapping[str, np.ndarray]:
        n = len(readings)
        return {
            a: np.tile(np.diag(row), (n, 1, 1)) for a, row in zip("xyz", np.eye(3), strict=True)
        }


class Markers(NoiseModel):
    """Variances per marker, as the built-in "marker" has them, from numbers of 0 and 1."""

    name = "markers"
    description = "one variance per marker"

    def components(self, readings: Readings) -> Mapping[str, np.ndarray]:
        return {
            f"marker {m}": (readings.marker == m).astype(float) for m in np.unique(readings.marker)
        }


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    with forgotten():
        yield


@pytest.mark.parametrize(
    ("model", "built_in", "shared"), [(Twin, "axis", ""), (Markers, "marker", "+configuration")]
)
def test_it_has_the_likelihood_of_a_built_in_model_that_says_the_same(
    model: type[NoiseModel], built_in: str, shared: str
) -> None:
    register_noise_model(model())
    own, other = (estimate_noise(UNBALANCED, name + shared) for name in (model.name, built_in))
    assert own.fit.log_likelihood == pytest.approx(other.fit.log_likelihood, abs=1e-6)
    np.testing.assert_allclose(own.fit.own, other.fit.own, rtol=1e-4)
    np.testing.assert_allclose(own.x, other.x, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(own.covariance.matrix, other.covariance.matrix, rtol=1e-3)
    some = UNBALANCED.take(np.arange(len(UNBALANCED)) % 2 == 0)
    for mine, its in zip(own_noise(own.fit, some), own_noise(other.fit, some), strict=True):
        np.testing.assert_allclose(mine, its, rtol=1e-3)


WRONG: dict[str, tuple[Callable[[int], Any], str]] = {
    "none": (lambda n: {}, "'wrong' has no components"),
    "negative": (lambda n: {"a": -np.ones(n)}, "negative variance in some direction"),
    "turned": (lambda n: {"a": np.tile(np.triu(np.ones((3, 3))), (n, 1, 1))}, "symmetric"),
    "nothing": (lambda n: {"a": np.zeros(n)}, "leaves a reading without noise"),
}


@pytest.mark.parametrize("case", WRONG)
def test_components_that_are_no_covariances_are_refused(case: str) -> None:
    made, told = WRONG[case]

    class Wrong(NoiseModel):
        name = "wrong"
        description = "wrong"

        def components(self, readings: Readings) -> Mapping[str, np.ndarray]:
            return made(len(readings))

    register_noise_model(Wrong())
    with pytest.raises(InputError, match=told):
        estimate_noise(UNBALANCED, "wrong")
