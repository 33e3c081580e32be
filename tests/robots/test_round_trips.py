"""What `export` writes predicts poses that nobody fitted, as read by other programs."""

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def trips():
    sys.path.insert(0, str(BENCHMARKS))
    try:
        return importlib.import_module("round_trips")
    finally:
        sys.path.remove(str(BENCHMARKS))


def one(name, folder):
    rounds = trips()
    try:
        path = rounds.packaged()[name]
    except Exception as error:  # a package that is not installed
        pytest.skip(str(error))
    made = rounds.trip(name, path, folder)
    assert made.fitted < 1.3 * made.noise < made.nominal
    assert made.errors["mjcf"] < 1.3 * made.noise  # it holds the springs and weights too
    for form in rounds.FORMATS:
        assert made.passes(form), (form, made.errors[form], made.losses[form])


def test_a_packaged_arm_there_and_back(tmp_path):
    one("kr210l150", tmp_path)
