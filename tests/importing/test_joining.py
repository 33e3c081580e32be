"""Points find their joint values by order, name, time or standstill; nothing is lost silently."""

import re

import numpy as np
import pytest
from support.tracker_exports import imported

from elastocal.errors import InputError

POINTS = """
[[source]]
files = ["points*"]
role = "points"
columns = { name = "name", x_mm = "x", y_mm = "y", z_mm = "z" }
PATTERN
[[source]]
files = ["joints*"]
role = "joints"
columns = { name = "name", q1_deg = "a", q2_deg = "b" }
"""
TIMED = """
[[source]]
files = ["points*"]
columns = { time_s = "t", x_mm = "x", y_mm = "y", z_mm = "z" }
[[source]]
files = ["joints*"]
columns = { time_s = "t", q1_deg = "a", q2_deg = "b" }
"""


def mapping(
    join="", pattern=r"""names = { pattern = '^(?P<configuration>\w+?)_(?P<marker>\w+)$' }"""
):
    return POINTS.replace("PATTERN", pattern) + join


def table(header, *rows):
    return "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n"


def points(*names):
    return table("name,x,y,z", *((name, 1000 + i, i, 2 * i) for i, name in enumerate(names)))


def joints(*rows):
    return table("name,a,b", *rows)


def q1(found):
    return np.round(np.degrees(found.table.q[:, 0]), 9).tolist()


def test_by_name_in_any_order_with_leading_zeros_and_capitals(tmp_path):
    files = {
        "points.csv": points("P02_M1", "P01_M1", "P02_M2", "P01_M2"),
        "joints.csv": joints(("p1", 10, 1), ("p2", 20, 2)),
    }
    found = imported(tmp_path, files, mapping())
    assert found.joined.how == "name"
    assert q1(found) == [20, 10, 20, 10]


def test_points_without_a_pose_are_named_and_refused(tmp_path):
    files = {
        "points.csv": points("1_M1", "2_M1", "9_M1"),
        "joints.csv": joints((1, 10, 1), (2, 20, 2), (3, 30, 3)),
    }
    with pytest.raises(InputError, match=r"1 of 3 points.*9_M1 \(line 4\).*leave_out"):
        imported(tmp_path, files, mapping())
    found = imported(tmp_path, files, mapping('[join]\nunmatched = "leave_out"\n'))
    assert q1(found) == [10, 20]
    assert found.joined.left_out == ("9_M1 (line 4)",)
    assert found.joined.unused == ("3 (line 4)",)


ORDER = '[join]\nby = "order"\n'
PLAIN = "names = { pattern = '(?P<marker>M.)' }"


def test_by_order_a_marker_seen_again_begins_a_pose(tmp_path):
    files = {
        "points.csv": points("M1", "M2", "M1", "M1", "M2"),
        "joints.csv": joints(("", 10, 1), ("", 20, 2)),
    }
    found = imported(tmp_path, files, mapping(ORDER, PLAIN))
    assert q1(found) == [10, 10, 20, 20, 20]
    assert found.table.repeat.tolist() == [0, 0, 0, 1, 0]


def test_by_order_counts_must_agree_and_the_odd_visit_is_named(tmp_path):
    files = {
        "points.csv": points("M1", "M2", "M2", "M1", "M2", "M1", "M2"),
        "joints.csv": joints(("", 10, 1), ("", 20, 2)),
    }
    with pytest.raises(InputError, match=r"7 points in 3 visits.*2 poses.*begins at M1 \(line 2\)"):
        imported(tmp_path, files, mapping(ORDER, PLAIN))


def test_every_load_state_runs_through_the_poses(tmp_path):
    pattern = r"names = { pattern = '^(?P<load>\w+):(?P<marker>M.)$' }"
    files = {
        "points.csv": points("none:M1", "none:M1", "full:M1", "full:M1"),
        "joints.csv": joints(("", 10, 1), ("", 20, 2)),
    }
    text = mapping(ORDER, pattern) + "[loads]\nfull = { mass_kg = 100 }\n"
    found = imported(tmp_path, files, text)
    assert q1(found) == [10, 20, 10, 20]
    assert found.table.configuration.tolist() == [0, 1, 0, 1]
    np.testing.assert_allclose(found.table.force[:, 2], [0, 0, -980.665, -980.665])


def test_by_time_takes_the_nearest_with_the_offset(tmp_path):
    files = {
        "points.csv": table("t,x,y,z", (100.2, 1, 2, 3), (109.9, 4, 5, 6)),
        "joints.csv": table("t,a,b", *((k, k, 0) for k in range(0, 20, 2))),
    }
    found = imported(tmp_path, files, TIMED + "[join]\noffset_s = 100.0\nstill_deg = 5.0\n")
    assert found.joined.how == "time"
    assert q1(found) == [0, 10]
    np.testing.assert_allclose(found.table.time, [0, 9.7])
    with pytest.raises(InputError, match=r"1 of 2.*line 2, 0\.2 s from the nearest.*offset_s"):
        imported(tmp_path, files, TIMED + "[join]\noffset_s = 100.0\ntolerance_s = 0.15\n")


