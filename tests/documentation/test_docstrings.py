"""The public names explain themselves, and the examples in their docstrings run."""

import doctest
import inspect
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.registered import forgotten

import elastocal as ec
from elastocal.above import Result, Saved
from elastocal.simulation import run_demo

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
FUNCTIONS = [name for name in ec.__all__ if not inspect.isclass(getattr(ec, name))]
# Methods of the public classes that their users call; the rest is told in the class's text.
METHODS = [
    (ec.Model, ("read", "read_plan", "table", "pose", "predict", "deflection", "B")),
    (ec.CalibratedArm, ("pose",)),
    (Saved, ("save",)),
    (Result, ("report", "plot", "to_dataframe")),
    (ec.Calibration, ("certificate", "unmet", "influence", "position")),
    (ec.Measurements, ("take",)),
    (ec.Robot, ("from_urdf", "from_mjcf", "from_dh")),
]
LISTED = {f"{cls.__name__}.{m}": getattr(cls, m) for cls, names in METHODS for m in names}
SHOWN = {name: getattr(ec, name) for name in ec.__all__} | LISTED
BARE = {name for name in ec.__all__ if name.endswith("Error")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("examples")
    run_demo(made)
    return made


@pytest.fixture(scope="module")
def results():
    """What identify and diagnose found in the same files before."""
    return {}


@pytest.fixture
def known(results, monkeypatch):
    """Most examples begin with one of two results, found once for all of them."""

    def remembered(verb, cell, data, **options):
        if options or not isinstance(data, str):
            return verb(cell, data, **options)
        key = verb.__name__, Path(cell).read_bytes(), Path(data).read_bytes()
        if key not in results:
            results[key] = verb(cell, data)
        return results[key]

    for verb in (ec.identify, ec.diagnose):
        monkeypatch.setattr(ec, verb.__name__, partial(remembered, verb))


def sections(thing):
    text = inspect.getdoc(thing) or ""
    return {line for line in text.splitlines() if line.endswith(":") and " " not in line}


@pytest.mark.parametrize("name", SHOWN)
def test_every_public_name_has_a_docstring_with_an_example(name):
    assert len(inspect.getdoc(SHOWN[name]) or "") > 40
    assert name in BARE or "Examples:" in sections(SHOWN[name])


@pytest.mark.parametrize("name", [*FUNCTIONS, *LISTED])
def test_every_argument_is_explained(name):
    """A function has what it returns and raises too; a method tells that in its first line."""
    found, text = sections(SHOWN[name]), inspect.getdoc(SHOWN[name])
    assert name in LISTED or {"Args:", "Returns:", "Raises:", "Examples:"} <= found
    for argument, parameter in inspect.signature(SHOWN[name]).parameters.items():
        stars = {parameter.VAR_KEYWORD: "**", parameter.VAR_POSITIONAL: "*"}
        told = f"\n    {stars.get(parameter.kind, '')}{argument}: "
        assert argument == "self" or told in text or f"`{argument}`" in text
        assert argument == "self" or parameter.annotation is not inspect.Parameter.empty


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.long if name == "next_poses" else ())
        for name in SHOWN
        if name not in BARE
    ],
)
def test_the_examples_run(name, folder, known, monkeypatch):
    monkeypatch.chdir(folder)
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(SHOWN[name], name, globs={"ec": ec, "np": np})
    assert example.examples
    told = []
    with forgotten():
        doctest.DocTestRunner(optionflags=FLAGS).run(example, out=told.append)
    assert not told, "".join(told)
