"""Editing a URDF leaves what it does not mean to change as it was, to the byte."""

from __future__ import annotations

import difflib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.exports import GEOMETRY, exported, write_result
from support.robots import KR270, packaged_urdf

from elastocal.errors import InputError
from elastocal.model.xml_file import XmlFile
from elastocal.units import rpy_from_rotation

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


def text_of(tmp_path: Path, content: str | bytes):
    data = content if isinstance(content, bytes) else content.encode()
    return XmlFile(tmp_path / "arm.urdf", data, "a URDF")


def test_an_origin_is_changed_where_it_stands(tmp_path: Path) -> None:
    text = text_of(tmp_path, ODD)
    joints = {tag.stated["name"]: tag for tag in text.tags[0].all("joint")}
    text.set_in(joints["q>1"], "origin", {"xyz": "4 5 6", "rpy": "7 8 9"})
    text.set_in(joints["q2"], "origin", {"xyz": "1 1 1", "rpy": "2 2 2"})
    text.set_in(joints["q>1"], "child", {"link": "d"})
    text.insert(text.end, '<link name="d"/>')
    expected = ODD.replace("rpy='0 0 0'\n       xyz=\"1 2 3\"", 'rpy="7 8 9"\n       xyz="4 5 6"')
    expected = expected.replace('<child\n     link="b"/>', '<child\n     link="d"/>')
    expected = expected.replace(
        'type="fixed">', 'type="fixed"><origin xyz="1 1 1" rpy="2 2 2"/>'
    ).replace("</robot>", '<link name="d"/></robot>')
    assert text.result() == expected


def test_a_carriage_return_alone_ends_a_line(tmp_path: Path) -> None:
    """As XML has it; in the file written it would be a control character."""
    old = text_of(tmp_path, ODD.replace("\r\n", "\n").replace("\n", "\r")).result()
    assert old == ODD.replace("\r\n", "\n")


def changed_lines(old: str, new: str) -> list[str]:
    lines = difflib.ndiff(old.splitlines(), new.splitlines())
    return [line for line in lines if line[:1] in "+-"]


def test_only_origins_on_the_chain_change(tmp_path: Path) -> None:
    path, flange = packaged_urdf("UR5")
    written = write_result(tmp_path, f'urdf = "{path}"\nflange = "{flange}"', GEOMETRY)
    _, done = exported(*written, "urdf", frames=False)
    changed = changed_lines(path.read_text(), done.text)
    removed = [line for line in changed if line.startswith("-")]
    assert removed and all("<origin" in line for line in removed)
    assert len(removed) == 7  # six joints and the flange
    added = [line for line in changed if line.startswith("+") and "<origin" not in line]
    assert len(added) == 1 and "calibrated by elastocal" in added[0]


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


@given(
    st.floats(-np.pi, np.pi),
    st.sampled_from([np.pi / 2, -np.pi / 2, 1.0]),
    st.floats(-1e-6, 1e-6),
    st.floats(-np.pi, np.pi),
)
def test_roll_pitch_yaw_are_exact_also_where_they_are_not_unique(
    roll: float, pitch: float, near: float, yaw: float
) -> None:
    R = Rotation.from_euler("xyz", [roll, pitch + near, yaw]).as_matrix()
    back = Rotation.from_euler("xyz", rpy_from_rotation(R)).as_matrix()
    assert np.abs(back - R).max() < 4e-16 * 10


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
