"""The numbers of a study depend on its seed and tasks alone."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.study_folders import here, numbers, on_processes, run_study, write_study

from elastocal.errors import InputError


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_study(tmp_path_factory.mktemp("numbers") / "study")


@pytest.fixture(scope="module")
def whole(folder):
    """The study run once, in order, in one process."""
    results = folder.parent / "whole"
    assert run_study(folder, results).done == 12
    return numbers(results)


@pytest.mark.parametrize("workers", [1, 2])
def test_they_do_not_depend_on_the_number_of_processes(folder, whole, tmp_path, workers):
    ending = run_study(folder, tmp_path, lambda study: on_processes(study, workers))
    assert (ending.done, ending.failed, ending.complete) == (12, 0, True)
    pd.testing.assert_frame_equal(numbers(tmp_path), whole)


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.randoms(use_true_random=False), st.lists(st.integers(0, 7), max_size=4))
def test_they_depend_neither_on_order_nor_on_interruptions(
    folder, whole, tmp_path_factory, random, cuts
):
    results = tmp_path_factory.mktemp("cut")

    def shuffled(jobs):
        random.shuffle(jobs)
        return jobs

    for cut in cuts:
        run_study(folder, results, lambda study, cut=cut: here(study, shuffled, cut))
    assert run_study(folder, results, lambda study: here(study, shuffled)).complete
    pd.testing.assert_frame_equal(numbers(results), whole)


def test_another_seed_gives_other_numbers_and_is_refused_among_the_first(folder, whole, tmp_path):
    run_study(folder, tmp_path, seed=12)
    assert not np.isclose(numbers(tmp_path)["mean"], whole["mean"]).any()
    with pytest.raises(InputError, match="the seed was 12, now it is 11"):
        run_study(folder, tmp_path)
