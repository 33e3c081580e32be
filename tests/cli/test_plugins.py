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
from support.cells import kr270_chain
from support.diagnosis_data import Fault, measured, plan
from support.registered import forgotten, write_example
from support.robots import KR270
from typer.testing import CliRunner, Result

from elastocal import plugin_loader
from elastocal.cell.work_cell import read_cell
from elastocal.cli.main import app
from elastocal.errors import InputError
from elastocal.measurements import Measurements
from elastocal.model.chain import Chain
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
LOBES = Fault("three_lobes", "joint3", {"lobes_sin": 1.2e-4, "lobes_cos": -1e-4})
DAY = 86400.0


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    with forgotten():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cell with its plug-in, and readings of an arm whose third gear has three lobes."""
    tmp_path = tmp_path_factory.mktemp("lobes")
    write_example(tmp_path, "three_lobes.py")
    path = tmp_path / "cell.toml"
    path.write_text(CELL, encoding="utf-8")
    with forgotten():
        plain = Model(path, plugins=True).cell
        chain = kr270_chain()
        table = measured(chain, plain, [LOBES], unloaded(chain, 25), 1)
    table.save(tmp_path / "data.csv")
    return tmp_path


def unloaded(chain: Chain, n: int) -> Measurements:
    table = plan(chain, n, 1)
    return table.take(np.all(table.force == 0, axis=1))


def run(*arguments: object, plugins: bool = True) -> Result:
    words = [str(a) for a in arguments] + ["--plugins"] * plugins
    return CliRunner().invoke(app, words, catch_exceptions=False)


def with_effect(folder: Path, entry: str) -> Path:
    cell = folder / "with.toml"
    cell.write_text(CELL.replace('"marker_position"', f'"marker_position", "{entry}"'))
    return cell


def test_identify_fits_it_and_export_leaves_it_out(folder: Path) -> None:
    out = folder / "result.json"
    cell = with_effect(folder, "three_lobes:joint3")
    assert run("identify", cell, folder / "data.csv", "-o", out, "-q").exit_code == 0
    found = {p["name"]: p for p in json.loads(out.read_text())["parameters"]}
    for key, value in LOBES.values.items():
        entry = found[f"joint3.{key}"]
        assert abs(entry["value"] - value) < 4 * entry["std"] < 4e-5
    # A file of the arm cannot hold it, and says what that costs.
    result = run("export", cell, out, "-o", folder / "arm.urdf", "--json")
    assert result.exit_code == 0, result.stderr
    (left_out,) = json.loads(result.stdout)["cannot_hold"]["effects"]
    assert left_out["effect"] == "three_lobes" and left_out["difference"]["marker_rms_um"] > 10


def test_diagnose_suspects_it_at_all_its_places_and_finds_it(folder: Path) -> None:
    out, extended = folder / "diagnosis.json", folder / "out" / "cell.toml"
    extended.parent.mkdir()
    result = run(
        "diagnose", folder / "cell.toml", folder / "data.csv", "-o", out, "-q",
        "--cell-out", extended,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    why = json.loads(out.read_text())
    tried = {c["where"] for c in why["candidates"] if c["effect"] == "three_lobes"}
    assert tried == {f"joint{i + 1}" for i in range(6)}
    assert why["verdict"] == "explained"
    assert [(e["effect"], e["where"]) for e in why["effects"]] == [("three_lobes", "joint3")]
    # The extended cell, in another folder, finds the plug-in where it was.
    assert "three_lobes" in [choice.name for choice in read_cell(extended).model.effects]


def test_a_model_with_it_travels_to_another_process(folder: Path) -> None:
    """The plug-ins that ran go with a pickle; an effect that no file states cannot, and says so."""
    model = Model(with_effect(folder, "three_lobes:joint3"), plugins=True)
    here, built = pickle.dumps(model), pickle.dumps(Model(replace(model.cell, plugins=())))
    opened = (
        "import pickle, sys\nfor text in sys.argv[1:]:\n"
        "    try: print(pickle.loads(bytes.fromhex(text)).names[-1])\n"
        "    except Exception as error: print(type(error).__name__, error)"
    )
    for order, told in (
        ((here,), [model.names[-1]]),
        ((built,), ["three_lobes was registered where .* put it in a file that \\[plugins\\]"]),
    ):
        words = [sys.executable, "-c", opened, *(each.hex() for each in order)]
        done = subprocess.run(words, check=True, capture_output=True, text=True, cwd="/")
        for line, expected in zip(done.stdout.splitlines(), told, strict=True):
            assert re.search(expected, line), line


def noisy_days(folder: Path) -> Path:
    """Readings of three days, on the second of which the air was restless."""
    cell = folder / "days.toml"
    text = CELL.replace("three_lobes.py", "noise_by_day.py").replace("sigma_um = 10\n", "")
    cell.write_text(text, encoding="utf-8")
    write_example(folder, "noise_by_day.py")
    model = Model(cell, plugins=True)
    table = unloaded(model.chain, 60)
    day = table.configuration % 3
    exact = model.predict(table).reshape(-1, 3)
    scatter = np.array([1e-5, 8e-5, 1e-5])[day][:, None]
    rng = np.random.default_rng(5)
    read = exact + scatter * rng.normal(size=exact.shape)
    table = replace(table, position=read, time=DAY * day + table.configuration.astype(float))
    data = folder / "days.csv"
    table.save(data)
    return cell


def test_the_noise_model_is_chosen_and_named(tmp_path: Path) -> None:
    cell = noisy_days(tmp_path)
    out, page = tmp_path / "result.json", tmp_path / "report.html"
    result = run("identify", cell, tmp_path / "days.csv", "-o", out, "--report", page, "-q")
    assert result.exit_code == 0, result.stderr
    noise = json.loads(out.read_text())["noise"]
    assert noise["kind"].partition("+")[0] == "day"
    sizes = {v["name"]: v["sigma_um"] for v in noise["variances"] if v["name"].startswith("day")}
    assert list(sizes) == ["day 1", "day 2", "day 3"]
    assert sizes["day 2"] == pytest.approx(80, rel=0.2)
    assert sizes["day 1"] == pytest.approx(10, rel=0.2)
    assert "one variance per day" in page.read_text(encoding="utf-8")
    timeless = tmp_path / "timeless.csv"
    replace(Model(cell).read(tmp_path / "days.csv"), time=None).save(timeless)
    refused = run("identify", cell, timeless, "--noise", "day+configuration", "-q")
    assert refused.exit_code == 2
    assert "this table does not support the noise model 'day'; add" in refused.output


BAD = {
    "1 / 0\n": r"bad\.py, line 1: ZeroDivisionError: division by zero; correct the plug-in",
    "x = (\n": r"bad\.py, line 1: SyntaxError: '\(' was never closed; correct the plug-in",
    "import nowhere_to_be_found\n": r"bad\.py, line 1: ModuleNotFoundError: No module named",
    "raise SystemExit(3)\n": r"bad\.py, line 1: SystemExit: 3",
    "from elastocal.plugins import *\nregister_effect(3)\n": (
        r"bad\.py, line 2: an effect is an object of a class derived from Effect; found int"
    ),
    "from elastocal.plugins import *\nregister_effect(Effect)\n": (
        r"bad\.py, line 2: register an effect, Effect\(\), not its class"
    ),
    "from elastocal.plugins import *\nclass A(JointMotion):\n  name = 'backlash'\n"
    "register_effect(A())\n": (
        r"bad\.py, line 4: there is an effect 'backlash' already; choose another name"
    ),
    "from elastocal.plugins import *\nclass A(Effect):\n  name = 'a'\n  stage = 'gears'\n"
    "register_effect(A())\n": r"bad\.py, line 5: A\.stage takes transmission, .*found 'gears'",
    "from elastocal.plugins import *\nclass A(Effect):\n  name = 'a'\n  stage = 'tool'\n"
    "register_effect(A())\n": r"bad\.py, line 5: A lacks places and a hook",
    "from elastocal.plugins import *\nclass A(NoiseModel):\n  name = 'polar'\n"
    "  description = 'x'\n  def components(self, readings): return {}\n"
    "register_noise_model(A())\n": (
        r"bad\.py, line 6: there is a noise model 'polar' already; choose another name"
    ),
}


@pytest.mark.parametrize("code", BAD)
def test_a_bad_plug_in_is_one_sentence_with_file_and_line(code: str, tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(code, encoding="utf-8")
    cell = tmp_path / "cell.toml"
    cell.write_text(CELL.replace("three_lobes.py", "bad.py"), encoding="utf-8")
    with pytest.raises(InputError, match=r"cell\.toml: key plugins\.modules\[0\]: .*" + BAD[code]):
        Model(cell, plugins=True)
    result = run("identify", cell, tmp_path / "data.csv")
    assert result.exit_code == 2 and "Traceback" not in result.stderr


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ("absent.py", r"names '.*absent\.py', which does not exist"),
        ("no_such_package.effects", "there is no module 'no_such_package'; install its package"),
        ("my effects", 'is a file that ends with .py, as "my_effects.py", or a module'),
    ],
)
def test_what_cannot_be_found_is_named(entry: str, told: str, tmp_path: Path) -> None:
    cell = tmp_path / "cell.toml"
    cell.write_text(CELL.replace("three_lobes.py", entry), encoding="utf-8")
    with pytest.raises(InputError, match=rf"plugins\.modules\[0\].*{told}"):
        Model(cell, plugins=True)


STRANGE = """\
from pathlib import Path
Path(__file__).with_name("ran").touch()
"""


@pytest.fixture(scope="module")
def identified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cell with a plug-in, data of it, and two results."""
    folder = tmp_path_factory.mktemp("identified")
    cell = folder / "cell.toml"
    cell.write_text(CELL.replace("three_lobes.py", "absent.py"), encoding="utf-8")
    (folder / "absent.py").touch()
    with forgotten():
        model = Model(cell, plugins=True)
        table = unloaded(model.chain, 25)
        replace(table, position=model.predict(table).reshape(-1, 3)).save(folder / "data.csv")
        done = run("identify", cell, folder / "data.csv", "-o", folder / "a.json", "-q")
    assert done.exit_code == 0, done.stderr
    shutil.copyfile(folder / "a.json", folder / "b.json")
    (folder / "targets.csv").write_text("x_mm,y_mm,z_mm\n2000,0,1500\n")
    return folder


