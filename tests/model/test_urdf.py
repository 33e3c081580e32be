"""URDFs: the chain that is read, every kind of wrong file, and files as they are found."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from support.robot_files import frame, slide, told_by_init, urdf
from support.urdf_text import LIMIT, arm, joint, link

import elastocal as ec
from elastocal.messages import InputError
from elastocal.model.urdf import read_urdf


def read(tmp_path: Path, text: str, base: str | None = None, flange: str | None = None):
    path = tmp_path / "arm.urdf"
    path.write_text(text, encoding="utf-8")
    return read_urdf(path, base, flange)


def test_kinds_limits_and_default_axis(tmp_path: Path) -> None:
    spin = joint("q2", "l1", "l2", "continuous", '<axis xyz="0 3 4"/>')
    slide = joint("q3", "l2", "l3", "prismatic", '<axis xyz="0 0 -2"/>' + LIMIT)
    text = arm(replace={joint("q2", "l1", "l2"): spin, joint("q3", "l2", "l3"): slide})
    chain = read(tmp_path, text)
    assert chain.name == "arm"
    assert [j.name for j in chain.joints] == ["q1", "q2", "q3", "q4"]
    assert chain.kinds == ("revolute", "revolute", "prismatic", "revolute")
    np.testing.assert_allclose(chain.joints[0].axis, [1, 0, 0])  # URDF's default
    np.testing.assert_allclose(chain.joints[1].axis, [0, 0.6, 0.8])
    np.testing.assert_allclose(chain.joints[2].axis, [0, 0, -1])
    assert [(j.lower, j.upper) for j in chain.joints[:2]] == [(-1, 2), (-np.inf, np.inf)]
    assert chain.masses == ()


# --- what is wrong

CASES: dict[str, tuple[str, str]] = {
    "xacro prefix": ("<robot><xacro:kuka/></robot>", "xacro macros are left in.*run xacro first"),
    "no parent": (
        arm(replace={'<parent link="l1"/>': ""}),
        "joint 'q2' has no parent link; add <parent",
    ),
    "loop through root": (
        arm(extra=joint("back", "l4", "l0")),
        "joints .*q1.* form a closed loop.*open it at one joint",
    ),
    "type": (
        arm(replace={'type="revolute"': 'type="revolut"'}),
        r"joint 'q1': unknown joint type 'revolut' \(did you mean 'revolute'\?\); valid: revol",
    ),
    "zero axis": (
        arm(replace={LIMIT: LIMIT + '<axis xyz="0 0 0"/>'}),
        'joint \'q1\': axis is zero; give a direction such as xyz="0 0 1"',
    ),
    "nan": (
        arm(replace={'xyz="0 0 1"': 'xyz="0 0 nan"'}),
        "joint 'q1', origin xyz: 'nan' is not a finite number",
    ),
    "no limit": (arm(replace={LIMIT: ""}), "joint 'q1' is revolute without <limit>; add <limit"),
    "mass": (arm(extra=link("m", -1)), "link 'm': mass -1 kg is negative"),
    "mimic": (
        arm(replace={LIMIT: LIMIT + '<mimic joint="q2"/>'}),
        "joint 'q1' mimics 'q2' and lies between base and flange; coupled joints are not supp",
    ),
    "floating": (
        arm(replace={'name="q3" type="revolute"': 'name="q3" type="floating"'}),
        "joint 'q3' is floating and lies between base and flange",
    ),
    "many joints": (arm(10), r"10 moving joints between 'l0' and 'l10' \(q1, .*q10\); 4 to 9"),
    "two arms": (
        arm(extra="".join(
            link(f"{side}{i}") + joint(f"{side}{i}", before, f"{side}{i}")
            for side in ("left", "right")
            for i, before in enumerate(["l0", *(f"{side}{k}" for k in range(1, 5))], start=1)
        )),
        "several links could be the flange, one of each arm: l4, left5, right5; name",
    ),
}  # fmt: skip


@pytest.mark.parametrize("text, message", CASES.values(), ids=CASES.keys())
def test_wrong_files_are_explained(tmp_path: Path, capfd, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'arm.urdf'}: ")
    assert capfd.readouterr() == ("", "")


def test_base_and_flange_names_are_checked(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"base 'L0' is not there.*links: l0, l1, l2, l3"):
        read(tmp_path, arm(), base="L0")
    with pytest.raises(InputError, match=r"flange 'l44' is not there \(did you mean 'l4'"):
        read(tmp_path, arm(), flange="l44")
    with pytest.raises(InputError, match=r"flange 'Flansch' .* \(usual here: 'l4'\); links: l0"):
        read(tmp_path, arm(), flange="Flansch")
    with pytest.raises(InputError, match=r"flange 'l1' is not below base 'l3'; links.*: l4$"):
        read(tmp_path, arm(), base="l3", flange="l1")
    with pytest.raises(InputError, match=r"0 moving joints between 'l2' and 'l2' \(none\)"):
        read(tmp_path, arm(), base="l2", flange="l2")


def test_unreadable_files_are_explained(tmp_path: Path) -> None:
    large = tmp_path / "large.urdf"
    with large.open("wb") as file:
        os.truncate(file.fileno(), 60_000_000)
    with pytest.raises(InputError, match="larger than 10 MB, which no URDF file is"):
        read_urdf(large)
    entities = tmp_path / "entities.urdf"
    entities.write_text('<!DOCTYPE robot [<!ENTITY a "aa">]><robot name="&a;"/>')
    with pytest.raises(InputError, match="has a <!DOCTYPE>"):
        read_urdf(entities)
    deep = tmp_path / "deep.urdf"
    deep.write_text("<robot>" + "<a>" * 300_000 + "</a>" * 300_000 + "</robot>")
    with pytest.raises(InputError, match="<a> is nested more than 32 deep"):
        read_urdf(deep)
    many = tmp_path / "many.urdf"
    many.write_text("<robot>" + "".join(f'<link name="{k}"/>' for k in range(3000)) + "</robot>")
    with pytest.raises(InputError, match="more than 2000 links"):
        read_urdf(many)
    encoded = tmp_path / "encoded.urdf"
    encoded.write_bytes(b'<?xml version="1.0" encoding="shift_jis"?><robot/>')
    with pytest.raises(InputError, match=r"not XML|has no <link>"):
        read_urdf(encoded)


# --- as they are found


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
        (frame("cam", "link_6") + frame("r1/tool0", "link_6"), "r1/tool0"),
        (slide("rod", "link_2", "rod"), "tool0"),
    ],
)  # fmt: skip
def test_the_flange_is_the_link_before_fingers_branch_off(extra, flange, tmp_path):
    assert flange_of(tmp_path, urdf(extra))[0] == flange


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
        ("warning: something\n" + urdf(), "'warning: something' stands before <?xml"),
        ("\n" + urdf(), "blanks stand before <?xml"),
        (urdf() + "done\n", "'done' stands after the end of the robot"),
        (urdf().replace("?>", "?>\n").replace("link_3", "ï").encode("latin-1"),
         "line 3 has the byte 0xef, which is not UTF-8"),
        ("<!DOCTYPE html><html><body>404</body></html>", "is a web page"),
        ("version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
        (urdf(name="$(arg prefix)joint_{}"), "run xacro first: xacro arm.urdf > expanded.urdf"),
        (urdf(frame("f", "link_2", "0 0 $(optenv X 1)")), "run xacro first"),
        (urdf().replace("link_3", "${prefix}link_3"), "run xacro first"),
    ],
)  # fmt: skip
def test_what_is_no_urdf_is_told_with_what_to_do(text, told, tmp_path):
    code, _, err = told_by_init(write(tmp_path, text))
    assert code == 2 and told in err


def test_a_xacro_is_to_be_expanded_and_declared_encodings_are_read(tmp_path):
    code, _, err = told_by_init(write(tmp_path, urdf(), "arm.urdf.xacro"))
    assert code == 2 and "xacro arm.urdf.xacro > arm.urdf" in err
    text = urdf().replace('"1.0"?>', '"1.0" encoding="latin-1"?>').replace("arm", "ärm")
    assert told_by_init(write(tmp_path, text, encoding="latin-1"))[0] == 0
    gazebo = '<gazebo><p file="$(find x)/y"/></gazebo><link name="base_link"/>'
    text = urdf().replace('<link name="base_link"/>', gazebo)
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
    assert set(model("joint3_deg = [-10, 20]", 'joint_names = "file"').cell.limits) == {"joint4"}
    assert set(model("joint3_deg = [-10, 20]", 'joint_names = "order"').cell.limits) == {"joint3"}
    assert set(model("linear_axis_mm = [0, 100]").cell.limits) == {"joint1"}
    with pytest.raises(ec.ElastocalError, match="names joint7, but robot"):
        model("joint7_deg = [-10, 20]", 'joint_names = "file"')


def test_a_last_joint_that_looks_like_a_jaw_is_told(tmp_path):
    flange, out = flange_of(tmp_path, urdf(slide("grip", "link_6", "tool0")))
    assert flange == "tool0" and "last joint 'grip' looks like a jaw of a gripper" in out