def test_by_standstill_takes_the_median_and_numbers_poses_by_joints(tmp_path):
    def log():
        for start, angle in ((0, 10.0), (10, 20.0), (20, 10.004)):
            for k in range(6):
                yield start + k, angle + 0.001 * (k % 2), 5
            for k in range(6, 10):
                yield start + k, angle + 2.0 * (k - 5), 5

    files = {
        "points.csv": table("t,x,y,z", (2, 1, 2, 3), (12.5, 4, 5, 6), (25, 7, 8, 9)),
        "joints.csv": table("t,a,b", *log()),
    }
    text = TIMED + '[join]\nby = "standstill"\nstill_s = 4\n'
    found = imported(tmp_path, files, text)
    np.testing.assert_allclose(np.degrees(found.table.q[:, 0]), [10.0005, 20.0005, 10.0045])
    assert found.table.configuration.tolist() == [0, 1, 0]
    with pytest.raises(InputError, match="never stood still for 60 s"):
        imported(tmp_path, files, text.replace("still_s = 4", "still_s = 60"))


def test_configurations_whose_joints_differ_are_named(tmp_path):
    files = {
        "data.csv": table("name,x,y,z,a,b", ("1_M1", 1, 2, 3, 10, 0), ("1_M2", 1, 2, 4, 12, 0))
    }
    text = r"""
[[source]]
columns = { name = "name", x_mm = "x", y_mm = "y", z_mm = "z", q1_deg = "a", q2_deg = "b" }
names = { pattern = '^(?P<configuration>\d)_(?P<marker>M\d)$' }
"""
    (warning,) = imported(tmp_path, files, text).warnings
    assert "differ by up to 2" in warning and ": 1;" in warning


def test_signs_offsets_order_and_coupling(tmp_path):
    files = {"data.csv": table("x,y,z,a,b,c", (1, 2, 3, 10, 20, 30))}
    text = """
[[source]]
columns = { x_mm = "x", y_mm = "y", z_mm = "z", q1_deg = "a", q2_deg = "b", q3_deg = "c" }
[joints]
order = [2, 1, 3]
sign = [1, -1, 1]
offset_deg = [0, 90, 0]
coupling = [{ joint = 3, of = 2, factor = 0.5 }, { joint = 2, of = 3, factor = 1.0 }]
"""
    found = imported(tmp_path, files, text)
    # q2 = -10 + 90 + 30 and q3 = 30 + 0.5 * (-10 + 90): couplings see the values before them.
    np.testing.assert_allclose(np.degrees(found.table.q), [[20, 110, 70]])


@pytest.mark.parametrize("by", ["time", "standstill"])
def test_the_offset_at_which_most_points_meet_a_standing_arm_is_told(by, tmp_path):
    """Eight visits of 6 s at unequal distances; the tracker's clock is 3600 s ahead."""
    start = np.cumsum([0, 20, 31, 17, 44, 23, 38, 29.0])
    log = [(t + s, 10 * k, -5 * k) for k, t in enumerate(start) for s in range(7)]
    read = [(t + 3 + 3600, 1000 + k, k, 2 * k) for k, t in enumerate(start)]
    files = {"points.csv": table("t,x,y,z", *read), "joints.csv": table("t,a,b", *log)}
    with pytest.raises(InputError) as caught:
        imported(tmp_path, files, TIMED + f'[join]\nby = "{by}"\n')
    told = re.search(r"with offset_s = (\S+) in \[join\] 8 of 8 points", str(caught.value))
    assert told and abs(float(told[1]) - 3600) <= 3.1
    join = f'[join]\nby = "{by}"\noffset_s = {told[1]}\n'
    found = imported(tmp_path, files, TIMED + join)
    assert q1(found) == [10.0 * k for k in range(8)]


def test_one_name_for_two_poses_is_refused(tmp_path):
    files = {"points.csv": points("1_M1"), "joints.csv": joints((1, 10, 1), (1, 20, 2))}
    with pytest.raises(InputError, match=r"joints.csv, line 3: pose 1 has other joint values.*2"):
        imported(tmp_path, files, mapping())


def test_by_time_says_where_the_arm_moved(tmp_path):
    files = {
        "points.csv": table("t,x,y,z", (1, 1, 2, 3), (5, 4, 5, 6)),
        "joints.csv": table(
            "t,a,b", (0, 0, 0), (1, 0, 0), (2, 0, 0), (4, 8, 0), (5, 9, 0), (6, 10, 0)
        ),
    }
    found = imported(tmp_path, files, TIMED)
    assert any("moved while 1 points were measured: line 3" in w for w in found.warnings)