@pytest.fixture
def strange(identified: Path, tmp_path: Path) -> Path:
    """The same with a plug-in that leaves a file, `ran`, where it runs."""
    shutil.copytree(identified, tmp_path, dirs_exist_ok=True)
    text = CELL.replace("three_lobes.py", "helper.py")
    (tmp_path / "cell.toml").write_text(text, encoding="utf-8")
    (tmp_path / "helper.py").write_text(STRANGE, encoding="utf-8")
    return tmp_path


FITTING: dict[str, list[str]] = {
    "effects": [],
    "identify": ["data.csv"],
    "diagnose": ["data.csv"],
    "next": ["data.csv", "-o", "out.csv"],
    "design": ["-o", "out.csv", "--effort", "quick"],
    "simulate": ["data.csv", "-o", "out.csv"],
}
READING = {
    "compare": ["a.json", "b.json"],
    "compare of a named cell": ["a.json", "b.json", "--cell", "cell.toml"],
    "compensate": ["cell.toml", "a.json", "targets.csv", "--point", "M1"],
    "export": ["cell.toml", "a.json", "-o", "out.urdf"],
    "import": ["data.csv", "--preset", "kuka", "--cell", "cell.toml", "--preview"],
}


@pytest.mark.parametrize("verb", FITTING)
def test_a_cells_code_does_not_run_unasked(
    verb: str, strange: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(strange)
    done = run(verb, "cell.toml", *FITTING[verb], plugins=False)
    assert done.exit_code == 2 and done.stderr.count("elastocal:") == 1
    assert all(word in done.stderr for word in ("helper.py", "--plugins", "cell.toml"))
    assert not (strange / "ran").exists() and not (strange / "out.csv").exists()


@pytest.mark.parametrize("verb", READING)
def test_what_reads_results_runs_no_code(
    verb: str, strange: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(strange)
    done = run(verb.split()[0], *READING[verb], plugins=False)
    assert done.exit_code == 0 or verb == "import", done.stderr
    assert not (strange / "ran").exists()


@pytest.mark.parametrize("module", ["helper.py", "strange_helper"])
def test_who_allows_it(module: str, strange: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell, ran = strange / "cell.toml", strange / "ran"
    cell.write_text(CELL.replace("three_lobes.py", module), encoding="utf-8")
    (strange / "helper.py").rename(strange / f"{module.removesuffix('.py')}.py")
    monkeypatch.syspath_prepend(str(strange))
    for trusted in ("", "0", "no", str(strange / "within"), "."):
        monkeypatch.setenv(plugin_loader.TRUSTED, trusted)
        with pytest.raises(InputError, match=rf"{module.removesuffix('.py')}.*plugins=True"):
            Model(cell)
    assert not ran.exists()
    for trusted in ("1", str(strange), f"/nowhere:{strange.parent}"):
        monkeypatch.setenv(plugin_loader.TRUSTED, trusted)
        Model(cell)
        assert ran.exists()
        ran.unlink()
        plugin_loader._files.clear()
        sys.modules.pop("strange_helper", None)
    monkeypatch.delenv(plugin_loader.TRUSTED)
    read_cell(cell)
    with pytest.raises(InputError, match="plugins=True"):
        Model(read_cell(cell))
    assert not ran.exists()
    Model(cell, plugins=True)
    assert ran.exists()
    Model(cell)  # what has run is not asked for again
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
    with pytest.raises(
        InputError, match=r"plug-in 'bad' of the package lobed: .*lobed_broken\.py, line 1"
    ):
        load_plugins()
