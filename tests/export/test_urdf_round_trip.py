"""Pinocchio reads an exported URDF as the calibrated arm; all else is as it was, to the byte."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from support.exports import GEOMETRY, exported, flanges_in_base, poses_of, write_result
from support.robots import KR270, PACKAGED, packaged_urdf, random_chain_urdf
from support.urdf_text import arm

from elastocal.export.robot_files import urdf_flanges
from elastocal.messages import InputError
from elastocal.model.calibrated import CalibratedArm
from elastocal.model.urdf import XmlFile, check_urdf

NANOMETRE = 1e-9


def frame_positions(text: str, calibrated: CalibratedArm, q: np.ndarray, base: str, frame: str):
    """Placements (n, 4, 4) of a frame in the base link by pinocchio alone, other joints at zero."""
    joints = [joint.name for joint in calibrated.model.chain.joints]
    return urdf_flanges(text, joints, base, frame, q)


def check(cell: Path, result: Path, base: str, flange: str, **wish) -> str:
    calibrated, done = exported(cell, result, "urdf", **wish)
    q = poses_of(calibrated, 20, seed=3)
    expected = flanges_in_base(calibrated, q, np.zeros(3))
    found = frame_positions(done.text, calibrated, q, base, flange)
    assert np.abs(found - expected).max() < NANOMETRE
    assert done.checked is not None and done.checked < NANOMETRE
    return done.text


@pytest.mark.parametrize("name", PACKAGED)
def test_flange_of_packaged_robots(name: str, tmp_path: Path) -> None:
    path, flange = packaged_urdf(name)
    tree = check_urdf(path)
    flange = flange or tree.last_link(tree.root)
    cell, result = write_result(tmp_path, f'urdf = "{path}"\nflange = "{flange}"', GEOMETRY)
    check(cell, result, tree.root, flange)


@pytest.mark.parametrize("seed", range(2))
def test_branches_slides_and_joints_above_the_base(seed: int, tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(random_chain_urdf(seed))
    cell, result = write_result(
        tmp_path, 'urdf = "arm.urdf"\nbase = "base"\nflange = "flange"', GEOMETRY, seed=seed
    )
    check(cell, result, "base", "flange", base_frame=True)


def test_a_flange_that_the_last_joint_moves_gets_a_mount(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(arm(5))
    cell, result = write_result(tmp_path, 'urdf = "arm.urdf"', GEOMETRY)
    text = check(cell, result, "l0", "l5")
    assert '<link name="elastocal_flange_mount"/>' in text
    # Of an exported file the mount is there already and only moves.
    (tmp_path / "once.urdf").write_text(text)
    again = write_result(tmp_path, 'urdf = "once.urdf"\nflange = "l5"', GEOMETRY, seed=2)
    assert check(*again, "l0", "l5").count('<link name="elastocal_flange_mount"/>') == 1


def test_frames_stand_where_they_were_identified_and_an_export_of_an_export_moves_them(
    tmp_path: Path,
) -> None:
    cell, result = write_result(tmp_path, f'urdf = "{KR270}"\nflange = "flange"', GEOMETRY)
    (tmp_path / "once.urdf").write_text(exported(cell, result, "urdf", base_frame=True)[1].text)
    robot = 'urdf = "once.urdf"\nbase = "base_link"'  # the flange is still found
    again = write_result(tmp_path, robot, GEOMETRY, seed=7)
    text = check(*again, "base_link", "flange", base_frame=True)
    assert text.count('link name="elastocal_tracker"') == 1
    calibrated, _ = exported(*again, "urdf", base_frame=True)
    q = poses_of(calibrated, 3, seed=2)
    for name in ("M1", "M2"):
        assert text.count(f'link name="elastocal_marker_{name}"') == 1
        placed = frame_positions(text, calibrated, q, "flange", f"elastocal_marker_{name}")
        own = [calibrated.values[f"marker:{name}.{k}"] for k in "xyz"]
        assert np.abs(placed[:, :3, 3] - own).max() < NANOMETRE
    point = frame_positions(text, calibrated, q, "flange", "elastocal_load_point")
    assert np.abs(point[:, :3, 3] - [0.1, 0.02, 0.2]).max() < NANOMETRE
    base = frame_positions(text, calibrated, q, "elastocal_tracker", "base_link")
    values = [calibrated.values[f"base.{k}"] for k in ("x", "y", "z", "rx", "ry", "rz")]
    assert np.abs(base[:, :3, 3] - values[:3]).max() < NANOMETRE
    assert np.abs(base[:, :3, :3] - pin.exp3(np.array(values[3:]))).max() < NANOMETRE


# The text

ODD = """<?xml version='1.0'?>
<!-- <joint name="q1"> in a comment is no joint -->\r
<robot name='odd'  xmlns:x="urn:x">
\t<link name="a"/><link name="b"><!-- > --></link>
  <joint type = "revolute" name="q>1" ><parent link='a' /><child
     link="b"/><origin rpy='0 0 0'
       xyz="1 2 3" /><calibration rising="0.5"/><limit lower="-1" upper="1"/></joint>
  <joint name="q2" type="fixed"><child link="c"/><parent link="b"/></joint><link name="c"/>
  <transmission name="t"><joint name="q>1"><origin xyz="9 9 9"/></joint></transmission>
