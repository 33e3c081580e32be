"""The start from nothing: any attitude of the base, unknown tools, wrong readings among them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.calibration import cell_of, random_chain, table_at
from support.cells import kr270_chain, random_poses

from elastocal.identification.start import RegistrationProblem, register
from elastocal.model.manipulator import Model

SIGMA = 5e-5
POSES = 60

ATTITUDES = {
    "180° about x": Rotation.from_rotvec([np.pi, 0.0, 0.0]),
    "upside down, oblique": Rotation.from_euler("xyz", [175, 20, -130], degrees=True),
    "random": Rotation.random(random_state=0),
}


def flange_poses(chain, seed, n=POSES):
    model = Model.assembled(chain, cell_of(()))
    return model.flange_poses(table_at(random_poses(chain, n, seed)))


def case(
    chain, turn, seed, markers=1, wrong=0.0, free_base=True, free_markers=None, sigma=SIGMA,
    hint=False,
):  # fmt: skip
    """A registration problem, the true marker positions and where they would be read exactly."""
    rng = np.random.default_rng(seed)
    T = np.repeat(flange_poses(chain, seed), markers, axis=0)
    code = np.tile(np.arange(markers), POSES)
    true = rng.uniform(-0.25, 0.25, (markers, 3))
    t = rng.uniform(-3, 3, 3)
    R = turn.as_matrix()
    exact = (np.einsum("nij,nj->ni", T[:, :3, :3], true[code]) + T[:, :3, 3]) @ R.T + t
    points = exact + sigma * rng.normal(size=exact.shape)
    bad = rng.permutation(len(points))[: round(wrong * len(points))]
    points[bad] += rng.uniform(-0.4, 0.4, (len(bad), 3))
    free = np.ones(markers, bool) if free_markers is None else np.asarray(free_markers)
    start = np.where(free[:, None], 0.0, true)
    problem = RegistrationProblem(
        T[:, :3, :3], T[:, :3, 3], points, code, start, free, free_base,
        R if not free_base or hint else np.eye(3), t if not free_base or hint else np.zeros(3),
    )  # fmt: skip
    return problem, true, exact, bad


def predicted(problem, found):
    return found.places(problem.flange_rotation, problem.flange_position, problem.marker)


def assert_registered(problem, exact, found, sigma=SIGMA):
    """At most 15 unknowns against 180 coordinates or more of which 80 % are good: least squares
    would miss the exact points by σ·√(3·15/144) < 0.6 σ in length, the reweighted (L1) fit by
    at most √2 more (its efficiency in three dimensions is over one half): 1 σ rms.
    """
    assert np.allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    miss = np.linalg.norm(predicted(problem, found) - exact, axis=1)
    assert np.sqrt(np.mean(miss**2)) < sigma


@pytest.mark.parametrize("name", ATTITUDES)
def test_any_attitude_with_an_unknown_tool(name):
    problem, true, exact, _ = case(kr270_chain(), ATTITUDES[name], seed=1)
    found = register(problem)
    assert_registered(problem, exact, found)
    turned = Rotation.from_matrix(found.rotation) * ATTITUDES[name].inv()
    # 0.05 mm of noise on a cloud of points about 1 m wide, 60 of them
    assert turned.magnitude() < 1e-4
    np.testing.assert_allclose(found.markers, true, atol=2e-4)


def test_half_a_turn_with_wrong_readings_and_several_markers():
    turn = ATTITUDES["180° about x"]
    problem, _, exact, bad = case(random_chain(1), turn, 1, markers=3, wrong=0.2)
    found = register(problem)
    assert_registered(problem, exact, found)
    miss = np.linalg.norm(predicted(problem, found) - problem.points, axis=1)
    assert miss[bad].min() > np.delete(miss, bad).max()


def test_a_known_base_is_kept_and_the_tool_found():
    turn = Rotation.random(random_state=3)
    problem, true, exact, _ = case(kr270_chain(), turn, seed=3, markers=2, wrong=0.2,
                                   free_base=False)  # fmt: skip
    found = register(problem)
    assert np.array_equal(found.rotation, problem.base_rotation)
    assert np.array_equal(found.translation, problem.base_translation)
    assert_registered(problem, exact, found)
    # the base is exact, so each marker is a mean over 48 good turned readings
    np.testing.assert_allclose(found.markers, true, atol=5 * SIGMA)
