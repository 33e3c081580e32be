"""DH tables as people write them: columns of their own, directions, factory tables, units."""

import numpy as np
import pytest
from support.robot_files import told_by_init

import elastocal as ec
from elastocal.model.dh import read_dh
from elastocal.model.rigid import nominal_flanges

KR6 = """\
0,410,20,-90
-90,0,450,0
0,0,30,-90
0,415,0,90
0,0,0,-90
0,75,0,0
"""
HEADER = "theta0_deg,d_mm,a_mm,alpha_deg"


def write(folder, header, rows, name="dh.csv"):
    (folder / name).write_text(f"{header}\n{rows}", encoding="utf-8")
    return folder / name


def with_cells(*cells):
    return "".join(f"{row},{cell}\n" for row, cell in zip(KR6.splitlines(), cells, strict=True))


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("qmin_deg", "lower_deg"), ("min_deg", "lower_deg"), ("q_max_deg", "upper_deg"),
        ("upper_limit_rad", "upper_rad"), ("θ_deg", "theta0_deg"), ("direction", "sign"),
    ],
)  # fmt: skip
def test_an_unknown_column_is_never_taken_for_a_twist(name, meant, tmp_path):
    path = write(tmp_path, f"{HEADER},{name}", with_cells(*[1] * 6))
    code, _, err = told_by_init(path)
    assert code == 2 and f"did you mean '{meant}'" in err and "beta" not in err


def test_a_sign_turns_a_joint_against_its_axis(tmp_path):
    q = np.random.default_rng(0).uniform(-2, 2, (20, 6))
    signs = np.array([-1, 1, 1, -1, 1, -1])
    signed = read_dh(write(tmp_path, f"{HEADER},sign", with_cells(*signs)))
    plain = read_dh(write(tmp_path, HEADER, KR6, "plain.csv"))
    np.testing.assert_allclose(
        nominal_flanges(signed, q), nominal_flanges(plain, q * signs), rtol=0, atol=1e-12
    )
    code, _, err = told_by_init(write(tmp_path, f"{HEADER},sign", with_cells(*[2] * 6)))
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
    nominal = write(
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
        (HEADER, RADIANS, 0, "neighbouring axes are at most 1.5708 degrees apart"),
        (HEADER.replace("deg", "rad"), KR6, 2, "more than two turns; if these are degrees"),
        (HEADER, KR6.replace("410", "0.41").replace("450", "0.45").replace("415", "0.415")
         .replace(",20,", ",0.02,").replace(",30,", ",0.03,").replace("75", "0.075"), 2,
         "if its lengths are metres"),
        (f"{HEADER.replace('deg', 'rad')},{LIMITS}",
         "".join(f"{row},-170,170\n" for row in RADIANS.split()), 2, "more than 27 turns"),
        (f"{HEADER},lower_deg,upper_deg", with_cells(*["-2.9,2.9"] * 6), 0,
         "as where limits in rad are read as degrees"),
        ("version https://git-lfs.github.com/spec/v1", "oid sha256:1\n", 2, "pointer of Git LFS"),
        ("<!DOCTYPE html>", "<html>\n", 2, "is a web page"),
    ],
)  # fmt: skip
def test_units_that_cannot_be_meant_are_told(header, rows, code, told, tmp_path):
    found, out, err = told_by_init(write(tmp_path, header, rows))
    assert found == code and told in out + err, out + err


def test_what_is_doubtful_is_a_warning_of_identify_too(tmp_path):
    assert told_by_init(write(tmp_path, HEADER, RADIANS))[0] == 0
    model = ec.Model(str(tmp_path / "cell.toml"))
    data = ec.simulate(model, np.random.default_rng(0).uniform(-1, 1, (20, 6)))
    assert any("degrees apart" in warning for warning in ec.identify(model, data).warnings)
