"""Effects and noise models of one's own, from the command line: the pages' files, and bad ones."""

from __future__ import annotations

import json
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.cells import kr270_chain, random_poses, table_of
from support.design_commands import elastocal
from support.registered import forgotten, write_example
from support.robots import KR270
from typer.testing import Result

import elastocal as ec
from elastocal import files
from elastocal.cell import read_cell
from elastocal.messages import InputError
from elastocal.model.effects.catalogue import CATALOGUE
from elastocal.model.manipulator import Model
from elastocal.plugins import load_plugins

CELL = f"""\
[robot]
urdf = "{KR270}"
[tool.markers_m]
M1 = [0.25, 0.0, 0.0]
M2 = [-0.10, 0.20, 0.1118]
M3 = [-0.10, -0.20, 0.1118]
[tracker]
position_m = [3.5, -2.0, 0.6]
sigma_um = 10
[model]
effects = ["base_frame", "joint_offset", "marker_position"]
[design]
poses = 8
candidates = 40
criterion = "D"
interest = ["joint_offset"]
[plugins]
modules = ["three_lobes.py"]
"""
LOBES = {"joint3.lobes_sin": 1.2e-4, "joint3.lobes_cos": -1e-4}
DAY = 86400.0


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    with forgotten():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Cells with the plug-in, and readings of an arm whose third gear has three lobes."""
    tmp_path = tmp_path_factory.mktemp("lobes")
    write_example(tmp_path, "three_lobes.py")
    (tmp_path / "cell.toml").write_text(CELL, encoding="utf-8")
    with_it = tmp_path / "with.toml"
    with_it.write_text(CELL.replace('on"]', 'on", "three_lobes:joint3"]'), encoding="utf-8")
    with forgotten():
        model = Model(with_it, plugins=True)
        q = random_poses(kr270_chain(), 25, 1)
        drawn = np.random.default_rng(1).normal(size=6)
        values = {f"joint{i + 1}.offset": 1e-3 * v for i, v in enumerate(drawn)} | LOBES
        ec.simulate(model, q, values=values, seed=1).save(tmp_path / "data.csv")
    return tmp_path


def run(*arguments: object, plugins: bool = True) -> Result:
    return elastocal(*arguments, *["--plugins"] * plugins)


def test_identify_fits_it_and_export_leaves_it_out(folder: Path) -> None:
    out, cell = folder / "result.json", folder / "with.toml"
    assert run("identify", cell, folder / "data.csv", "-o", out, "-q").exit_code == 0
    found = {p["name"]: p for p in json.loads(out.read_text())["parameters"]}
    for name, value in LOBES.items():
        assert abs(found[name]["value"] - value) < 4 * found[name]["std"] < 4e-5
    # A file of the arm cannot hold it, and says what that costs.
    result = run("export", cell, out, "-o", folder / "arm.urdf", "--json")
    assert result.exit_code == 0, result.stderr
    (left_out,) = json.loads(result.stdout)["cannot_hold"]["effects"]
    assert left_out["effect"] == "three_lobes" and left_out["difference"]["marker_rms_um"] > 10


def test_diagnose_suspects_it_at_all_its_places_and_finds_it(folder: Path) -> None:
    out, extended = folder / "diagnosis.json", folder / "out" / "cell.toml"
    extended.parent.mkdir()
    words = (folder / "data.csv", "-o", out, "-q", "--cell-out")
    result = run("diagnose", folder / "cell.toml", *words, extended)
    assert f"to go on: elastocal identify {extended}" in result.stdout
    why = json.loads(out.read_text())
    tried = {c["where"] for c in why["candidates"] if c["effect"] == "three_lobes"}
    assert tried == {f"joint{i + 1}" for i in range(6)}
    assert why["verdict"] == "explained"
    assert [(e["effect"], e["where"]) for e in why["effects"]] == [("three_lobes", "joint3")]
    # The extended cell, in another folder, finds the plug-in where it was; nothing is left over.
    result = run("diagnose", extended, *words, folder / "again.toml")
    assert "with no further effect" in result.stdout and "to go on" not in result.stdout
    assert read_cell(folder / "again.toml").model == read_cell(extended).model


def test_a_model_with_it_travels_to_another_process(folder: Path) -> None:
    """The plug-ins that ran go with a pickle; an effect that no file states cannot, and says so."""
    model = Model(folder / "with.toml", plugins=True)
    opened = (
        "import pickle, sys\ntry: print(pickle.loads(bytes.fromhex(sys.argv[1])).names[-1])\n"
        "except Exception as error: print(error)"
    )
    unstated = "three_lobes was registered where .* put it in a file that \\[plugins\\]"
    for sent, told in ((model, model.names[-1]),
                       (Model(replace(model.cell, plugins=())), unstated)):  # fmt: skip
        words = [sys.executable, "-c", opened, pickle.dumps(sent).hex()]
        done = subprocess.run(words, check=True, capture_output=True, text=True, cwd="/")
        assert re.search(told, done.stdout), done.stdout


def test_the_noise_model_is_chosen_and_named(tmp_path: Path) -> None:
    """Of readings of three days, on the second of which the air was restless."""
    cell, data, out = (tmp_path / name for name in ("cell.toml", "data.csv", "result.json"))
    text = CELL.replace("three_lobes.py", "noise_by_day.py").replace("sigma_um = 10\n", "")
    cell.write_text(text, encoding="utf-8")
    write_example(tmp_path, "noise_by_day.py")
    model = Model(cell, plugins=True)
    table = table_of(random_poses(model.chain, 30, 1), np.zeros(3))
    day, exact = table.configuration % 3, model.predict(table).reshape(-1, 3)
    scatter = np.array([1e-5, 8e-5, 1e-5])[day][:, None]
    read = exact + scatter * np.random.default_rng(5).normal(size=exact.shape)
    table = replace(table, position=read, time=DAY * day + table.configuration.astype(float))
    table.save(data)
    page = tmp_path / "report.html"
    result = run("identify", cell, data, "-o", out, "--report", page, "-q")
    assert result.exit_code == 0, result.stderr
    noise = json.loads(out.read_text())["noise"]
    assert noise["kind"].partition("+")[0] == "day"
    sizes = {v["name"]: v["sigma_um"] for v in noise["variances"] if v["name"].startswith("day")}
    assert list(sizes) == ["day 1", "day 2", "day 3"]
    assert [sizes["day 1"], sizes["day 2"]] == pytest.approx([10, 80], rel=0.2)
    assert "one variance per day" in page.read_text(encoding="utf-8")
    replace(table, time=None).save(data)
    refused = run("identify", cell, data, "--noise", "day+configuration", "-q")
    assert refused.exit_code == 2
    assert "this table does not support the noise model 'day'; add" in refused.output


ALL = "from elastocal.plugins import *\n"
BAD = {
    "1 / 0\n": r"line 1: ZeroDivisionError: division by zero; correct the plug-in",
    "x = (\n": r"line 1: SyntaxError: '\(' was never closed; correct the plug-in",
    f"{ALL}register_effect(3)\n": r"line 2: an effect is an object .* from Effect; found int",
    f"{ALL}class A(JointMotion): name = 'backlash'\nregister_effect(A())\n": r".* already; ",
    f"{ALL}class A(Effect): name, stage = 'a', 'gears'\nregister_effect(A())\n": r".*'gears'",
    f"{ALL}class A(Effect): name, stage = 'a', 'tool'\nregister_effect(A())\n": r".* lacks places",
    f"{ALL}class A(NoiseModel):\n  name, description = 'polar', 'x'\n"
    "  def components(self, readings): return {}\nregister_noise_model(A())\n": (
        r"line 5: there is a noise model 'polar' already; choose another name"
    ),
}


@pytest.mark.parametrize("code", BAD)
def test_a_bad_plug_in_is_one_sentence_with_file_and_line(code: str, tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(code, encoding="utf-8")
    cell = tmp_path / "cell.toml"
    cell.write_text(CELL.replace("three_lobes.py", "bad.py"), encoding="utf-8")
    result = run("identify", cell, tmp_path / "data.csv")
    assert result.exit_code == 2 and "Traceback" not in result.stderr
    told = r"cell\.toml: key plugins\.modules\[0\]: .*bad\.py, " + BAD[code]
    assert re.search(told, result.stderr), result.stderr


@pytest.mark.parametrize(
    ("right", "wrong", "told"),
    [
        ("0.0, 5e-5", "0.0, -5e-5", "typical size above 0 or None; found 0.0, -5e-05"),
        ('p["lobes_sin"] * ca', 'p["lobes_sin"] ** 2 * ca', r"shape \(1, 1\), linear in the param"),
        ('return p["lobes_sin"]', 'return 1 + p["lobes_sin"]', "p and zero where they are"),
        ("3 * arm", "np.nan * arm", ": what three_lobes.* moves is no number there;"),
        ("3 * arm", 'arm.input("tyme", 1) * arm', "arm.input takes approach, .*found 'tyme'"),
        ('"turning joints"', '"joint"', "ThreeLobes.at takes joints, .*found 'joint'"),
    ],
)
def test_what_an_effect_declares_is_checked(
    right: str, wrong: str, told: str, folder: Path, tmp_path: Path
) -> None:
    code = (folder / "three_lobes.py").read_text(encoding="utf-8").replace(right, wrong)
    (tmp_path / "three_lobes.py").write_text(f"{code}\nimport numpy as np\n", encoding="utf-8")
    for verb, cell in (("identify", "with.toml"), ("diagnose", "cell.toml")):
        shutil.copyfile(folder / cell, tmp_path / cell)
        result = run(verb, tmp_path / cell, folder / "data.csv", "-q")
        assert result.exit_code == 2 and re.search(told, result.stderr), result.stderr


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ("absent.py", r"names .*absent\.py: no such file"),
        ("no_such_package.effects", "there is no module 'no_such_package'; install its package"),
        ("my effects", 'is a file that ends with .py, as "my_effects.py", or a module'),
    ],
)
def test_what_cannot_be_found_is_named(entry: str, told: str, tmp_path: Path) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text(CELL.replace("three_lobes.py", entry), encoding="utf-8")
    with pytest.raises(InputError, match=rf"plugins\.modules\[0\].*{told}"):
        Model(cell, plugins=True)


STRANGE = 'from pathlib import Path\nPath(__file__).with_name("ran").touch()\n'


@pytest.fixture
def strange(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cell whose plug-in leaves a file, `ran`, where it runs; data and a result of the cell."""
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(folder / "data.csv", "data.csv")
    cell, helper = Path("cell.toml"), Path("helper.py")
    cell.write_text(CELL.replace("three_lobes.py", "helper.py"), encoding="utf-8")
    helper.touch()
    assert run("identify", cell, "data.csv", "-o", "a.json", "-q").exit_code == 0
    files.RAN.clear()
    Path("targets.csv").write_text("x_mm,y_mm,z_mm\n2000,0,1500\n")
    helper.write_text(STRANGE, encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize(
    "words",
    ["effects cell.toml", "identify cell.toml data.csv", "diagnose cell.toml data.csv",
     "next cell.toml data.csv -o out.csv", "design cell.toml -o out.csv --effort quick",
     "simulate cell.toml data.csv -o out.csv"],
)  # fmt: skip
def test_a_cells_code_does_not_run_unasked(words: str, strange: Path) -> None:
    done = run(*words.split(), plugins=False)
    assert done.exit_code == 2 and done.stderr.count("elastocal:") == 1
    assert all(word in done.stderr for word in ("helper.py", "--plugins", "cell.toml"))
    assert not (strange / "ran").exists() and not (strange / "out.csv").exists()
    if words.startswith("design"):  # what is proposed then runs it too
        told = run(*words.split(), "--candidates", "60", "--poses", "8", "-q").stdout
        assert told.count(" cell.toml --plugins ") == 2, told


@pytest.mark.parametrize(
    "words",
    ["compare cell.toml a.json a.json", "compensate cell.toml a.json targets.csv --point M1",
     "export cell.toml a.json -o out.urdf",
     "import data.csv --preset kuka --cell cell.toml --preview"],
)  # fmt: skip
def test_what_reads_results_runs_no_code(words: str, strange: Path) -> None:
    done = run(*words.split(), plugins=False)
    assert done.exit_code == 0 or words.startswith("import"), done.stderr
    assert not (strange / "ran").exists()


@pytest.mark.parametrize("module", ["helper.py", "strange_helper"])
def test_who_allows_it(module: str, strange: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell, ran = strange / "cell.toml", strange / "ran"
    cell.write_text(CELL.replace("three_lobes.py", module), encoding="utf-8")
    (strange / "helper.py").rename(strange / f"{module.removesuffix('.py')}.py")
    monkeypatch.syspath_prepend(str(strange))
    for trusted in ("", "0", "no", str(strange / "within"), "."):
        monkeypatch.setenv(files.TRUSTED, trusted)
        for asked in (cell, read_cell(cell)):
            with pytest.raises(InputError, match=rf"{module[:6]}.*l\(.*, plugins=True\)"):
                Model(asked)
    assert not ran.exists()
    for trusted in ("1", str(strange), f"/nowhere:{strange.parent}", ""):
        monkeypatch.setenv(files.TRUSTED, trusted)
        Model(cell, plugins=not trusted)
        ran.unlink()
        Model(cell)  # what has run is not asked for again
        assert not ran.exists()
        files.RAN.clear()
        sys.modules.pop("strange_helper", None)


def test_a_file_that_was_changed_is_run_again(tmp_path: Path) -> None:
    path = write_example(tmp_path, "three_lobes.py")
    load_plugins(tmp_path / "cell.toml", [str(tmp_path / "three_lobes.py")])
    first = CATALOGUE["three_lobes"]
    load_plugins(tmp_path / "cell.toml", [str(tmp_path / "three_lobes.py")])
    assert CATALOGUE["three_lobes"] is first
    path.write_text(path.read_text().replace("0.0, 5e-5", "0.0, 7.5e-5"))
    load_plugins(tmp_path / "cell.toml", [str(tmp_path / "three_lobes.py")])
    (sine, _) = CATALOGUE["three_lobes"].parameters("joint1", None, None)  # type: ignore[arg-type]
    assert sine.typical == 7.5e-5
    assert not list(tmp_path.glob("__pycache__"))


def test_an_installed_package_registers_by_its_entry_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site"
    info = site / "lobed-1.0.dist-info"
    info.mkdir(parents=True)
    write_example(site, "three_lobes.py").rename(site / "lobed_effects.py")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lobed\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[elastocal.plugins]\nlobes = lobed_effects\n")
    monkeypatch.syspath_prepend(str(site))
    assert "three_lobes" not in CATALOGUE
    load_plugins()
    assert "three_lobes" in CATALOGUE
    (site / "lobed_effects.py").write_text("1 / 0\n")
    (info / "entry_points.txt").write_text("[elastocal.plugins]\nbad = lobed_broken\n")
    (site / "lobed_broken.py").write_text("1 / 0\n")
    monkeypatch.syspath_prepend(str(tmp_path))  # in other folders packages are looked for anew
    with pytest.raises(InputError, match=r"'bad' of the package lobed: .*lobed_broken\.py, line 1"):
        load_plugins()
