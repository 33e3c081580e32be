"""No MJCF file makes MuJoCo take more memory or time than an arm needs, or wait for ever."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from elastocal.messages import InputError
from elastocal.model.mjcf import read_mjcf

pytest.importorskip("mujoco", reason="needs the extra 'mujoco'")

ARM = (
    '<body name="b0"><joint axis="0 0 1"/><geom size=".1"/><body pos="0 0 .3">'
    '<joint axis="0 1 0"/><geom size=".1"/><body pos="0 0 .3"><joint axis="0 1 0"/>'
    '<geom size=".1"/><body name="end" pos="0 0 .3"><joint axis="1 0 0"/><geom size=".1"/>'
    "</body></body></body></body>"
)
BODY = '<body><freejoint/><geom size=".1"/></body>'


def model(folder: Path, world: str = "", top: str = "", name: str = "arm.xml") -> Path:
    path = folder / name
    path.write_text(f"<mujoco>{top}<worldbody>{ARM}{world}</worldbody></mujoco>")
    return path


def nested(depth: int, count: int, inside: str = BODY) -> str:
    for _ in range(depth):
        inside = f'<replicate count="{count}" offset="1 0 0">{inside}</replicate>'
    return inside


WORLDS = {
    "nested replicates": nested(9, 10),
    "composite": '<body><freejoint/><composite type="cable" count="1000000 1 1" size="1"/></body>',
    "flexcomp": '<flexcomp name="f" type="grid" count="300 300 300" spacing=".1 .1 .1"/>',
    "many elements": '<site size=".1"/>' * 6000,
    "hfields": "".join(f'<hfield name="h{k}" nrow="900" ncol="900"/>' for k in range(2)),
    "mesh of bodies": '<flexcomp name="f" type="mesh" file="x.obj"/>',
}
TOPS = {
    "userdata": '<size nuserdata="2000000000"/>',
    "mesh": '<asset><mesh name="m" builtin="supersphere" params="90000 1 1"/></asset>',
}


def refused(path: Path, told: str) -> None:
    begun = time.process_time()
    with pytest.raises(InputError, match=told):
        read_mjcf(path, flange="end")
    assert time.process_time() - begun < 5


@pytest.mark.parametrize("world", WORLDS)
def test_what_is_replicated_is_counted(tmp_path: Path, world: str) -> None:
    told = (
        "makes a body of every vertex" if "x.obj" in WORLDS[world] else "more than 5000 are no arm"
    )
    refused(model(tmp_path, WORLDS[world]), told)


@pytest.mark.parametrize("top", TOPS)
def test_sizes_are_bounded(tmp_path: Path, top: str) -> None:
    refused(model(tmp_path, top=TOPS[top]), "no arm needs; take it out")


def test_what_an_arm_needs_is_read(tmp_path: Path) -> None:
    (tmp_path / "more.xml").write_text(f"<mujoco><worldbody>{BODY}</worldbody></mujoco>")
    top = '<size memory="1G" nuser_body="3" nkey="2"/><include file="more.xml"/>'
    top += '<asset><hfield name="h" nrow="100" ncol="100" size="1 1 1 1"/></asset>'
    assert read_mjcf(model(tmp_path, nested(2, 10), top), flange="end").n_joints == 4


def test_attached_models_count_as_often_as_they_are_attached(tmp_path: Path) -> None:
    """Each of four files attaches the next ten times."""
    for k in range(5):
        asset = f'<asset><model name="m" file="m{k + 1}.xml"/></asset>' if k < 4 else ""
        uses = "".join(f'<attach model="m" prefix="p{i}"/>' for i in range(10)) if k < 4 else ""
        (tmp_path / f"m{k}.xml").write_text(
            f'<mujoco>{asset}<worldbody><body name="b{k}">{uses}</body></worldbody></mujoco>'
        )
    top = '<asset><model name="m" file="m0.xml"/></asset>'
    refused(model(tmp_path, '<attach model="m" prefix="x"/>', top), "more than 5000")


@pytest.mark.parametrize("how", ["parent", "absolute", "link", "model", "nested"])
def test_includes_stay_in_the_folder(tmp_path: Path, how: str) -> None:
    outside, folder = tmp_path / "secret.xml", tmp_path / "arm"
    folder.mkdir()
    outside.write_text("<mujoco/>")
    name = {"parent": "../secret.xml", "absolute": str(outside), "link": "link.xml"}
    if how == "link":
        (folder / "link.xml").symlink_to(outside)
    include = f'<include file="{name.get(how, "../secret.xml")}"/>'
    if how == "model":
        include = '<asset><model name="m" file="../secret.xml"/></asset>'
    if how == "nested":
        (folder / "inner.xml").write_text(f"<mujoco>{include}</mujoco>")
        include = '<include file="inner.xml"/>'
    refused(model(folder, top=include), "outside its folder")


MESH = '<asset><mesh name="m" file="x"/></asset>'
SHAPE = '<body><freejoint/><geom type="mesh" mesh="m"/></body>'
FIELD = '<asset><hfield name="h" file="x" size="1 1 1 1"/></asset>'


@pytest.mark.parametrize("device", ["", "/dev/zero"])
def test_only_regular_files_are_opened(tmp_path: Path, device: str) -> None:
    if device:
        (tmp_path / "x").symlink_to(device)
    else:
        os.mkfifo(tmp_path / "x")
    refused(model(tmp_path, top='<include file="x"/>'), "not a regular file|outside its folder")
    assert read_mjcf(model(tmp_path, SHAPE, MESH), flange="end").n_joints == 4
    assert read_mjcf(model(tmp_path, top=FIELD), flange="end").n_joints == 4


def test_files_are_sized(tmp_path: Path) -> None:
    for name, size in (("big.xml", 11_000_000), ("x", 101_000_000)):
        with open(tmp_path / name, "wb") as file:
            file.truncate(size)
    refused(model(tmp_path, top='<include file="big.xml"/>'), "larger than 10 MB")
    begun = time.process_time()
    assert read_mjcf(model(tmp_path, SHAPE, MESH), flange="end").n_joints == 4  # it weighs nothing
    assert time.process_time() - begun < 5


def test_what_is_no_number_is_told_before_mujoco_logs_it(tmp_path: Path) -> None:
    refused(model(tmp_path, '<site name="nan" pos="0 NaN 0"/>'), "pos='0 NaN 0'> is no number")
    assert read_mjcf(model(tmp_path, '<site name="nan"/>'), flange="end").n_joints == 4


def test_a_file_that_includes_itself_is_named(tmp_path: Path) -> None:
    refused(model(tmp_path, top='<include file="arm.xml"/>'), "includes itself")
