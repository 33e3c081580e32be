"""URDFs as they are found: grippers, mounts, limits, names, and what is no URDF at all."""

import numpy as np
import pytest
from support.robot_files import frame, slide, told_by_init, urdf

import elastocal as ec


def write(tmp_path, text, name="arm.urdf", encoding="utf-8"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
    return path


def flange_of(tmp_path, text):
    code, out, err = told_by_init(write(tmp_path, text))
    assert code == 0, err
    return ec.read_cell(tmp_path / "cell.toml").robot.flange, out


HAND = frame("hand", "link_6")
MIMIC = '<mimic joint="jl"/>'
THUMB = slide("t1", "hand", "thumb1") + slide("t2", "thumb1", "thumb2")


@pytest.mark.parametrize(
    ("extra", "flange"),
    [
        (HAND + slide("jl", "hand", "lf") + slide("jr", "hand", "rf"), "hand"),
        (HAND + slide("jl", "hand", "lf") + slide("jr", "hand", "rf", MIMIC), "hand"),
        (HAND + THUMB + slide("ji", "hand", "index") + slide("jm", "hand", "middle"), "hand"),
        (HAND + slide("jl", "hand", "lf") + slide("jr", "hand", "rf") + frame("cam", "link_3"),
         "hand"),
        (frame("camera", "link_6"), "tool0"),
        (slide("rod", "link_2", "rod"), "tool0"),
    ],
)  # fmt: skip
def test_the_flange_is_the_link_before_fingers_branch_off(extra, flange, tmp_path):
    text = urdf(extra).replace(frame("tool0", "link_6", "0.05 0 0"), "") if "hand" in extra else (
        urdf(extra)
    )  # fmt: skip
    assert flange_of(tmp_path, text)[0] == flange


@pytest.mark.parametrize("rpy", ["0 0 0", "-1.5707963267948966 0 0", "3.141592653589793 0 0.5"])
def test_the_mount_stands_as_in_the_root_of_the_file(rpy, tmp_path):
    text = urdf(frame("mount", "torso", "0 0.3 1.1", rpy), base="mount")
    text = text.replace('<link name="mount"/>', '<link name="torso"/>', 1)
    code, _, err = told_by_init(write(tmp_path, text), "--base", "mount")
    assert code == 0, err
    cell = ec.read_cell(tmp_path / "cell.toml")
    roll, _, yaw = map(float, rpy.split())
    up = [0, -np.sin(roll), np.cos(roll)] if yaw == 0 else [0, 0, -1]
    np.testing.assert_allclose(cell.model.nominal.base_rotation[:, 2], np.array(up), atol=1e-5)
    np.testing.assert_allclose(cell.workspace.keep_out[0].normal, up, atol=1e-4)
    assert "of 'mount' in the file's 'torso', z up" in (tmp_path / "cell.toml").read_text()


@pytest.mark.parametrize("limits", [("-inf", "inf"), ("-1e16", "1e16"), ("-1000", "1000")])
def test_limits_that_stand_for_none_are_none(limits, tmp_path):
    code, _, err = told_by_init(write(tmp_path, urdf(limits=limits)))
    assert code == 0, err
    text = (tmp_path / "cell.toml").read_text()
    assert text.count("the file has no limit: guess") == 6 and "joint1_deg = [-180, 180]" in text


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (urdf(limits=("-65", "85")), "limits -65, 85 rad are more than 14 turns"),
        (urdf(limits=("-166.2", "166.2")), "if these are degrees"),
        (urdf(scale=1000), "m before joint 1 is too long"),
        (urdf(scale=1e-3), "1.6 mm long together"),
        (urdf(frame("cam", "link_3", rpy="0 90 0")), "90 rad is more than two turns"),
    ],
)
def test_units_that_cannot_be_meant_are_refused(text, told, tmp_path):
    code, _, err = told_by_init(write(tmp_path, text))
    assert code == 2 and told in err


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("warning: something\n" + urdf(), "'warning: something' stands before <?xml"),
        ("\n" + urdf(), "blanks stand before <?xml"),
        (urdf() + "done\n", "'done' stands after the end of the robot"),
        (urdf().replace("link_3", "lïnk_3").encode("latin-1"), "byte 0xef, which is not UTF-8"),
        ("<!DOCTYPE html><html><body>404</body></html>", "is a web page"),
        ("version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
        (urdf(name="$(arg prefix)joint_{}"), "run xacro first: xacro arm.urdf > expanded.urdf"),
        (urdf(frame("f", "link_2", "0 0 $(optenv X 1)")), "run xacro first"),
        (urdf().replace("link_3", "${prefix}link_3"), "run xacro first"),
    ],
)
def test_what_is_no_urdf_is_told_with_what_to_do(text, told, tmp_path):
    code, _, err = told_by_init(write(tmp_path, text))
    assert code == 2 and told in err


