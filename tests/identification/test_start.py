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
    """Half a turn of the target and any other; positions are exact here."""
    chain, rng = random_chain(1), np.random.default_rng(1)
    effects = ("base_frame", "marker_position", "marker_orientation")
    markers, tracker = {"M1": np.zeros(3), "M2": np.zeros(3)}, Tracker(rotation_sigma=1e-4)
    model = Model.assembled(chain, cell_of(effects, markers, tracker, observe="pose"))
    truth = true_values(model, rng)
    targets = [[model.names.index(f"marker:{name}.r{k}") for k in "xyz"] for name in markers]
    truth[targets[0]] = np.pi * np.eye(3)[1]
    truth[targets[1]] = Rotation.random(random_state=rng).as_rotvec()
    plan = table_at(random_poses(chain, 30, 1), markers=tuple(markers))
    table = simulate(model, replace(plan, rotation=np.zeros((len(plan), 3))), truth, rng)
    x = start_values(model, table)
    # 1e-4 rad about each of 3 axes, a mean over 30: 3.2e-5 rms; four times that
    base = [model.names.index(name) for name in BASE[3:]]
    for rows, most in ((targets[0], 1.3e-4), (targets[1], 1.3e-4), (base, 1e-7)):
        turn = Rotation.from_rotvec(x[rows]) * Rotation.from_rotvec(truth[rows]).inv()
        assert turn.magnitude() < most


def test_distance_start_finds_an_anchor():
    """7 unknowns from 80 distances, 0.2 mm of noise, a tenth of them wrong by 20 to 300 mm.

    soft_l1 at 2 mm bounds the pull of a wrong reading to 2 mm: 8 of 80 with random signs pull
    by 2 mm · √8/72 ≈ 0.08 mm in the data; 0.5 mm of it at the median is ample."""
    chain, rng = random_chain(2, 4), np.random.default_rng(2)
    cell = cell_of(("distance_sensor", "marker_position"), observe="distance")
    model = Model.assembled(chain, cell)
    values = {"tracker.anchor_z": rng.uniform(0.8, 2.5) + 0.4}
    values |= {"tracker.length_offset": rng.uniform(-0.2, 0.2)}
    values |= {f"marker:M1.{k}": rng.uniform(-0.15, 0.15) for k in "xyz"}
    truth = with_values(model, values)
    table = measured(model, table_at(random_poses(chain, 80, 2)), truth, 2e-4, rng)
    bad, distance = rng.permutation(80)[:8], table.distance.copy()
    distance[bad] += rng.choice([-1, 1], 8) * rng.uniform(0.02, 0.3, 8)
    x = start_values(model, replace(table, distance=distance))
    exact = simulate(model, table, truth, 0, noise=False).distance
    assert np.median(np.abs(model.predict(table, x) - exact)) < 5e-4
    # The right anchor, not a mirror image decimetres away; range and offset trade off a little.
    np.testing.assert_allclose(x, truth, atol=0.05)
