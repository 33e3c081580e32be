"""Points find their joint values by order, name, time or standstill; nothing is lost silently."""

import re

import numpy as np
import pytest
from support.tracker_exports import imported

from elastocal.messages import InputError

NAMED = r"""
[[source]]
files = ["points*"]
role = "points"
columns = { name = "name", x_mm = "x", y_mm = "y", z_mm = "z" }
names = { pattern = '^(?P<configuration>\w+?)_(?P<marker>\w+)$' }
[[source]]
files = ["joints*"]
columns = { name = "name", q1_deg = "a", q2_deg = "b" }
"""
ORDER = re.sub("names = .*", "names = { pattern = '(?P<marker>M.)' }", NAMED)
ORDER += '[join]\nby = "order"\n'
TIMED = """
[[source]]
files = ["points*"]
columns = { time_s = "t", x_mm = "x", y_mm = "y", z_mm = "z" }
[[source]]
files = ["joints*"]
columns = { time_s = "t", q1_deg = "a", q2_deg = "b" }
[join]
"""


def table(header, rows):
    return "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n"


def named(points, joints):
    """Points of these names, and rows of the log: name, q1; q2 is zero."""
    return {
        "points.csv": table("name,x,y,z", [(n, 1000, i, 2) for i, n in enumerate(points.split())]),
        "joints.csv": table("name,a,b", [(*row, 0) for row in joints]),
    }


def timed(points, joints):
    """Points at these times, and rows of the log: time, q1."""
    return {
        "points.csv": table("t,x,y,z", [(t, 1000 + k, k, 2) for k, t in enumerate(points)]),
        "joints.csv": table("t,a,b", [(*row, 0) for row in joints]),
    }


def q1(found):
    return np.round(np.degrees(found.table.q[:, 0]), 9).tolist()


def test_by_name_in_any_order_with_leading_zeros_and_capitals(tmp_path):
    files = named("P02_M1 P01_M1 P02_M2 P01_M2", [("p1", 10), ("p2", 20)])
    found = imported(tmp_path, files, NAMED)
    assert found.joined.how == "name" and found.understood[1]["role"] == "joints"
    assert q1(found) == [20, 10, 20, 10]


def test_points_without_a_pose_are_named_and_refused(tmp_path):
    files = named("1_M1 2_M1 9_M1", [(1, 10), (2, 20), (3, 30)])
    with pytest.raises(InputError, match=r"1 of 3 points.*9_M1 \(line 4\).*leave_out"):
        imported(tmp_path, files, NAMED)
    found = imported(tmp_path, files, NAMED + '[join]\nunmatched = "leave_out"\n')
    assert q1(found) == [10, 20]
    assert found.joined.left_out == ("9_M1 (line 4)",)
    assert found.joined.unused == ("3 (line 4)",)


def test_by_order_a_marker_seen_again_begins_a_pose(tmp_path):
    found = imported(tmp_path, named("M1 M2 M1 M1 M2", [("", 10), ("", 20)]), ORDER)
    assert q1(found) == [10, 10, 20, 20, 20]
    assert found.table.repeat.tolist() == [0, 0, 0, 1, 0]


@pytest.mark.parametrize(
    ("points", "joints", "mapping", "match"),
    [
        ("M1 M2 M2 M1 M2 M1 M2", [("", 10), ("", 20)], ORDER,
         r"7 points in 3 visits.*2 poses.*begins at M1 \(line 2\)"),
        ("1_M1", [(1, 10), (1, 20)], NAMED,
         r"joints.csv, line 3: pose 1 has other joint values.*2"),
    ],
)  # fmt: skip
def test_what_cannot_be_joined_is_told(tmp_path, points, joints, mapping, match):
    with pytest.raises(InputError, match=match):
        imported(tmp_path, named(points, joints), mapping)


def test_every_load_state_runs_through_the_poses(tmp_path):
    mapping = ORDER.replace("(?P<marker>M.)", r"^(?P<load>\w+):(?P<marker>M.)$")
    mapping += "[loads]\nfull = { mass_kg = 100 }\n"
    files = named("none:M1 none:M1 full:M1 full:M1", [("", 10), ("", 20)])
    found = imported(tmp_path, files, mapping)
    assert q1(found) == [10, 20, 10, 20]
    assert found.table.configuration.tolist() == [0, 1, 0, 1]
    np.testing.assert_allclose(found.table.force[:, 2], [0, 0, -980.665, -980.665])


def test_what_else_the_log_says_goes_with_its_poses(tmp_path):
    """Their names and temperatures; the tracker states two standard deviations."""
    sigmas = "".join(f', sigma_{axis}_um = "s"' for axis in "xyz")
    mapping = ORDER.replace('z_mm = "z" }', f'z_mm = "z"{sigmas} }}\ncoverage_factor = 2.0')
    mapping = mapping.replace('q2_deg = "b"', 'q2_deg = "b", temperature_C = "T"')
    files = {
        "points.csv": table("name,x,y,z,s", [(n, 1000, 0, 2, 30) for n in ("M1", "M2", "M1")]),
        "joints.csv": table("name,a,b,T", [("A", 10, 0, 20.5), ("B", 20, 0, 21.5)]),
    }
    read = imported(tmp_path, files, mapping).table
    assert [read.configuration_labels[c] for c in read.configuration] == ["A", "A", "B"]
    assert read.temperature.tolist() == [20.5, 20.5, 21.5]
    np.testing.assert_allclose(read.sigma, 15e-6)


