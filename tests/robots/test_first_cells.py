"""First cells run as `init` says: arms whose joints a weight does not turn, rails, the demo."""

import re

import numpy as np
import pytest
from support.design_commands import elastocal
from support.robot_files import told_by_init, urdf
from support.robots import KR270

import elastocal as ec

SCARA = (
    "type,theta0_deg,d_mm,a_mm,alpha_deg,lower_mm,upper_mm\nrevolute,0,0,260,0,,\n"
    "revolute,0,0,240,180,,\nprismatic,0,0,0,0,0,160\nrevolute,0,40,0,0,,\n"
)
PLAN = "configuration,q1_deg,q2_deg,q3_mm,q4_deg\n1,10,20,50,0\n2,-40,60,120,30\n3,80,-50,20,-60\n"


def run(*words):
    done = elastocal(*words)
    return done.exit_code, " ".join(done.stdout.split()), " ".join(done.stderr.split())


def test_a_scara_simulates_at_any_seed_though_weights_turn_no_upright_joint(tmp_path):
    (tmp_path / "dh.csv").write_text(SCARA)
    (tmp_path / "plan.csv").write_text(PLAN)
    assert told_by_init(tmp_path / "dh.csv")[0] == 0
    cell = tmp_path / "cell.toml"
    hangs = r"link_radius_mm = \[0, 0, (.|\n)*stays below it(.|\n)*normal = \[0, 0, -1\]"
    assert re.search(hangs, cell.read_text())
    assert [str(e) for e in ec.read_cell(cell).model.effects][4:] == ["joint_compliance:joint3"]
    every = cell.read_text().replace("joint_compliance:joint3", "joint_compliance")
    (tmp_path / "every.toml").write_text(every)
    for name in ("cell.toml", "every.toml"):
        for seed in range(3):
            code, _, err = run("simulate", tmp_path / name, tmp_path / "plan.csv", "-o",
                               tmp_path / "data.csv", "--draw", 1 + seed, "--load", 0, 0, -5,
                               "--seed", seed)  # fmt: skip
            assert code == 0, err


def test_the_load_is_guessed_from_the_arm_and_not_from_its_rail(tmp_path):
    (tmp_path / "arm.urdf").write_text(urdf())
    assert told_by_init(tmp_path / "arm.urdf")[0] == 0
    alone = ec.read_cell(tmp_path / "cell.toml").design.loads
    rail = (
        '<link name="ground"/><joint name="rail" type="prismatic"><parent link="ground"/>'
        '<child link="base_link"/><axis xyz="1 0 0"/>'
        '<limit lower="-20" upper="20" effort="1" velocity="1"/></joint>'
    )
    (tmp_path / "rail.urdf").write_text(urdf(rail))
    assert "reach 1." in told_by_init(tmp_path / "rail.urdf")[1]
    assert ec.read_cell(tmp_path / "cell.toml").design.loads == pytest.approx(alone)
    # The largest of this build: 2.6 kN at 2.9 m.
    (tmp_path / "long.urdf").write_text(urdf(scale=6))
    assert told_by_init(tmp_path / "long.urdf")[0] == 0
    assert abs(ec.read_cell(tmp_path / "cell.toml").design.loads).max() <= 3000


@pytest.mark.parametrize(
    ("new", "told"),
    [
        (lambda mass: "2", "Note: the file states 2 kg for 6 of 6 links, which looks like"),
        (lambda mass: f"{mass / 40:g}", "links weigh 20.8 kg together, where arms of that length"),
        (lambda mass: f"{mass:g}", ""),
    ],
)
def test_masses_that_nobody_weighed_do_not_bend_the_joints(tmp_path, new, told):
    """It is said in the terminal, in the head of the cell, and beside the key."""
    text = KR270.read_text(encoding="utf-8")
    text = re.sub(r'mass value="([^"]*)"', lambda m: f'mass value="{new(float(m[1]))}"', text)
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8")
    code, said, _ = run("init", tmp_path / "arm.urdf", "-o", tmp_path / "cell.toml")
    cell = (tmp_path / "cell.toml").read_text(encoding="utf-8")
    assert code == 0 and told in said and told in " ".join(cell.split())
    assert ("link_gravity is off; put in the masses of the data sheet" in said) == bool(told)
    assert ("the file's masses look like placeholders" in cell) == bool(told)
    assert ec.read_cell(tmp_path / "cell.toml").model.link_gravity == (not told)


def test_drawn_compliances_are_those_that_identify_expects(tmp_path):
    """Else the first simulation that `init` proposes is told that its loads are in another unit."""
    (tmp_path / "arm.urdf").write_text(KR270.read_text(encoding="utf-8"), encoding="utf-8")
    ec.init(tmp_path / "arm.urdf", tmp_path / "cell.toml")
    model, rng = ec.Model(tmp_path / "cell.toml"), np.random.default_rng(0)
    q = rng.uniform([-1, -2, 0.5, -1, -1, -1], [1, -0.5, 2, 1, 1, 1], (20, 6))
    fit = ec.identify(model, ec.simulate(model, q, draw=1.0, load=[0, 0, -3000], seed=0))
    assert fit.finding("load_unit") is None
    text = (tmp_path / "cell.toml").read_text().replace(", -3000]", ", -300000]")  # it carries that
    (tmp_path / "cell.toml").write_text(text)
    ec.simulate(tmp_path / "cell.toml", q, draw=1.0, load=[0, 0, -300000], seed=0)
    assert 1e-7 < fit.params["joint2.compliance"] < 1e-6  # of the KR 270: 2.9e-7
