"""What read_urdf says about every kind of wrong file: where, what, and what to do."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from support.urdf_text import LIMIT, arm, joint, link

from elastocal.errors import InputError
from elastocal.model.urdf import read_urdf


def read(tmp_path: Path, text: str, base: str | None = None, flange: str | None = None):
    path = tmp_path / "arm.urdf"
    path.write_text(text, encoding="utf-8")
    return read_urdf(path, base, flange)


CASES: dict[str, tuple[str, str]] = {
    "not xml": ("hello", "not XML: syntax error in line 1, column 1"),
    "empty": ("", "not XML: no element found in line 1, column 1"),
    "broken": (arm().replace("</robot>", ""), "not XML: no element found in line 1, column"),
    "root": ("<sdf/>", "root element is <sdf>, a URDF has <robot.*this is SDF"),
    "no links": ("<robot/>", "has no <link>"),
    "xacro element": (
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="a"/></robot>',
        r"xacro macros are left in \(<xacro:include>\); run xacro first: xacro arm.urdf > expa",
    ),
    "xacro prefix": ("<robot><xacro:kuka/></robot>", "xacro macros are left in.*run xacro first"),
    "xacro value": (
        arm(replace={'xyz="0 0 1"': 'xyz="0 0 ${d}"'}),
        r"xacro macros are left in \('0 0 \$\{d\}' in <origin>\)",
    ),
    "no parent": (
        arm(replace={'<parent link="l1"/>': ""}),
        "joint 'q2' has no parent link; add <parent",
    ),
    "no child": (arm(replace={'<child link="l2"/>': "<child/>"}), "joint 'q2' has no child link"),
    "unknown parent": (
        arm(replace={'<parent link="l1"/>': '<parent link="l1x"/>'}),
        r"joint 'q2': parent link 'l1x' is not there \(did you mean 'l1'\?\)",
    ),
    "two parents": (
        arm(extra=joint("again", "l0", "l2")),
        "link 'l2' has two parents, joints 'q2' and 'again'; kinematic loops are not supported",
    ),
    "loop through root": (
        arm(extra=joint("back", "l4", "l0")),
        "joints .*q1.* form a closed loop.*open it at one joint",
    ),
    "loop beside": (
        arm(extra=link("a") + link("b") + joint("ab", "a", "b") + joint("ba", "b", "a")),
        "joints (ab, ba|ba, ab) form a closed loop",
    ),
    "two roots": (arm(extra=link("lost")), "2 links have no parent joint: l0, lost;.*connect"),
    "unnamed link": (arm(extra="<link/>"), 'link number 6 has no name; write <link name="…">'),
    "unnamed joint": (arm(extra='<joint type="fixed"/>'), "joint number 5 has no name"),
    "same link": (arm(extra=link("l3")), "two links are named 'l3'; names must be unique"),
    "same joint": (arm(extra=joint("q1", "l0", "l1")), "two joints are named 'q1'"),
    "no type": (arm(replace={' type="revolute"': ""}), "joint 'q1' has no type; write type="),
    "type": (
        arm(replace={'type="revolute"': 'type="revolut"'}),
        r"joint 'q1': unknown joint type 'revolut' \(did you mean 'revolute'\?\); valid: revol",
    ),
    "zero axis": (
        arm(replace={LIMIT: LIMIT + '<axis xyz="0 0 0"/>'}),
        'joint \'q1\': axis is zero; give a direction such as xyz="0 0 1"',
    ),
    "two numbers": (
        arm(replace={LIMIT: LIMIT + '<axis xyz="0 1"/>'}),
        "joint 'q1', axis xyz: '0 1' is not three numbers",
    ),
    "nan": (
        arm(replace={'xyz="0 0 1"': 'xyz="0 0 nan"'}),
        "joint 'q1', origin xyz: 'nan' is not a finite number",
    ),
    "huge": (arm(replace={'xyz="0 0 1"': 'rpy="0 0 1e999"'}), "origin rpy: '1e999' is not a fin"),
    "garbage": (arm(replace={'lower="-1"': 'lower="-1_0"'}), "limit lower: '-1_0' is not a finite"),
    "no limit": (arm(replace={LIMIT: ""}), "joint 'q1' is revolute without <limit>; add <limit"),
    "no room": (
        arm(replace={'lower="-1" upper="2"': ""}),
        "joint 'q1': limits lower=0, upper=0 leave no room to move",
    ),
    "mass": (arm(extra=link("m", -1)), "link 'm': mass -1 kg is negative"),
    "mass text": (arm(extra=link("m", "1kg")), "link 'm', mass value: '1kg' is not a finite"),
    "no mass": (
        arm(extra='<link name="m"><inertial/></link>'),
        "link 'm': <inertial> without <mass",
    ),
    "mimic": (
        arm(replace={LIMIT: LIMIT + '<mimic joint="q2"/>'}),
        "joint 'q1' mimics 'q2' and lies between base and flange; coupled joints are not supp",
    ),
    "mimic of nothing": (
        arm(replace={LIMIT: LIMIT + '<mimic joint="q22"/>'}),
        r"joint 'q1' mimics joint 'q22', which is not there \(did you mean 'q2'\?\)",
    ),
    "floating": (
        arm(replace={'type="revolute"': 'type="floating"'}),
        "joint 'q1' is floating and lies between base and flange",
    ),
    "few joints": (arm(3), r"3 moving joints between 'l0' and 'l3' \(q1, q2, q3\); 4 to 9 are"),
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
    with pytest.raises(InputError, match="no such file; check the path of the URDF file"):
        read_urdf(tmp_path / "nothing.urdf")
    with pytest.raises(InputError, match="is a directory; give the URDF file itself"):
        read_urdf(tmp_path)
    large = tmp_path / "large.urdf"
    with large.open("wb") as file:
        os.truncate(file.fileno(), 60_000_000)
    with pytest.raises(InputError, match="larger than 10 MB, which no URDF file is"):
        read_urdf(large)
    binary = tmp_path / "mesh.urdf"
    binary.write_bytes(b"\x00\x81solid\xff" * 10)
    with pytest.raises(InputError, match="not XML"):
        read_urdf(binary)
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