def test_a_xacro_is_to_be_expanded_and_declared_encodings_are_read(tmp_path):
    code, _, err = told_by_init(write(tmp_path, urdf(), "arm.urdf.xacro"))
    assert code == 2 and "xacro arm.urdf.xacro > arm.urdf" in err
    text = urdf().replace('"1.0"?>', '"1.0" encoding="latin-1"?>').replace("arm", "ärm")
    assert told_by_init(write(tmp_path, text, encoding="latin-1"))[0] == 0
    text = '<robot name="arm"><gazebo><p file="$(find x)/y"/></gazebo>' + urdf().partition(
        '<robot name="arm">'
    )[2]  # fmt: skip
    assert told_by_init(write(tmp_path, text))[0] == 0


RAIL = (
    '<link name="ground"/><joint name="linear_axis" type="prismatic"><parent link="ground"/>'
    '<child link="base_link"/><origin xyz="0 0 0.1"/><axis xyz="1 0 0"/>'
    '<limit lower="-2.9" upper="2.9" effort="1" velocity="1"/></joint>'
)


def test_names_of_the_file_may_be_used_and_a_clash_is_no_shift(tmp_path):
    path = write(tmp_path, urdf(RAIL, name="joint{}"))
    code, out, err = told_by_init(path)
    assert code == 0 and "joint2 = joint1" in out, err
    cell = (tmp_path / "cell.toml").read_text()
    assert 'joint_names = "order"' in cell and "joint1_mm" in cell
    unstated = tmp_path / "own.toml"

    def model(limit, names="", effects='["joint_offset"]'):
        unstated.write_text(
            f'[robot]\nurdf = "arm.urdf"\nflange = "tool0"\n{names}\n[limits]\n{limit}\n'
            f"[model]\neffects = {effects}\n"
        )
        return ec.Model(str(unstated))

    with pytest.raises(ec.ElastocalError, match=r"\[limits\] names joint3, .* number 4"):
        model("joint3_deg = [-10, 20]")
    by_file = model("joint3_deg = [-10, 20]", 'joint_names = "file"')
    assert set(by_file.cell.limits) == {"joint4"}
    by_order = model("joint3_deg = [-10, 20]", 'joint_names = "order"')
    assert set(by_order.cell.limits) == {"joint3"}
    assert set(model("linear_axis_mm = [0, 100]").cell.limits) == {"joint1"}
    with pytest.raises(ec.ElastocalError, match="names joint7, but robot"):
        model("joint7_deg = [-10, 20]", 'joint_names = "file"')


def test_a_cell_that_leaves_the_flange_open_is_told_what_init_takes(tmp_path):
    write(tmp_path, urdf(frame("camera", "link_6")))
    (tmp_path / "cell.toml").write_text('[robot]\nurdf = "arm.urdf"\n')
    with pytest.raises(ec.ElastocalError, match=r"camera, tool0; .* \(init takes 'tool0'\)"):
        ec.Model(str(tmp_path / "cell.toml"))


def test_a_last_joint_that_looks_like_a_jaw_is_told(tmp_path):
    text = urdf(slide("grip", "link_6", "tool0"))
    flange, out = flange_of(tmp_path, text)
    assert flange == "tool0"
    assert "last joint 'grip' looks like a jaw of a gripper" in out
