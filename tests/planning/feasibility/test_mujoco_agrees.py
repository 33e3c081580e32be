"""The same solids in MuJoCo, with its own kinematics, collision and rays."""

import importlib

import numpy as np
import pytest
from planning.feasibility.small_cells import CHECK, DOWN, NOTHING

from elastocal.cell import read_cell
from elastocal.model.chain import joint_limits
from elastocal.model.manipulator import load_chain
from elastocal.planning.collision import END, Collisions
from elastocal.planning.feasibility import Feasibility

pytest.importorskip("mujoco")
TOLERANCE = 1e-5  # m between two implementations of GJK


@pytest.fixture(scope="module")
def rules():
    cell = read_cell(CHECK / "cell.toml")
    return Feasibility(cell, load_chain(cell))


def poses(rules, n, seed=0):
    lower, upper = joint_limits(rules.cell, rules.chain)
    return np.random.default_rng(seed).uniform(lower, upper, (n, len(lower)))


def judge(rules, slack):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(CHECK)
        module = importlib.import_module("mujoco_cell")
    return module.MujocoCell(rules.cell, rules.chain, rules.bodies, rules.pairs, slack)


@pytest.mark.parametrize("force", [DOWN, NOTHING], ids=["loaded", "not"])
def test_poses_in_contact_are_in_contact_and_free_ones_free(rules, force):
    loaded = bool(force.any())
    q = poses(rules, 800)
    hit = Collisions(rules.kinematics, rules.pairs).hits(rules.kinematics.poses(q, force))
    strict, lenient = judge(rules, -TOLERANCE), judge(rules, 1e-3)
    assert not any(strict.contacts(pose, loaded) for pose in q[~hit])
    assert all(lenient.contacts(pose, loaded) for pose in q[hit])
    assert 150 < hit.sum() < 750


def test_what_rays_cannot_reach_is_hidden(rules):
    """A ray is thinner than the beam: where it is stopped, so is the beam."""
    q = poses(rules, 400, seed=2)
    sight = next(rule for rule in rules.rules if rule.name == "line_of_sight")
    blocked = sight.broken(rules.kinematics.poses(q, DOWN))
    eye, end = judge(rules, 0.0), END * rules.cell.workspace.visibility.beam_radius
    by_ray = np.array([bool(eye.hidden(pose, end + 0.008, True)) for pose in q])
    assert (blocked | ~by_ray).all()
    # The beam's 8 mm decide few cases.
    assert (blocked & ~by_ray).sum() < 0.1 * len(q) and by_ray.sum() > 50
