"""Every preset reads its style, and what it reads is what was measured."""

import numpy as np
import pytest
from support.tracker_exports import (
    MARKERS,
    delimited,
    imported,
    kr270_readings,
    krl,
    rapid,
    spatialanalyzer,
)

from elastocal.errors import InputError
from elastocal.importing.mapping_file import PRESETS, preset_text, read_mapping


@pytest.fixture(scope="module")
def readings(tmp_path_factory):
    return kr270_readings(tmp_path_factory.mktemp("cell"))


def holds(found, degrees, points, shots=1):
    """The table has these joint values and points, in the order of the points."""
    q = np.repeat(degrees, points.shape[1] * shots, axis=0)
    xyz = np.repeat(points[:, None], shots, axis=1).reshape(-1, 3)
    np.testing.assert_allclose(np.degrees(found.table.q), q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.table.position * 1e3, xyz, rtol=0, atol=1e-9)
    names = [found.table.marker_names[m] for m in found.table.marker]
    assert names == list(MARKERS) * (len(names) // len(MARKERS))


TRACKERS = {
    "spatialanalyzer": spatialanalyzer,
    "polyworks": lambda p: delimited(p, "Name\tMeas X (mm)\tMeas Y (mm)\tMeas Z (mm)", "\t"),
    "leica": lambda p: delimited(p, "Point ID;X [mm];Y [mm];Z [mm]", ";", ","),
    "faro": lambda p: delimited(p, "Feature,X (mm),Y (mm),Z (mm)"),
}


@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize("log", ["kuka", "abb"])
def test_tracker_and_controller(tmp_path, readings, tracker, log):
    cell, degrees, points = readings
    files = {"points.txt": TRACKERS[tracker](points), "poses.txt": (
        krl(degrees) if log == "kuka" else rapid(degrees))}  # fmt: skip
    found = imported(tmp_path, files, presets=(tracker, log), cell=cell)
    holds(found, degrees, points)
    assert found.joined.how == "name"
    assert found.warnings == () and found.refused == ""
    assert found.fit.error < 1e-5


def test_joint_states_are_ordered_by_their_names(tmp_path, readings):
    cell, degrees, points = readings
    order = [2, 1, 0, 4, 3, 5]
    names = [f"joint_a{j + 1}" for j in order]
    head = ["%time", "field.header.stamp", *(f"field.name{i}" for i in range(6)),
            *(f"field.position{i}" for i in range(6))]  # fmt: skip
    rows = [
        ",".join(["1", str(10**18 + i), *names, *(f"{v:.12f}" for v in np.radians(q[order]))])
        for i, q in enumerate(degrees)
    ]
    log = "\n".join([",".join(head), *rows])
    mapping = """
[[source]]
preset = "spatialanalyzer"
files = ["points*"]
[[source]]
preset = "ros"
[joints]
names = ["joint_a1", "joint_a2", "joint_a3", "joint_a4", "joint_a5", "joint_a6"]
[join]
by = "order"
"""
    files = {"points.txt": spatialanalyzer(points), "joints.csv": log}
    holds(imported(tmp_path, files, mapping, cell=cell), degrees, points)


def test_units_of_the_axes_comment_decide(tmp_path, readings):
    _, degrees, points = readings
    files = {"p.txt": spatialanalyzer(points / 25.4, unit="in"), "j.dat": krl(degrees)}
    found = imported(tmp_path, files, presets=("spatialanalyzer", "kuka"))
    np.testing.assert_allclose(found.table.position * 1e3, points.reshape(-1, 3), atol=0.01)


def test_no_unit_is_guessed(tmp_path, readings):
    _, degrees, points = readings
    text = spatialanalyzer(points).replace("// AXES", "// axes unknown")
    files = {"p.txt": text.replace("(mm)", ""), "j.dat": krl(degrees)}
    with pytest.raises(InputError, match=r"column 3.*no unit.*length_unit='mm'"):
        imported(tmp_path, files, presets=("spatialanalyzer", "kuka"))


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_mappings_with_a_comment_on_what_they_read(name):
    assert preset_text(name).startswith("# ")
    (source,) = read_mapping(None, (name,)).sources
    assert source.columns and source.role in ("points", "joints", "both")


def test_unknown_preset_names_the_nearest():
    with pytest.raises(InputError, match=r"'kuca'.*'kuka'"):
        preset_text("kuca")