</robot>
<!-- after -->"""


def text_of(tmp_path: Path, content: str):
    return XmlFile(tmp_path / "arm.urdf", content.encode(), "a URDF")


def test_an_origin_is_changed_where_it_stands(tmp_path: Path) -> None:
    text = text_of(tmp_path, ODD)
    joints = {tag.stated["name"]: tag for tag in text.tags[0].all("joint")}
    text.set_in(joints["q>1"], "origin", {"xyz": "4 5 6", "rpy": "7 8 9"})
    text.set_in(joints["q2"], "origin", {"xyz": "1 1 1", "rpy": "2 2 2"})
    text.set_in(joints["q>1"], "child", {"link": "d"})
    text.insert(text.end, '<link name="d"/>')
    expected = ODD.replace("rpy='0 0 0'\n       xyz=\"1 2 3\" />", 'rpy="7 8 9" xyz="4 5 6"/>')
    expected = expected.replace('<child\n     link="b"/>', '<child link="d"/>')
    expected = expected.replace(
        'type="fixed">', 'type="fixed"><origin xyz="1 1 1" rpy="2 2 2"/>'
    ).replace("</robot>", '<link name="d"/></robot>')
    assert text.result() == expected
    # As XML has it; in the file written a carriage return alone would be a control character.
    old = text_of(tmp_path, ODD.replace("\r\n", "\n").replace("\n", "\r")).result()
    assert old == ODD.replace("\r\n", "\n")


def test_a_foreign_link_of_that_name_is_not_overwritten(tmp_path: Path) -> None:
    text = KR270.read_text().replace(
        "</robot>",
        '<link name="elastocal_marker_M1"/><joint name="mine" type="fixed"><parent link="link_1"/>'
        '<child link="elastocal_marker_M1"/></joint></robot>',
    )
    (tmp_path / "arm.urdf").write_text(text)
    written = write_result(tmp_path, 'urdf = "arm.urdf"\nflange = "flange"', GEOMETRY)
    with pytest.raises(InputError, match="elastocal_marker_M1"):
        exported(*written, "urdf")
    exported(*written, "urdf", frames=False)


def test_markers_of_any_name_get_frames_of_their_own(tmp_path: Path) -> None:
    cell, result = write_result(tmp_path, f'urdf = "{KR270}"', ["joint_offset"])
    text = cell.read_text().replace("M1 =", '"A B" =').replace("M2 =", '"A_B" =')
    cell.write_text(text.replace("[model]", '"<&\\"ä>" = [0, 0, 1]\n[model]'), encoding="utf-8")
    _, done = exported(cell, result, "urdf")
    links = [e.get("name", "") for e in ElementTree.fromstring(done.text).iter("link")]
    markers = [name for name in links if name.startswith("elastocal_marker_")]
    assert markers == [f"elastocal_marker_{name}" for name in ("A_B", "A_B_", '<&"ä>')]
    _, mjcf = exported(cell, result, "mjcf")
    assert mjcf.checked is not None
