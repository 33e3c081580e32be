"""An exported MJCF is the user's own file, and rests in MuJoCo where the model does."""

import mujoco
import numpy as np
import pytest
from support.exports import GEOMETRY, LOAD, SPRINGS, exported, poses_of, write_result
from support.mjcf_text import ARM, LOADABLE, write_arm
from typer.testing import CliRunner

from elastocal.__main__ import commands
from elastocal.export.exportable import evaluate_pieces, keep
from elastocal.model.calibrated import Conditions
from elastocal.model.mjcf import MjcfArm
from elastocal.model.rigid import nominal_flanges

MICROMETRE, NANOMETRE = 1e-6, 1e-9


def corrected(folder, robot, effects, model="", text=LOADABLE, in_place=True, **how):
    write_arm(folder, text)
    cell, result = write_result(folder, f'mjcf = "arm.xml"\n{robot}', effects, model)
    calibrated, done = exported(cell, result, "mjcf", force=LOAD, **how)
    (folder / "new.xml").write_text(done.text, encoding="utf-8")
    assert done.checked is not None and done.checked < MICROMETRE
    assert in_place == (not [w for w in done.warnings if "cannot take" in w]), done.warnings
    return calibrated, done


@pytest.mark.parametrize("robot", ['base = "foot"', 'flange = "attachment_site"', 'flange = "l5"'])
def test_both_files_loaded_in_mujoco_differ_by_the_calibration(robot, tmp_path):
    calibrated, done = corrected(tmp_path, robot, GEOMETRY)
    named = {**dict(line.split(" = ") for line in robot.splitlines())}
    flange = named.get("flange", '"hand"').strip('"')
    flange = "elastocal_flange" if flange == "l5" else flange
    arm = MjcfArm.read(tmp_path / "new.xml", named.get("base", "").strip('"') or None, flange)
    kept = keep(calibrated, elastic=True, conditions=Conditions())
    expected = evaluate_pieces(kept.exported, Conditions()).calibrated_chain()
    q = poses_of(calibrated, 20, seed=3)
    assert np.abs(nominal_flanges(arm.chain, q) - nominal_flanges(expected, q)).max() < 1e-9
    # And by MuJoCo alone, where it was wrong by millimetres before.
    model, data = (lambda m: (m, mujoco.MjData(m)))(mujoco.MjModel.from_xml_string(done.text))
    data.qpos[[model.jnt_qposadr[j] for j in arm.joints]] = q[0]
    mujoco.mj_kinematics(model, data)
    T = np.eye(4) if arm.base == "world" else arm.tree.placed(arm.base)
    end = data.site(flange) if flange in arm.tree.frames else data.body(flange)
    wanted = (T @ nominal_flanges(expected, q[:1])[0])[:3, 3]
    assert np.linalg.norm(end.xpos - wanted) < MICROMETRE
    before = (T @ nominal_flanges(calibrated.model.chain, q[:1])[0])[:3, 3]
    assert np.linalg.norm(end.xpos - before) > 1e-4


def test_springs_weights_and_all_else_of_the_file(tmp_path):
    effects = (*SPRINGS, "off_axis_compliance:joint2", "link_mass_error")
    _, done = corrected(tmp_path, "", effects, "link_gravity = true")
    # The hand and its fingers weigh where the model has them, though the flange has moved.
    assert done.checked < NANOMETRE
    for kept in ("<!-- a comment that stays -->", 'name="drive2"', 'timestep="0.001"',
                 '<site name="reflector" pos="0.05 0 0.02"/>'):  # fmt: skip
        assert kept in done.text
    model = mujoco.MjModel.from_xml_string(done.text)
    assert model.nv == mujoco.MjModel.from_xml_string(LOADABLE).nv + 7
    stiffness = float(np.ravel(model.joint("elastocal_spring_joint2").stiffness)[0])
    assert stiffness == pytest.approx(1 / 2e-6)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)  # longer by the springs' zeros
    assert data.joint("a2").qpos == 0.2 and data.joint("f1").qpos == 0
    assert data.joint("elastocal_spring_joint2").qpos == 0
    assert model.site("elastocal_marker_M1").bodyid == model.body("hand").id


def test_an_export_of_an_export_keeps_one_set_of_springs_and_sites(tmp_path):
    _, done = corrected(tmp_path, 'flange = "hand"', SPRINGS, "link_gravity = true")
    _, again = corrected(tmp_path, 'flange = "hand"', SPRINGS, "link_gravity = true", done.text)
    for name in ("elastocal_spring_joint3", "elastocal_marker_M1", "elastocal_load_point"):
        assert again.text.count(f'name="{name}"') == 1


TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
STATED = ' meshdir="nowhere"'


@pytest.mark.parametrize("places", [' assetdir="nowhere"', "", "no compiler"])
def test_a_file_written_elsewhere_finds_its_meshes_from_there(places, tmp_path):
    (model := tmp_path / "model").mkdir()
    (out := tmp_path / "out" / "deep").mkdir(parents=True)
    text = ARM.replace("hull.stl", "hull.obj").replace(STATED, places)
    if places == "no compiler":
        text = text.replace('<compiler angle="degree" eulerseq="zyx"no compiler/>', "")
    place = model / "nowhere" if "nowhere" in places else model
    place.mkdir(exist_ok=True)
    (place / "hull.obj").write_text(TETRAHEDRON)
    write_arm(model, text)
    cell, result = write_result(model, 'mjcf = "arm.xml"\nbase = "foot"', GEOMETRY)
    for folder in (model, out):
        words = ["export", cell, result, "-o", folder / "new.xml", "--poses", "5", "-q"]
        done = CliRunner().invoke(commands(), [*map(str, words)], env={"COLUMNS": "300"})
        assert done.exit_code == 0 and "named relative to the file" in done.output, done.output
        assert mujoco.MjModel.from_xml_path(str(folder / "new.xml")).nmesh == 1
    assert str(tmp_path) not in (out / "new.xml").read_text()


NEW = {
    "two joints on a body": ('<joint name="b4" axis="0 0 1"/>', "shares its body"),
    "include": ('<include file="more.xml"/>', "do not all stand in the file"),
    "a spring": ('<site name="hook"/>', "its tendon 'pull' pulls at the arm"),
}
PULL = """<tendon><spatial name="pull" stiffness="9"><site site="hook"/><site site="eye"/></spatial>
</tendon>"""


@pytest.mark.parametrize("name", NEW)
def test_what_the_file_cannot_take_goes_into_a_new_one(name, tmp_path):
    more, reason = NEW[name]
    (tmp_path / "more.xml").write_text(
        '<mujocoinclude><body name="more"><geom size="0.1"/></body></mujocoinclude>'
    )
    text = LOADABLE.replace('<joint name="a4"/>', f'<joint name="a4"/>{more}')
    text = text.split("<keyframe>")[0] + (PULL if "hook" in more else "") + "</mujoco>"
    text = text.replace("<worldbody>", '<worldbody><site name="eye" pos="0 0 2"/>')
    _, done = corrected(tmp_path, "", SPRINGS, text=text, in_place=False)
    assert any("cannot take" in w and reason in w for w in done.warnings), done.warnings


@pytest.mark.parametrize("base", ["", 'base = "l1"'])
def test_a_tilting_pedestal_stands_before_the_first_joint(base, tmp_path):
    effects = [*SPRINGS, "base_compliance"]
    _, done = corrected(tmp_path, base, effects, "link_gravity = true")
    names = [name for name in done.text.split('"') if name.startswith("elastocal_spring_base")]
    assert names and 'name="drive2"' in done.text


HINDERED = {
    "general": ("</default>", '<general biastype="affine" biasprm="1 -5 -1" forcerange="-1 1"/>'
                "</default>"),
    "site": ("</default>", '<site type="box" size="1 1 1" euler="1 2 3"/></default>'),
    "gravcomp": ('<body name="l2"', '<body gravcomp="1" name="l2"'),
    "wind": ("<option ", '<option wind="9 0 0" density="9"/><option '),
    "no gravity": ("<option ", '<option><flag gravity="disable"/></option><option '),
    "no actuation": ("<option ", '<option><flag actuation="disable"/></option><option '),
}  # fmt: skip


@pytest.mark.parametrize("kind", HINDERED)
def test_what_the_file_sets_otherwise_does_not_hinder_the_arm(kind, tmp_path):
    old, new = HINDERED[kind]
    if "<flag passive" in new and not hasattr(mujoco.mjtDisableBit, "mjDSBL_PASSIVE"):
        new = new.replace("passive", "spring")
    last = LOADABLE.rpartition(old) if old == "</default>" else LOADABLE.partition(old)
    text = last[0] + new + last[2]
    _, done = corrected(tmp_path, 'base = "foot"', SPRINGS, "link_gravity = true", text)
    told = {"gravcomp": "gravcomp of l2 is 0", "no gravity": "gravity is switched on",
            "wind": "wind is 0 in this file"}  # fmt: skip
    assert any(told.get(kind, "") in w for w in done.warnings)
