"""Starting values: base and markers are found from the data alone."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.calibration import BASE, PLACED, cell_of, measured, random_chain, table_at, true_values
from support.cells import random_poses

from elastocal.identification.start import start_values
from elastocal.model.manipulator import Model

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
