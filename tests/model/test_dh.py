"""DH tables: both conventions against plain matrix products, UR5's numbers, every complaint."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from elastocal.errors import InputError
from elastocal.model.chain import Chain
from elastocal.model.dh import read_dh
from elastocal.model.rigid import nominal_flange

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
    symbol = ca.SX.sym("q", chain.n_joints)
    return ca.Function("T", [symbol], [nominal_flange(chain, symbol)])(q).full()


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
@pytest.mark.parametrize("seed", range(15))
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


def test_degrees_and_millimetres_say_the_same(tmp_path: Path) -> None:
    rows, _, q = random_table(5)
    scaled = [(np.degrees(t), d * 1e3, a * 1e3, np.degrees(alpha)) for t, d, a, alpha in rows]
    si = read_dh(write(tmp_path / "a.csv", HEADER, rows))
    other = read_dh(write(tmp_path / "b.csv", "theta0_deg,d_mm,a_mm,alpha_deg", scaled))
    np.testing.assert_allclose(evaluate(si, q), evaluate(other, q), rtol=0, atol=1e-12)


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
    "empty": ("", "empty file; the first line names the columns"),
    "no unit on limit": (HEADER + ",lower\n", "write lower_rad or lower_deg or lower_m"),
    "mixed angles": ("theta0_rad,d_m,a_m,alpha_deg\n", "theta0_rad and alpha_deg mix units"),
    "mixed lengths": ("theta0_rad,d_m,a_mm,alpha_rad\n", "d_m and a_mm mix units"),
    "missing": (
        "theta0_rad,d_m,alpha_rad\n",
        "d_m without a_m; the table needs all columns of the lengths$",
    ),
    "no angles": ("d_m,a_m\n", "theta0_rad,alpha_rad are missing, which a DH table needs"),
    "nan": (f"{HEADER}\nnan,0,0,0\n", "line 2, column theta0_rad: 'nan' is not a finite"),
    "too few": (f"{HEADER}\n" + f"{ROW}\n" * 3, "3 rows below the header.*4 to 9"),
    "too many": (f"{HEADER}\n" + f"{ROW}\n" * 10, "10 rows below the header.*4 to 9"),
    "degrees": (f"{HEADER}\n" + "0,0,0,90\n" * 4, "90 rad is more than two turns.*alpha_deg"),
    "millimetres": (f"{HEADER}\n" + "0,750,0,0\n" * 4, "750 m is too long for a link.*d_mm"),
    "beyond any unit": (
        "theta0_rad,d_mm,a_mm,alpha_rad\n" + "0,1e300,0,0\n" * 4,
        "column d_mm: 1e.297 m is too long for a link; correct it",
    ),
    "joint type": (
        f"{HEADER},type\n" + f"{ROW},revolut\n" * 4,
        r"line 2, column type: unknown joint type 'revolut' \(did you mean 'revolute'",
    ),
    "limits crossed": (
        f"{HEADER},lower_deg,upper_deg\n" + f"{ROW},10,-10\n" * 4,
        "line 2, columns lower_deg and upper_deg: lower is not below upper",
    ),
    "limit in metres": (
        f"{HEADER},lower_m\n" + f"{ROW},1\n" * 4,
        "line 2, column lower_m: the joint is revolute; leave this blank and give.*rad or deg",
    ),
    "same name": (f"{HEADER},joint\n" + f"{ROW},A\n" * 4, "column joint: 'A' appears twice"),
}


@pytest.mark.parametrize("text, message", WRONG_DH.values(), ids=WRONG_DH.keys())
def test_wrong_tables_are_explained(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "dh.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_dh(path)
    assert str(path) in str(caught.value)


MASSES = "link,mass_kg,com_x_m,com_y_m,com_z_m\n"
ALL = "".join(f"{i},1,0,0,0\n" for i in range(1, 7))
WRONG_MASSES = {
    "unknown link": (MASSES + "link7,1,0,0,0\n", r"line 2, column link: unknown link 'link7'"),
    "twice": (MASSES + ALL + "link2,1,0,0,0\n", "line 8, column link: 'link2' appears twice"),
    "missing": (MASSES + ALL[: -2 * len("6,1,0,0,0\n")], "no row for link5, link6"),
    "negative": (MASSES + "1,-2,0,0,0\n", "line 2, column mass_kg: -2 is negative"),
    "no link column": (
        "mass_kg,com_x_m,com_y_m,com_z_m\n1,0,0,0\n",
        "the columns link are missing, which a table of link masses",
    ),
}


@pytest.mark.parametrize("text, message", WRONG_MASSES.values(), ids=WRONG_MASSES.keys())
def test_wrong_masses_are_explained(tmp_path: Path, text: str, message: str) -> None:
    masses = tmp_path / "masses.csv"
    masses.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_dh(write(tmp_path / "dh.csv", HEADER, UR5), masses_path=masses)
    assert str(masses) in str(caught.value)


def test_unreadable_files_and_convention(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_dh(tmp_path / "nothing.csv")
    with pytest.raises(InputError, match="is a directory"):
        read_dh(tmp_path)
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(InputError, match="is UTF-16; save the table as CSV"):
        read_dh(binary)