def test_by_time_takes_the_nearest_with_the_offset(tmp_path):
    files = timed((100.2, 109.9), [(k, k) for k in range(0, 20, 2)])
    found = imported(tmp_path, files, TIMED + "offset_s = 100.0\nstill_deg = 5.0\n")
    assert found.joined.how == "time"
    assert q1(found) == [0, 10]
    np.testing.assert_allclose(found.table.time, [0, 9.7])
    with pytest.raises(InputError, match=r"1 of 2.*line 2, 0\.2 s from the nearest.*offset_s"):
        imported(tmp_path, files, TIMED + "offset_s = 100.0\ntolerance_s = 0.15\n")


def test_seconds_and_nanoseconds_of_one_clock_add_up(tmp_path):
    log = [(k, 500_000_000, k, 0) for k in range(4)]
    files = timed((2.5,), []) | {"joints.csv": table("s,n,a,b", log)}
    mapping = TIMED.replace('time_s = "t", q1', 'time_s = "s", time_ns = "n", q1')
    assert q1(imported(tmp_path, files, mapping)) == [2]


def test_times_are_read_as_their_format_says_or_iso(tmp_path):
    files = timed(("24.12.2026 10:00:02",), [(f"2026-12-24T10:00:0{k}Z", k) for k in range(4)])
    mapping = TIMED.replace("time_s", "time_text").replace(
        'files = ["points*"]', 'files = ["points*"]\ntime_format = "%d.%m.%Y %H:%M:%S"'
    )
    assert q1(imported(tmp_path, files, mapping)) == [2]
    with pytest.raises(InputError, match=r"line 2: '24.12.2026 .*no time of the form ISO 8601"):
        imported(tmp_path, files, TIMED.replace("time_s", "time_text"))


def test_by_standstill_takes_the_median_and_numbers_poses_by_joints(tmp_path):
    log = [
        (start + k, angle + (0.001 * (k % 2) if k < 6 else 2.0 * (k - 5)))
        for start, angle in ((0, 10.0), (10, 20.0), (20, 10.004))
        for k in range(10)
    ]
    mapping = TIMED + 'by = "standstill"\nstill_s = 4\n'
    found = imported(tmp_path, timed((2, 12.5, 25), log), mapping)
    np.testing.assert_allclose(np.degrees(found.table.q[:, 0]), [10.0005, 20.0005, 10.0045])
    assert found.table.configuration.tolist() == [0, 1, 0]
    with pytest.raises(InputError, match="never stood still for 60 s"):
        imported(tmp_path, timed((2,), log), mapping.replace("still_s = 4", "still_s = 60"))


@pytest.mark.parametrize("by", ["time", "standstill"])
def test_the_offset_at_which_most_points_meet_a_standing_arm_is_told(by, tmp_path):
    """Eight visits of 6 s at unequal distances; the tracker's clock is 3600 s ahead."""
    start = np.cumsum([0, 20, 31, 17, 44, 23, 38, 29.0])
    log = [(t + s, 10 * k) for k, t in enumerate(start) for s in range(7)]
    files = timed(start + 3603, log)
    with pytest.raises(InputError) as caught:
        imported(tmp_path, files, f'{TIMED}by = "{by}"\n')
    told = re.search(r"with offset_s = (\S+) in \[join\] 8 of 8 points", str(caught.value))
    assert told and abs(float(told[1]) - 3600) <= 3.1
    found = imported(tmp_path, files, f'{TIMED}by = "{by}"\noffset_s = {told[1]}\n')
    assert q1(found) == [10.0 * k for k in range(8)]


def test_by_time_says_where_the_arm_moved(tmp_path):
    files = timed((1, 5), [(0, 0), (1, 0), (2, 0), (4, 8), (5, 9), (6, 10)])
    found = imported(tmp_path, files, TIMED)
    assert any("moved while 1 points were measured: line 3" in w for w in found.warnings)


ALONE = '[[source]]\ncolumns = { name = "n", x_mm = "x", y_mm = "y", z_mm = "z", JOINTS }\n'


def test_configurations_whose_joints_differ_are_named(tmp_path):
    mapping = ALONE.replace("JOINTS", 'q1_deg = "a"')
    mapping += r"names = { pattern = '^(?P<configuration>\d)_(?P<marker>M\d)$' }"
    files = {"data.csv": table("n,x,y,z,a", [("1_M1", 1, 2, 3, 10), ("1_M2", 1, 2, 4, 12)])}
    (warning,) = imported(tmp_path, files, mapping).warnings
    assert "differ by up to 2" in warning and ": 1;" in warning


def test_signs_offsets_order_and_coupling(tmp_path):
    mapping = ALONE.replace("JOINTS", 'q1_deg = "a", q2_deg = "b", q3_deg = "c"')
    mapping += """[joints]
order = [2, 1, 3]
sign = [1, -1, 1]
offset_deg = [0, 90, 0]
coupling = [{ joint = 3, of = 2, factor = 0.5 }, { joint = 2, of = 3, factor = 1.0 }]
"""
    files = {"data.csv": table("n,x,y,z,a,b,c", [("P", 1, 2, 3, 10, 20, 30)])}
    # q2 = -10 + 90 + 30 and q3 = 30 + 0.5 * (-10 + 90): couplings see the values before them.
    np.testing.assert_allclose(
        np.degrees(imported(tmp_path, files, mapping).table.q), [[20, 110, 70]]
    )
