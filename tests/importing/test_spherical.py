"""Distance, azimuth, and zenith or elevation become the positions that they were read from."""

import numpy as np
import pytest
from support.tracker_exports import MARKERS, imported, kr270_readings, krl

from elastocal.messages import InputError
from elastocal.units import FACTORS

TURN = {"deg": 360.0, "gon": 400.0, "rad": 2 * np.pi}
MAPPING = """
[[source]]
files = ["points*"]
role = "points"
{extra}
[source.text]
delimiter = ";"
[source.columns]
name = "P"
range_{length} = "D"
azimuth_{angle} = "Hz"
{height}_{angle} = "V"
[source.names]
pattern = '^P(?P<configuration>[0-9]+)_(?P<marker>M[0-9])$'
[[source]]
preset = "kuka"
"""


@pytest.fixture(scope="module")
def readings(tmp_path_factory):
    return kr270_readings(tmp_path_factory.mktemp("cell"))


def read_by_a_tracker(points, angle="deg", height="zenith", clockwise=False):
    """(n, 3): distance, azimuth and height angle of points (n, 3), by atan2 and nothing of ours."""
    x, y, z = points.T
    az = np.arctan2(-y if clockwise else y, x)
    zen = np.arctan2(np.hypot(x, y), z)
    up = zen if height == "zenith" else np.pi / 2 - zen
    to = TURN[angle] / (2 * np.pi)
    return np.column_stack([np.linalg.norm(points, axis=1), az % (2 * np.pi) * to, up * to])


PLAIN = MAPPING.format(length="mm", angle="deg", height="zenith", extra="")


def brought_in(tmp_path, readings, polar, mapping=PLAIN):
    names = [f"P{i}_{m}" for i in range(1, 11) for m in MARKERS]
    rows = [";".join([n, *(f"{v:.12f}" for v in p)]) for n, p in zip(names, polar, strict=True)]
    files = {"points.csv": "\n".join(["P;D;Hz;V", *rows, ""]), "poses.dat": krl(readings[1])}
    return imported(tmp_path, files, mapping, cell=readings[0])


@pytest.mark.parametrize(
    ("length", "angle", "height", "clockwise"),
    [
        ("mm", "deg", "zenith", False),
        ("m", "gon", "elevation", True),
        ("mm", "rad", "zenith", True),
    ],
)
def test_every_unit_and_sense_gives_the_positions_back(
    tmp_path, readings, length, angle, height, clockwise
):
    points = readings[2].reshape(-1, 3)
    polar = read_by_a_tracker(points, angle, height, clockwise)
    if height == "zenith":  # the second face
        polar[::2, 1:] = np.array([0.5, 1.0]) * TURN[angle] + np.array([1, -1]) * polar[::2, 1:]
    polar[:, 0] /= FACTORS["length"][length]
    extra = 'azimuth = "clockwise"' if clockwise else ""
    mapping = MAPPING.format(length=length, angle=angle, height=height, extra=extra)
    found = brought_in(tmp_path, readings, polar, mapping)
    np.testing.assert_allclose(found.table.position * 1e3, points, rtol=0, atol=1e-6)
    assert found.warnings == ()


def test_azimuths_counted_the_other_way_are_told_with_a_cell(tmp_path, readings):
    polar = read_by_a_tracker(readings[2].reshape(-1, 3), clockwise=True)
    found = brought_in(tmp_path, readings, polar)
    assert any("azimuths counted the other way" in w for w in found.warnings)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda t: t.replace('azimuth_deg = "Hz"\n', ""), r"zenith without azimuth; map range_mm"),
        (lambda t: t.replace('zenith_deg = "V"\n', ""), "without zenith or elevation"),
        (lambda t: t.replace('"V"\n', '"V"\nelevation_deg = "Hz"\n'), "both zenith and elevation"),
        (lambda t: t.replace('"V"\n', '"V"\nx_mm = "D"\n'), "mapped twice, as x and as range"),
        (lambda t: t.replace("azimuth_deg", "azimuth_mm"), "unit mm is not one of its"),
        (lambda t: t.replace('role = "points"', 'role = "points"\nazimuth = "left"'),
         'takes "counterclockwise" or "clockwise"'),
    ],
)  # fmt: skip
def test_mistakes_in_the_mapping_are_told(tmp_path, readings, change, told):
    polar = read_by_a_tracker(readings[2].reshape(-1, 3))
    with pytest.raises(InputError, match=told):
        brought_in(tmp_path, readings, polar, change(PLAIN))


@pytest.mark.parametrize(
    ("column", "value", "told"),
    [
        (0, -1.0, r"points.csv, line 4: a range of -1 mm"),
        (2, -3.0, r"line 4: zenith of -3°, which lies beyond 0° to 360°.*elevation_deg"),
    ],
)
def test_what_no_tracker_reads_names_its_line(tmp_path, readings, column, value, told):
    polar = read_by_a_tracker(readings[2].reshape(-1, 3))
    polar[2, column] = value
    with pytest.raises(InputError, match=told):
        brought_in(tmp_path, readings, polar)
