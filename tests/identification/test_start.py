"""Starting values: base, markers, target orientation and cable found from the data alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.calibration import (
    BASE,
    PLACED,
    cell_of,
    measured,
    random_chain,
    table_at,
    true_values,
    with_values,
)
from support.cells import random_poses

from elastocal.cell.arm_description import Tracker
from elastocal.identification.start import start_values
from elastocal.model.manipulator import Model
from elastocal.simulation import simulate

SIGMA = 5e-5
ATTITUDES = {
    "half a turn": Rotation.from_rotvec([np.pi, 0.0, 0.0]),
    "upside down, oblique": Rotation.from_euler("xyz", [175, 20, -130], degrees=True),
    "as mounted": None,
}


@pytest.mark.parametrize("name", ATTITUDES)
def test_base_and_tools_are_found_from_any_attitude(name):
    """At most 15 unknowns against 180 readings of which a fifth are wrong: least squares of the
    others would miss the exact points by σ·√(3·15/144) < 0.6 σ in length, the reweighted fit by
    at most √2 more (its efficiency in three dimensions is over one half): 1 σ rms."""
    rng, turn = np.random.default_rng(1), ATTITUDES[name]
    markers = {f"M{k}": np.zeros(3) for k in range(3)}
    model = Model.assembled(random_chain(1), cell_of(PLACED, markers))
    truth, base = true_values(model, rng), [model.names.index(n) for n in BASE]
    truth[base] = 0.0 if turn is None else np.append(rng.uniform(-3, 3, 3), turn.as_rotvec())
    plan = table_at(random_poses(model.chain, 60, 1), markers=tuple(markers))
    table = measured(model, plan, truth, SIGMA, rng)
    bad = rng.permutation(180)[:36]
    table.position[bad] += rng.uniform(-0.4, 0.4, (36, 3))
    free = np.setdiff1d(np.arange(len(truth)), base) if turn is None else None
    x = start_values(model, table, free=free)
    assert turn is not None or not x[base].any(), "a known base is kept"
    miss = np.linalg.norm(
        (model.predict(table, x) - model.predict(table, truth)).reshape(-1, 3), axis=1
    )
    assert np.sqrt(np.mean(miss**2)) < SIGMA
    off = np.linalg.norm(model.predict(table, x).reshape(-1, 3) - table.position, axis=1)
    assert off[bad].min() > np.delete(off, bad).max()


def test_pose_start_finds_the_orientation_of_the_target():
    seed, rng = 1, np.random.default_rng(1)
    chain = random_chain(seed)
    effects = ("base_frame", "marker_position", "marker_orientation")
    markers = {"M1": np.zeros(3), "M2": np.zeros(3)}
    tracker = Tracker(rotation_sigma=1e-4)
    model = Model.assembled(chain, cell_of(effects, markers, tracker, observe="pose"))
    truth = true_values(model, rng)
    for name in ("M1", "M2"):
        rows = [model.names.index(f"marker:{name}.r{k}") for k in "xyz"]
        # any turn of the target, half turns among them
        vector = np.pi * np.eye(3)[seed % 3] if name == "M1" else None
        turn = Rotation.random(random_state=rng) if vector is None else Rotation.from_rotvec(vector)
        truth[rows] = turn.as_rotvec()
    plan = table_at(random_poses(chain, 30, seed), markers=("M1", "M2"))
    table = simulate(model, replace(plan, rotation=np.zeros((len(plan), 3))), truth, rng)
    x = start_values(model, table)
    for name in ("M1", "M2"):
        rows = [model.names.index(f"marker:{name}.r{k}") for k in "xyz"]
        turn = Rotation.from_rotvec(x[rows]) * Rotation.from_rotvec(truth[rows]).inv()
        # 1e-4 rad about each of 3 axes, a mean over 30: 3.2e-5 rms; four times that
        assert turn.magnitude() < 1.3e-4
    base = [model.names.index(name) for name in BASE[3:]]
    turn = Rotation.from_rotvec(x[base]) * Rotation.from_rotvec(truth[base]).inv()
    assert turn.magnitude() < 1e-7  # positions are exact here


def distance_case(seed, direction, wrong, rows=80):
    chain, rng = random_chain(seed, 4), np.random.default_rng(seed)
    model = Model.assembled(
        chain, cell_of(("distance_sensor", "marker_position"), observe="distance")
    )
    anchor = direction / np.linalg.norm(direction) * rng.uniform(0.8, 2.5) + [0, 0, 0.4]
    values = dict(zip((f"tracker.anchor_{k}" for k in "xyz"), anchor, strict=True))
    values |= {"tracker.length_offset": rng.uniform(-0.2, 0.2)}
    values |= {f"marker:M1.{k}": rng.uniform(-0.15, 0.15) for k in "xyz"}
    truth = with_values(model, values)
    table = measured(model, table_at(random_poses(chain, rows, seed)), truth, 2e-4, rng)
    bad = rng.permutation(rows)[: round(wrong * rows)]
    distance = table.distance.copy()
    distance[bad] += rng.choice([-1, 1], len(bad)) * rng.uniform(0.02, 0.3, len(bad))
    return model, replace(table, distance=distance), truth


DIRECTIONS = np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(5).normal(size=(2, 3))])


@pytest.mark.parametrize("k", [2, *(pytest.param(k, marks=pytest.mark.long) for k in range(8))])
def test_distance_start_finds_an_anchor_anywhere(k):
    """7 unknowns from 80 distances, 0.2 mm of noise, a tenth of them wrong by 20 to 300 mm.

    soft_l1 at 2 mm bounds the pull of a wrong reading to 2 mm: 8 of 80 with random signs pull
    by 2 mm · √8/72 ≈ 0.08 mm in the data; 0.5 mm of it at the median is ample."""
    model, table, truth = distance_case(k, DIRECTIONS[k], 0.1)
    x = start_values(model, table)
    exact = simulate(model, table, truth, 0, noise=False).distance
    miss = np.abs(model.predict(table, x) - exact)
    assert np.median(miss) < 5e-4
    # The right anchor, not a mirror image decimetres away; range and offset trade off a little.
    np.testing.assert_allclose(x, truth, atol=0.05)
