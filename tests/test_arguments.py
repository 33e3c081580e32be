"""The Python door: what a caller gives is checked and copied, what it gets cannot be changed."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzz import campaign

import elastocal as ec
from elastocal.above import LARGEST_SEED

SEEDS = (10**12, LARGEST_SEED)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ec.Model:
    folder = tmp_path_factory.mktemp("door")
    campaign.write(folder)
    return ec.Model(folder / "placed.toml")


@pytest.fixture(scope="module")
def data(model: ec.Model) -> ec.Measurements:
    return ec.simulate(model, poses(model), load=[0, 0, -500], repeats=2)


@pytest.fixture(scope="module")
def fit(model: ec.Model, data: ec.Measurements) -> ec.Calibration:
    return ec.identify(model, data)


def poses(model: ec.Model) -> np.ndarray:
    from elastocal.model.chain import joint_limits

    lower, upper = joint_limits(model.cell, model.chain)
    span = np.clip(upper, -2, 2) - np.clip(lower, -2, 2)
    return np.clip(lower, -2, 2) + span * np.random.default_rng(1).random((20, len(lower)))


ABSURD = [
    10**12,
    -1.5,
    np.nan,
    1e300,
    "",
    b"x",
    [],
    [[]],
    {},
    {1: 2},
    1j,
    len,
    np.array(3),
    np.zeros((4, 4)),
]
CALLS: dict[str, Any] = {
    "table": (["q", "force", "position"], lambda m, d, f, **k: m.table(**{"q": d.q[:2]} | k)),
    "pose": (["q", "x", "load"], lambda m, d, f, **k: m.pose(**{"q": d.q[0]} | k)),
    "Model": (["backend"], lambda m, d, f, **k: ec.Model(m.cell, **k)),
    "uncertainty": (["table"], lambda m, d, f, **k: f.uncertainty(**k)),
    "unmet": (["heldout"], lambda m, d, f, **k: f.unmet(**k)),
    "plot": (["kind"], lambda m, d, f, **k: f.plot(**k)),
    "predict": (["table", "x"], lambda m, d, f, **k: m.predict(**{"table": d} | k)),
    "B": (["table", "x"], lambda m, d, f, **k: m.B(**{"table": d} | k)),
    "simulate": (
        ["plan", "values", "draw", "load", "repeats", "seed"],
        lambda m, d, f, **k: ec.simulate(m, **{"plan": d.q} | k),
    ),
    "identify": (
        ["data", "test", "fixed", "method", "noise", "weights", "covariance", "intervals",
         "outliers", "knowledge", "prior", "constraints", "seed"],
        lambda m, d, f, **k: ec.identify(m, **{"data": d} | k),
    ),
    "design": (
        ["poses", "criterion", "target", "minutes", "curve", "augment", "knowledge", "prior",
         "effort", "candidates", "repeats", "loads", "repeatability", "marker_sigma", "levels",
         "per_level", "test_poses", "test_path", "test_box", "choose", "motion",
         "load_changes", "reference_every", "seed"],
        lambda m, d, f, **k: ec.design(m, **{"candidates": 1, "effort": "quick"} | k),
    ),
    "compensate": (
        ["arm", "targets", "load", "frame", "point", "near", "seed"],
        lambda m, d, f, **k: ec.compensate(**{"arm": f, "targets": np.zeros((0, 3))} | k),
    ),
    "compare": (
        ["old", "new", "load", "level", "poses", "seed"],
        lambda m, d, f, **k: ec.compare(**{"old": f, "new": f, "poses": 2} | k),
    ),
    "next_poses": (
        ["data", "batch", "require", "least_gain", "candidates", "seed"],
        lambda m, d, f, **k: ec.next_poses(m, **{"data": d, "candidates": 1} | k),
    ),
}  # fmt: skip
# These mean something: none by name, a factor or a seed that is any number.
MEANT = {
    ("simulate", "values", "{}"),
    *((verb, "seed", str(10**12)) for verb in ("simulate", "compare", "identify")),
    *((verb, name, str(10**12)) for verb, name in (("simulate", "draw"), ("unmet", "heldout"))),
    *(("identify", name, none) for name in ("fixed", "prior") for none in ("[]", "{}")),
}  # fmt: skip


@pytest.mark.parametrize("call", CALLS)
def test_what_cannot_be_is_an_error_that_names_the_argument(
    call: str, model: ec.Model, data: ec.Measurements, fit: ec.Calibration
) -> None:
    names, run = CALLS[call]
    for name in names:
        for value in ABSURD:
            if (call, name, str(value)) in MEANT:
                continue
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                with pytest.raises(ec.ElastocalError) as told:
                    run(model, data, fit, **{name: value})
            assert len(str(told.value)) < 2000


def test_a_misspelt_argument_is_told_with_its_function(model: ec.Model) -> None:
    with pytest.raises(TypeError, match=r"^identify\(\) .* 'tset' \(did you mean 'test'\?\)$"):
        ec.identify(model, "data.csv", tset="test.csv")


def test_what_the_caller_does_to_its_array_later_is_its_own(model: ec.Model) -> None:
    q, force = np.zeros((2, model.chain.n_joints)), np.array([0.0, 0.0, -10.0])
    table = model.table(q, force, position=(place := np.ones((2, 3))))
    q += 1
    force += 1
    place += 1
    assert (table.q == 0).all() and (table.force[:, 2] == -10).all() and (table.position == 1).all()


def test_nobody_writes_into_a_result(fit: ec.Calibration, model: ec.Model) -> None:
    for values in (fit.x, fit.arm.x, fit.covariance, ec.compare(fit, fit, poses=3).moved):
        before = values.copy()
        with pytest.raises(ValueError, match="read-only"):
            values[...] = 0.0
        assert np.array_equal(before, values)


@pytest.mark.parametrize("seed", SEEDS)
def test_any_seed_is_one(
    seed: int, model: ec.Model, data: ec.Measurements, fit: ec.Calibration, tmp_path: Path
) -> None:
    q = data.q[:1]
    one, two, three = (ec.simulate(model, q, draw=1, seed=s).position for s in (seed, seed, 0))
    assert np.array_equal(one, two) and not np.array_equal(one, three)
    four, five = (ec.simulate(model, q, seed=np.random.default_rng(seed)) for _ in "ab")
    assert np.array_equal(four.position, five.position)
    assert ec.compare(fit, fit, poses=3, seed=seed).verdict
    assert ec.identify(model, data, seed=seed).x.shape == fit.x.shape
    fit.arm.save(tmp_path / "arm.json", seed=seed)
    for beyond in (-1, LARGEST_SEED + 1):
        with pytest.raises(ec.InputError, match="seed"):
            ec.simulate(model, q, seed=beyond)
