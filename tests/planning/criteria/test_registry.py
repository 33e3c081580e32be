"""Criteria from outside: what `register` takes, and what it refuses."""

import numpy as np
import pytest

from elastocal.errors import InputError
from elastocal.planning.criteria import (
    CRITERIA,
    SpectralCriterion,
    TraceCriterion,
    criterion_named,
    register,
)


@pytest.fixture(autouse=True)
def forgotten():
    before = dict(CRITERIA)
    yield
    CRITERIA.clear()
    CRITERIA.update(before)


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
