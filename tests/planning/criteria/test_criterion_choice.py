"""The criterion asked for by name, and what is said where it cannot be had."""

import numpy as np
import pytest
from planning.criteria.cases import INTEREST, P

from elastocal.errors import InputError
from elastocal.planning.criteria import CRITERIA, make_criterion

A = np.ones((1, 2, 3, P))
GIVEN = {
    "parameters": P,
    "interest": INTEREST,
    "A": A,
    "combination": np.ones(P),
    "n_poses": 4,
}


def test_every_criterion_is_made_under_its_own_name():
    assert set(CRITERIA) == set("ADEGIc") | {"test_pose", "robust", "O1", "O2", "O3", "O4", "O5"}
    for name in CRITERIA:
        assert make_criterion(name, **GIVEN).name == name
        arms = GIVEN | {"scenarios": 2, "A": np.ones((2, 2, 3, P))}
        assert make_criterion(name, **arms, robust="worst").name == name


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("d", {}, "criterion 'd' is unknown .did you mean 'D'"),
        ("test-pose", {}, "did you mean 'test_pose'"),
        ("V", {}, "there are test_pose, robust, D, A, E, G, I, c, O1, O2, O3, O4, O5"),
        ("D", {"robust": "avrage"}, "did you mean 'average'"),
        ("D", {"scenarios": 3}, 'robust = "average" or "worst"'),
        ("D", {"interest": []}, "no parameter of interest is left"),
        ("A", {"interest": []}, "no parameter of interest is left"),
        ("E", {"interest": [1, 1]}, "repeated or negative"),
        ("O3", {"interest": [-1]}, "repeated or negative"),
        ("O5", {"interest": [0, P]}, f"parameter of interest {P} does not exist: there are {P}"),
        ("A", {"interest": [P]}, f"parameter of interest {P} does not exist"),
        ("test_pose", {"A": None}, "test_pose needs test poses"),
        ("G", {"A": None}, "G needs test poses"),
        ("I", {"A": None}, "I needs test poses"),
        ("I", {"A": A[0]}, r"shape \(2, 3, 6\) was given, not \(1, n, n, 6\)"),
        ("G", {"A": A[:, :0]}, r"shape \(1, 0, 3, 6\)"),
        ("test_pose", {"A": A * np.nan}, "not finite"),
        ("test_pose", {"A": 0 * A}, "no target depends on the parameters"),
        ("G", {"A": 0 * A}, "no target depends on the parameters"),
        ("test_pose", {"weights": np.ones(3)}, r"shape \(3,\) was given, not \(2\)"),
        ("test_pose", {"weights": np.array([1.0, -1.0])}, "none may be negative"),
        ("test_pose", {"weights": np.zeros(2)}, "one at least must be positive"),
        ("c", {"combination": None}, "c needs a parameter or combination"),
        ("c", {"combination": np.ones(2)}, r"shape \(2,\) was given, not \(6\)"),
        ("c", {"combination": np.zeros(P)}, "C of the c criterion is zero"),
        ("O1", {"n_poses": None}, "O1 needs the number of poses"),
        ("O1", {"n_poses": 0}, "number of poses, not 0"),
    ],
)
def test_what_is_missing_or_wrong_is_named(name, change, message):
    with pytest.raises(InputError, match=message):
        make_criterion(name, **(GIVEN | change))
