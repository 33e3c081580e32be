"""Criteria from outside: what `register` takes, and what it refuses."""

import numpy as np
import pytest

from elastocal.errors import InputError
from elastocal.planning import (
    SpectralCriterion,
    TraceCriterion,
    criterion_named,
    make_criterion,
    register,
)
from elastocal.planning.criteria import CRITERIA


@pytest.fixture(autouse=True)
def forgotten():
    before = dict(CRITERIA)
    yield
    CRITERIA.clear()
    CRITERIA.update(before)


def test_a_registered_criterion_is_made_like_those_that_there_are():
    @register
    class Second(TraceCriterion):
        name = "second"

        @classmethod
        def of(cls, inputs):
            F = inputs.row({"b": 3.0})[None]
            return cls(np.stack([F.T @ F] * inputs.scenarios))

    assert criterion_named("second") is Second
    phi = make_criterion(
        "second", parameters=2, interest=np.arange(2), names=("a", "b"), sizes=np.array([1.0, 0.5])
    )
    # var(b) = 0.5² V_22 and 3² of it.
    assert float(phi.value(np.diag([7.0, 4.0])[None])) == pytest.approx(9 * 0.25 / 4)
    assert phi.certifiable


class Named(TraceCriterion):
    @classmethod
    def of(cls, inputs):
        return cls(np.eye(inputs.parameters)[None])


@pytest.mark.parametrize(
    ("parents", "content", "message"),
    [
        ((Named,), {"name": "D"}, "the name 'D' is taken by DeterminantCriterion"),
        ((Named,), {}, 'has no name that a cell file can state; add one, as in name = "my_'),
        ((Named,), {"name": "two\nlines"}, "has no name that a cell file can state"),
        ((Named,), {"name": 3}, "has no name"),
        ((TraceCriterion,), {"name": "own"}, r"\('own'\) is not complete: define of$"),
        ((SpectralCriterion,), {"name": "own"}, "not complete: define figure, phi, slope"),
        (
            (SpectralCriterion,),
            {
                "name": "own",
                "phi": lambda self, mu: 1 / mu[..., 0],
                "slope": lambda self, mu: mu,
                "figure": lambda self, value: value,
                "certifiable": True,
            },
            "is certifiable but has neither term nor cone",
        ),
        ((), {"name": "own"}, "takes a class derived from ScenarioCriterion"),
    ],
)
def test_what_is_no_whole_criterion_is_refused(parents, content, message):
    with pytest.raises(InputError, match=message):
        register(type("Own", parents, content))
    assert "own" not in CRITERIA


def test_an_unknown_name_is_told_with_the_nearest_and_all_that_there_are():
    with pytest.raises(InputError, match=r"'e' is unknown \(did you mean 'E'\?\); there are test_"):
        criterion_named("e")
