"""DH tables: both conventions against plain matrix products, UR5's numbers, every complaint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.robot_files import told_by_init

import elastocal as ec
from elastocal.messages import InputError
from elastocal.model.chain import Chain
from elastocal.model.dh import read_dh
from elastocal.model.rigid import nominal_flanges

HEADER = "theta0_rad,d_m,a_m,alpha_rad"
# UR5, https://www.universal-robots.com: d, a in m and α in rad, standard convention.
UR5 = [
    (0.0, 0.089159, 0.0, np.pi / 2),
    (0.0, 0.0, -0.425, 0.0),
    (0.0, 0.0, -0.39225, 0.0),
    (0.0, 0.10915, 0.0, np.pi / 2),
    (0.0, 0.09465, 0.0, -np.pi / 2),
    (0.0, 0.0823, 0.0, 0.0),
]


def write(path: Path, header: str, rows: list) -> Path:
    lines = [",".join(str(cell) for cell in row) for row in rows]
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


def evaluate(chain: Chain, q: np.ndarray) -> np.ndarray:
    return nominal_flanges(chain, q[None])[0]


def turn_x(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def turn_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def shift(x: float, z: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3], T[2, 3] = x, z
    return T


def dh_frames(rows: list, prismatic: list, q: np.ndarray, convention: str) -> list[np.ndarray]:
    """T_base_i of every DH frame, written out by hand."""
    T, frames = np.eye(4), []
    for (theta0, d, a, alpha), slides, value in zip(rows, prismatic, q, strict=True):
        theta, d = (theta0, d + value) if slides else (theta0 + value, d)
        if convention == "standard":
            T = T @ turn_z(theta) @ shift(0, d) @ shift(a, 0) @ turn_x(alpha)
        else:
            T = T @ turn_x(alpha) @ shift(a, 0) @ turn_z(theta) @ shift(0, d)
        frames.append(T)
    return frames


def random_table(seed: int) -> tuple[list, list, np.ndarray]:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 10))
    rows = [tuple(rng.uniform(-1, 1, 4) * (np.pi, 1, 1, np.pi)) for _ in range(n)]
    return rows, list(rng.random(n) < 0.3), rng.uniform(-2, 2, n)


@pytest.mark.parametrize("convention", ["standard", "modified"])
@pytest.mark.parametrize("seed", range(3))
def test_flange_equals_plain_product(tmp_path: Path, convention, seed: int) -> None:
    rows, prismatic, q = random_table(seed)
    kinds = ["prismatic" if p else "revolute" for p in prismatic]
    cells = [(*row, kind) for row, kind in zip(rows, kinds, strict=True)]
    chain = read_dh(write(tmp_path / "dh.csv", HEADER + ",type", cells), convention)
    assert chain.kinds == tuple(kinds)
    expected = dh_frames(rows, prismatic, q, convention)[-1]
    np.testing.assert_allclose(evaluate(chain, q), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_fixed_rows_beta_and_comments(tmp_path: Path, convention) -> None:
    """A fixed row is a joint that never moves; β turns about y after α, before the next θ."""
    rows, _, q = random_table(3)
    beta = 0.3
    cells = [(*row, "", "revolute") for row in rows]
    cells[0], cells[-1] = (*rows[0], "", "fixed"), (*rows[-1], beta, "fixed")
    path = write(tmp_path / "dh.csv", f"# a, comment\n{HEADER},beta_rad,type", cells)
    chain = read_dh(path, convention)
    assert chain.n_joints == len(rows) - 2
    held = np.concatenate([[0.0], q[1:-1], [0.0]])
    frames = dh_frames(rows, [False] * len(rows), held, convention)
    c, s = np.cos(beta), np.sin(beta)
    turn_y = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])
    theta, d, a, alpha = rows[-1]
    expected = frames[-1] @ turn_y
    if convention == "modified":
        along = turn_z(theta) @ shift(0, d)
        expected = frames[-2] @ turn_x(alpha) @ shift(a, 0) @ turn_y @ along
    np.testing.assert_allclose(evaluate(chain, q[1:-1]), expected, rtol=0, atol=1e-13)


def test_a_tab_separated_table_has_empty_lines_and_comments_too(tmp_path: Path) -> None:
    rows, _, _ = random_table(3)
    plain = write(tmp_path / "dh.csv", HEADER, rows)
    lines = plain.read_text().replace(",", "\t").splitlines()
    lines[2:2] = ["\t" * (len(rows[0]) - 1), "\t# of the upper arm"]
    tabs = tmp_path / "tabs.csv"
    tabs.write_text("\n".join(lines) + "\n")
    q = np.zeros(len(rows))
    np.testing.assert_array_equal(evaluate(read_dh(tabs), q), evaluate(read_dh(plain), q))


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_centres_of_mass_are_given_in_dh_frames(tmp_path: Path, convention) -> None:
    rows, _, _ = random_table(3)
    n = len(rows)
    rng = np.random.default_rng(0)
    coms, q = rng.uniform(-1, 1, (n, 3)), rng.uniform(-2, 2, n)
    masses = [(f"link{i + 1}", i + 1.0, *coms[i]) for i in range(n)]
    header = "link,mass_kg,com_x_m,com_y_m,com_z_m"
    chain = read_dh(
        write(tmp_path / "dh.csv", HEADER, rows),
        convention,
        masses_path=write(tmp_path / "masses.csv", header, masses[::-1]),
    )
    frames = dh_frames(rows, [False] * n, q, convention)
    for i in range(n):
        part = Chain("part", chain.joints[: i + 1], np.eye(4))
        found = evaluate(part, q[: i + 1]) @ [*chain.masses[i].com, 1]
        np.testing.assert_allclose(found, frames[i] @ [*coms[i], 1], rtol=0, atol=1e-13)
        assert chain.masses[i].mass == i + 1.0


def test_limits_and_names(tmp_path: Path) -> None:
    header = HEADER + ",joint,type,lower_deg,upper_deg,lower_m,upper_m"
    rows: list = [(0, 0.1, 0.2, 0, f"A{i}", "", -90, 180, "", "") for i in range(4)]
    rows.append((0, 0.1, 0.2, 0, "rail", "prismatic", "", "", -0.5, ""))
    chain = read_dh(write(tmp_path / "dh.csv", header, rows))
    first, rail = chain.joints[0], chain.joints[4]
    assert (chain.name, first.name, rail.name) == ("dh", "A0", "rail")
    assert (first.lower, first.upper) == pytest.approx((-np.pi / 2, np.pi))
    assert (rail.lower, rail.upper) == (-0.5, np.inf)


ROW = "0,0.1,0.2,0"
WRONG_DH = {
    "no unit on limit": (HEADER + ",lower\n", "write lower_rad or lower_deg or lower_m"),
    "mixed angles": ("theta0_rad,d_m,a_m,alpha_deg\n", "theta0_rad and alpha_deg mix units"),
    "too few": (f"{HEADER}\n" + f"{ROW}\n" * 3, "3 rows below the header.*4 to 9"),
    "degrees": (f"{HEADER}\n" + "0,0,0,90\n" * 4, "90 rad is more than two turns.*alpha_deg"),
    "beyond any unit": (
        "theta0_rad,d_mm,a_mm,alpha_rad\n" + "0,1e300,0,0\n" * 4,
        "column d_mm: 1e.297 m is too long for a link; correct it",
    ),
    "joint type": (
        f"{HEADER},type\n" + f"{ROW},revolut\n" * 4,
        r"line 2, column type: unknown joint type 'revolut' \(did you mean 'revolute'",
    ),
    "limit in metres": (
        f"{HEADER},lower_m\n" + f"{ROW},1\n" * 4,
        "line 2, column lower_m: the joint is revolute; leave this blank and give.*rad or deg",
    ),
}
MASSES = "link,mass_kg,com_x_m,com_y_m,com_z_m\n"
ALL = "".join(f"{i},1,0,0,0\n" for i in range(1, 7))
WRONG = WRONG_DH | {
    "unknown link": (MASSES + "link7,1,0,0,0\n", r"line 2, column link: unknown link 'link7'"),
    "twice": (MASSES + ALL + "link2,1,0,0,0\n", "line 8, column link: 'link2' appears twice"),
    "missing": (MASSES + ALL[: -2 * len("6,1,0,0,0\n")], "no row for link5, link6"),
    "no link column": (
        "mass_kg,com_x_m,com_y_m,com_z_m\n1,0,0,0\n",
        "the columns link are missing, which a table of link masses",
    ),
}


@pytest.mark.parametrize("text, message", WRONG.values(), ids=WRONG.keys())
def test_wrong_tables_are_explained(tmp_path: Path, text: str, message: str) -> None:
    path, dh = tmp_path / "wrong.csv", write(tmp_path / "dh.csv", HEADER, UR5)
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_dh(dh, masses_path=path) if "mass_kg" in text else read_dh(path)
    assert str(path) in str(caught.value)


# --- tables as people write them

KR6 = """\
0,410,20,-90
-90,0,450,0
0,0,30,-90
0,415,0,90
0,0,0,-90
0,75,0,0
"""
COLUMNS = "theta0_deg,d_mm,a_mm,alpha_deg"


def written(folder, header, rows, name="dh.csv"):
    (folder / name).write_text(f"{header}\n{rows}", encoding="utf-8")
    return folder / name


def with_cells(*cells):
    return "".join(f"{row},{cell}\n" for row, cell in zip(KR6.splitlines(), cells, strict=True))


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("qmin_deg", "'lower_deg'"), ("min", "'lower_rad' or"), ("q_max (deg)", "'upper_deg'"),
        ("DIRECTION", "'sign'"), ("range_deg", ""), ("alpha_im1_deg", "--convention modified"),
    ],
)  # fmt: skip
def test_an_unknown_column_is_never_taken_for_a_twist(name, meant, tmp_path):
    path = written(tmp_path, f"{COLUMNS},{name}", with_cells(*[1] * 6))
    code, _, err = told_by_init(path)
    assert code == 2 and meant in err and "mean 'beta" not in err


def test_a_sign_turns_a_joint_against_its_axis(tmp_path):
    q = np.random.default_rng(0).uniform(-2, 2, (20, 6))
    signs = np.array([-1, 1, 1, -1, 1, -1])
    signed = read_dh(written(tmp_path, f"{COLUMNS},sign", with_cells(*signs)))
    plain = read_dh(written(tmp_path, COLUMNS, KR6, "plain.csv"))
    np.testing.assert_allclose(
        nominal_flanges(signed, q), nominal_flanges(plain, q * signs), rtol=0, atol=1e-12
    )
    code, _, err = told_by_init(written(tmp_path, f"{COLUMNS},sign", with_cells(*[2] * 6)))
    assert code == 2 and "write 1, or -1" in err


CALIBRATION = """\
[mounting]
delta_theta = [ -8.2e-05, -0.10361, 0.67363, -0.57017, -4.6e-05, 9.7e-07]
delta_a = [ -0.00016, 0.00304, 0.09165, -9.63e-05, -2.98e-05, 0]
delta_d = [ 0.000505, 11.19845, -92.52703, 81.32827, -0.000213, -0.000126]
delta_alpha = [ -0.000321, -0.00565, -0.003789, -0.001065, 0.001, 0]
joint_checksum = [ 0x6e0f7bf, 0xa32a713f, 0xf636a50, 0x9ec2338a, 0xa1afded8, 0xb29b2979]
calibration_status = 2 # 2 == Linearised
"""


def test_the_factory_calibration_of_a_ur_is_a_robot(tmp_path):
    path = tmp_path / "calibration.conf"
    path.write_text(CALIBRATION)
    code, _, err = told_by_init(path)
    assert code == 2 and "this one fits UR10" in err and "--ur-model" in err
    code, _, err = told_by_init(path, "--ur-model", "UR5")
    assert code == 2 and "mm away from the nominal one" in err
    code, out, err = told_by_init(path, "--ur-model", "ur10")
    assert code == 0 and "shoulder_lift_joint" in out, err
    chain = ec.Model(str(tmp_path / "cell.toml")).chain
    nominal = written(
        tmp_path, "theta0_rad,d_m,a_m,alpha_rad",
        "0,0.1273,0,1.570796327\n0,0,-0.612,0\n0,0,-0.5723,0\n0,0.163941,0,1.570796327\n"
        "0,0.1157,0,-1.570796327\n0,0.0922,0,0\n",
    )  # fmt: skip
    q = np.random.default_rng(0).uniform(-3, 3, (50, 6))
    apart = (nominal_flanges(chain, q) - nominal_flanges(read_dh(nominal), q))[:, :3, 3]
    assert 1e-4 < np.linalg.norm(apart, axis=1).max() < 0.01
    (tmp_path / "urcontrol.conf").write_text(
        "[DH]\na = [0, -0.612, -0.5723, 0, 0, 0]\nd = [0.1273, 0, 0, 0.163941, 0.1157, 0.0922]\n"
        "alpha = [1.570796327, 0, 0, 1.570796327, -1.570796327, 0]\n"
    )
    code, _, err = told_by_init(path)
    assert code == 0, err


def test_a_yaml_of_ur_calibration_is_a_robot(tmp_path):
    origins = {
        "shoulder": (0, 0, 0.1625, 0, 0, 0), "upper_arm": (0, 0, 0, 1.570796327, 0, 0),
        "forearm": (-0.425, 0, 0, 0, 0, 0), "wrist_1": (-0.3922, 0, 0.1333, 0, 0, 0),
        "wrist_2": (0, -0.0997, 0, 1.570796327, 0, 0),
        "wrist_3": (0, 0.0996, 0, 1.570796327, 3.141592654, 3.141592654),
    }  # fmt: skip
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    text = "kinematics:\n" + "".join(
        f"  {link}:\n" + "".join(f"    {n}: {v}\n" for n, v in zip(names, at, strict=True))
        for link, at in origins.items()
    )
    path = tmp_path / "my_robot_calibration.yaml"
    path.write_text(text + "  hash: calib_1\n")
    code, _, err = told_by_init(path)
    assert code == 0, err
    chain = ec.Model(str(tmp_path / "cell.toml")).chain
    # The UR5e at zero: stretched along -x.
    T = nominal_flanges(chain, np.zeros((1, 6)))[0]
    np.testing.assert_allclose(T[:3, 3], [-0.8172, -0.2329, 0.0628], atol=1e-6)
    path.write_text(text.replace("    yaw: 0\n", "", 1))
    assert "kinematics.shoulder needs" in told_by_init(path)[2]


RADIANS = KR6.replace("-90", "-1.5708").replace(",90", ",1.5708")
LIMITS = "lower_rad,upper_rad"


@pytest.mark.parametrize(
    ("header", "rows", "code", "told"),
    [
        (COLUMNS, RADIANS, 0, "neighbouring axes are at most 1.5708 degrees apart"),
        (COLUMNS.replace("deg", "rad"), KR6, 2, "more than two turns; if these are degrees"),
        (COLUMNS, KR6.replace("410", "0.41").replace("450", "0.45").replace("415", "0.415")
         .replace(",20,", ",0.02,").replace(",30,", ",0.03,").replace("75", "0.075"), 2,
         "if its lengths are metres"),
        (f"{COLUMNS.replace('deg', 'rad')},{LIMITS}",
         "".join(f"{row},-170,170\n" for row in RADIANS.split()), 2, "more than 27 turns"),
        (f"{COLUMNS},lower_deg,upper_deg", with_cells(*["-2.9,2.9"] * 6), 0,
         "as where limits in rad are read as degrees"),
        ("version https://git-lfs.github.com/spec/v1", "oid sha256:1\n", 2, "pointer of Git LFS"),
        ("<!DOCTYPE html>", "<html>\n", 2, "is a web page"),
    ],
)  # fmt: skip
def test_units_that_cannot_be_meant_are_told(header, rows, code, told, tmp_path):
    found, out, err = told_by_init(written(tmp_path, header, rows))
    assert found == code and told in out + err, out + err


def test_what_is_doubtful_is_a_warning_of_identify_too(tmp_path):
    assert told_by_init(written(tmp_path, COLUMNS, RADIANS))[0] == 0
    model = ec.Model(str(tmp_path / "cell.toml"))
    data = ec.simulate(model, np.random.default_rng(0).uniform(-1, 1, (20, 6)))
    assert any("degrees apart" in warning for warning in ec.identify(model, data).warnings)
