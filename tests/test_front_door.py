"""`import elastocal as ec`: its names, what they cost, and the day's work from plan to commands."""

import ast
import csv
import inspect
import json
import pickle
import subprocess
import sys
import typing
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.design_commands import elastocal as command

import elastocal as ec
from elastocal import plugins
from elastocal.cell_tables import DesignSpec
from elastocal.diagnosis.diagnose import DiagnosisOptions
from elastocal.identification.start import Options
from elastocal.messages import saying
from elastocal.planning.design import DesignOptions
from elastocal.report.renderers import FRAMES
from elastocal.saving import WRITERS
from elastocal.simulation import LOAD_N, run_demo

HEAVY = ("numpy", "casadi", "pandas", "scipy", "pydantic", "matplotlib", "plotly", "pinocchio")
LOAD = list(LOAD_N)
TARGETS = np.array([[1.8, 0.0, 0.9], [1.8, 0.2, 0.9], [1.7, -0.2, 1.0]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The demo's files, and a second set of readings that was kept back."""
    made = tmp_path_factory.mktemp("front")
    run_demo(made)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        result = command("simulate", "cell.toml", "plan.csv", "-o", "kept_back.csv", "--seed", "7",
                         "--load", *LOAD, "--repeats", "2",
                         "--set", "joint3.compliance=4.1e-7")  # fmt: skip
        assert result.exit_code == 0
    return made


@pytest.fixture(autouse=True)
def in_folder(folder, monkeypatch):
    monkeypatch.chdir(folder)


@pytest.fixture(scope="module")
def model(folder):
    return ec.Model(folder / "cell.toml")


@pytest.fixture(scope="module")
def fit(folder):
    model = ec.Model(folder / "cell.toml")  # its own: what evaluated it is part of the result
    data, kept_back = model.read(folder / "data.csv"), model.read(folder / "kept_back.csv")
    return ec.identify(model, data, fixed=["joint1.compliance"], test=kept_back)


@pytest.fixture(scope="module")
def plan(model):
    return ec.design(
        model, poses=4, criterion="test_pose", test_poses=[[0.3, -0.4405, 0.6, 0.2, 0.5, 0.1]],
        loads=[LOAD], levels={"joint2": np.radians([-25.24, -99.85])}, candidates=60,
        effort="quick", fixed="joint1",
    )  # fmt: skip


# Names


def test_type_checkers_see_the_same_homes_as_the_interpreter():
    tree = ast.parse(Path(ec.__file__).read_text(encoding="utf-8"))
    imports = {
        alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("elastocal.")
        for alias in node.names
    }
    assert sorted(imports) == sorted(ec.__all__)
    home = {name: f"elastocal.{room}" for room, names in ec.ROOMS.items() for name in names.split()}
    assert imports.items() <= home.items()


def test_importing_elastocal_loads_nothing_heavy():
    code = (
        "import sys, elastocal as ec, elastocal.verbs as v; dir(ec); ec.InputError\n"
        f"assert ec.design is v.design; print([m for m in {HEAVY} if m in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert run.stdout.strip() == "[]"


# The day's work


def test_a_model_is_made_of_a_file_a_cell_or_a_path(folder):
    cell = ec.read_cell("cell.toml")
    built = ec.Cell(name=cell.name, path=None, robot=ec.Robot(urdf=folder / "kr270_2.urdf"),
                    tool=cell.tool, tracker=cell.tracker, model=cell.model)  # fmt: skip
    names = {ec.Model(given).names for given in ("cell.toml", folder / "cell.toml", cell, built)}
    assert len(names) == 1


def test_simulate_is_that_of_the_command_line(model):
    data = ec.simulate(
        model, "plan.csv", values={"joint3.compliance": 4.1e-7}, load=LOAD, repeats=2, seed=7
    )
    read = model.read("kept_back.csv")
    assert np.array_equal(data.position, read.position) and np.array_equal(data.q, read.q)


def test_a_calibration_is_a_mapping_of_estimates(fit):
    found = fit["joint3.compliance"]
    assert found.ci95[0] < found.value < found.ci95[1]
    assert (found.unit, found.identifiable, found.combined_with) == ("rad/(N*m)", True, ())
    assert not fit["joint1.compliance"].identifiable
    assert list(fit) == list(fit.model.names) == fit._ipython_key_completions_()
    assert len(fit) == 10 and "joint2.compliance" not in fit
    assert dict(fit)["joint3.compliance"] is found is fit.get("joint3.compliance")
    assert dict(fit.items()) == dict(fit) and fit.get("joint9.compliance") is None
    rho = fit.correlation
    assert rho.shape == (9, 9) and np.allclose(np.diag(rho), 1) and (np.abs(rho) < 1 + 1e-12).all()
    assert all(
        np.isclose(rho[fit.determined.index(a), fit.determined.index(b)], r)
        for a, b, r in fit.correlations
    )
    assert fit.covariance.shape == (9, 9) and fit.B.shape == (len(fit.residual), 10)


def test_a_wrong_name_is_an_input_error_with_the_nearest(fit):
    with pytest.raises(ec.InputError, match=r"did you mean 'joint3\.compliance'") as caught:
        fit["joint3.complience"]
    with pytest.raises(ec.InputError, match=r"did you mean 'joint2\.compliance_level1'"):
        fit["joint2.compliance"]
    assert isinstance(caught.value, KeyError)
    assert not str(caught.value).startswith(("'", '"'))


def test_identify_is_that_of_the_command_line(fit):
    done = command("identify", "cell.toml", "data.csv", "--test", "kept_back.csv", "--fix",
                   "joint1.compliance", "-o", "line.json", "--quiet")  # fmt: skip
    assert done.exit_code == 0, done.output
    fit.save("front.json")
    mine, other = (json.loads(Path(f"{name}.json").read_text()) for name in ("front", "line"))
    assert Path(mine.pop("data")).name == other.pop("data")
    assert mine == other


def test_a_plan_saves_itself_and_is_simulated_as_its_file_is(plan, model):
    plan.save("plan4.csv")
    written = json.loads(Path("plan4.json").read_text())
    assert written["n_poses"] == len(plan) == 4 and written["criterion"] == "test_pose"
    read, direct = model.read_plan("plan4.csv"), plan.table()
    assert np.array_equal(read.q, direct.q) and np.array_equal(read.force, direct.force)
    assert read.configuration_labels == direct.configuration_labels
    assert list(plan.to_dataframe()["configuration"]) == ["1", "2", "3", "4"]


def test_a_plan_of_several_loads_states_those_of_each_row_as_they_were_asked_for(model, tmp_path):
    loads = [[0.0, 0.0, -2600.0], [0.0, 900.0, 0.0]]
    ec.design(model, poses=5, criterion="D", loads=loads, levels={"joint2": [-0.44, -1.74]},
              candidates=30, effort="quick").save(tmp_path / "plan.csv")  # fmt: skip
    with (tmp_path / "plan.csv").open() as file:
        rows = [row for row in csv.DictReader(file)]
    stated = {tuple(float(row[f"force_{axis}_N"]) for axis in "xyz") for row in rows}
    assert stated == {(0.0, 0.0, 0.0), *map(tuple, loads)}  # deflections need both


def test_diagnose_is_that_of_the_command_line(folder, fit):
    why = ec.diagnose(ec.Model(folder / "cell.toml"), "data.csv", seed=1)
    given = ("cell.toml", "data.csv", "-o", "line.json", "--cell-out", "line.toml", "--seed", "1")
    done = command("diagnose", *given, "-q")
    assert done.exit_code == 0, done.output
    with saying(flags=True):  # its remedies name options
        why.save("front.json")
    assert Path("front.json").read_text() == Path("line.json").read_text()
    assert why.budget and why.verdict == "nothing_significant"  # nothing is missing in the demo
    for its, source in ((why, why.model.cell.path), (fit, "data.csv"), (fit.arm, "kr270_2.urdf")):
        with pytest.raises(ec.InputError, match="is read and would be written over"):
            its.save(source)
    assert why.save("front.toml") or Path("front.toml").read_text() == Path("line.toml").read_text()
    with pytest.raises(ec.InputError, match="not that of a cell file"):
        replace(why, model=ec.Model(replace(why.model.cell, path=None))).save("built.toml")


def test_the_arm_of_a_fit_is_that_of_its_file(fit):
    fit.save("result.json")
    arm = ec.read_calibrated("cell.toml", "result.json")
    assert np.array_equal(fit.arm.x, arm.x) and fit.arm.determined == arm.determined
    assert np.array_equal(fit.arm.covariance, arm.covariance)
    q = [0.2, -0.44, 0.8, 0.1, 0.4, 0.0]
    assert np.array_equal(fit.arm.pose(q, LOAD), arm.pose([q], [LOAD])[0])
    fit.arm.save("mine.urdf", load=LOAD)
    arm.save("file.urdf", load=LOAD)
    mine, other = (Path(f"{name}.urdf").read_text() for name in ("mine", "file"))
    assert mine.replace("data.csv", "").replace(str(Path.cwd()) + "/", "") == other.replace(
        "result.json", ""
    )


def test_compensate_is_that_of_the_command_line(fit):
    fit.save("result.json")
    rows = [",".join(f"{v * 1e3:g}" for v in target) for target in TARGETS]
    Path("targets.csv").write_text("x_mm,y_mm,z_mm\n" + "\n".join(rows) + "\n")
    done = command("compensate", "cell.toml", "result.json", "targets.csv", "-o", "line.csv",
                   "--load", *LOAD, "-q")  # fmt: skip
    assert done.exit_code == 0, done.output
    commands = ec.compensate(fit, "targets.csv", load=LOAD)
    commands.save("front.csv")
    assert Path("front.csv").read_text() == Path("line.csv").read_text()
    in_memory, one = (ec.compensate(fit, t, load=LOAD) for t in (TARGETS, pd.Series(TARGETS[0])))
    np.testing.assert_allclose(in_memory.q, commands.q, atol=1e-12)
    assert len(in_memory) == 3 and in_memory.reached.all() and one.reached.all()
    frame = pd.read_csv("targets.csv")[["z_mm", "x_mm", "y_mm"]]  # columns count by their names
    np.testing.assert_array_equal(ec.compensate(fit.arm, frame, load=LOAD).q, commands.q)


def test_every_result_reports_plots_and_tabulates_itself(fit, plan):
    commands = ec.compensate(fit.arm, TARGETS, load=LOAD)
    readings = ec.simulate("cell.toml", "plan.csv", load=LOAD)
    for result in (plan, commands, readings):
        result.report("report.html")
        page = Path("report.html").read_text()
        assert page.startswith("<!doctype html>") and "To repeat this" in page
        assert len(result.to_dataframe()) == len(result)
        assert result.plot().axes
        assert str(result).count("\n") > 5
        assert repr(result).startswith(f"<{type(result).__name__} ") and "\n" not in repr(result)
    readings.save("saved.csv")
    assert np.array_equal(ec.Model("cell.toml").read("saved.csv").position, readings.position)
    with pytest.raises(ec.InputError, match="no figure 'pose'"):
        plan.plot("pose")
    with pytest.raises(ec.InputError, match=r"no figure 'curve'; there are poses$"):
        plan.plot("curve")


def test_a_cell_without_markers_takes_those_of_the_table(folder):
    text = Path("cell.toml").read_text()
    start, end = text.index("[tool.markers_m]"), text.index("[tracker]")
    bare = (text[:start] + text[end:]).replace('["joint_compliance"]', '["marker_position"]')
    Path("bare.toml").write_text(bare.replace('"deflection"', '"position"'))
    model = ec.Model("bare.toml")
    data = model.read("data.csv")
    assert data.marker_names == ("M1", "M2", "M3")
    assert model.names[0] == "marker:M1.x" and len(model.names) == 3
    assert len(ec.identify(model, data)) == 9


# Wrong options


@pytest.mark.parametrize(
    ("verb", "options", "named"),
    [
        ("design", {"criterion": "test_poes"}, "`criterion` .*did you mean 'test_pose'"),
        ("design", {"curve": [10, 2]}, r"^curve=2: .*cell\.toml has 5 levels"),
        ("next_poses", {"batch": 2}, r"^batch=2: .*cell\.toml has 5 levels"),
        ("design", {"poses": 3, "target": 1e-5}, "`poses` and `target`: a target"),
        ("design", {"robust": "worst"}, "`robust` is gone: plans are made .* as identified"),
        ("design", {"doubts": {}}, "`doubts` is gone: for effects that the model may lack"),
        ("design", {"test_poses": [0, 0, 0]}, r"^`test_poses` no\. 1 has 3 numbers"),
        ("design", {"criterion": "D", "elsewhere_cap": 0.1}, "^`elsewhere_cap` goes with"),
        ("design", {"effort": "fast"}, "^`effort` 'fast' is unknown"),
        ("identify", {"prior": {"joint3": 3}}, "`prior` takes mean and std by parameter"),
        ("identify", {"fixed": "joint9"}, r"fixed=\['joint9'\]: the model has no such"),
        ("identify", {"test": 5}, "`test` takes measurements"),
        ("diagnose", {"false_alarm": 0.7}, "`false_alarm` takes a number between"),
        ("simulate", {"load": [0, 1]}, "`load` takes three finite numbers"),
        ("simulate", {"values": {"joint3": 1.0}}, "no parameter 'joint3'"),
        ("compensate", {"point": "M9"}, "`point`: 'M9' is no marker"),
    ],
)
def test_a_wrong_option_is_named_by_its_keyword(verb, options, named, model, fit):
    first = {
        "design": (model,), "identify": (model, "data.csv"), "diagnose": (model, "data.csv"),
        "next_poses": (model, "data.csv"), "simulate": (model, "plan.csv"),
        "compensate": (fit, TARGETS),
    }[verb]  # fmt: skip
    with pytest.raises(ec.InputError, match=named) as caught:
        getattr(ec, verb)(*first, **options)
    assert "--" not in str(caught.value)


def test_a_load_is_given_by_either_name(model, fit):
    """`load`, as an argument; `force`, as the column of a table is called."""
    q = [0.1, -1.0, 1.0, 0.0, 0.5, 0.2]
    for call in (model.pose, fit.arm.pose, fit.predict,
                 lambda q, **given: model.table(q, **given).force,
                 lambda q, **given: ec.table(q, **given).force):  # fmt: skip
        assert np.array_equal(call(q, load=LOAD), call(q, force=LOAD))
        assert call == model.pose or not np.array_equal(call(q, load=LOAD), call(q))
        with pytest.raises(TypeError, match=r"force|load"):
            call(q, load=LOAD, force=LOAD)
    with pytest.raises(ec.InputError, match=r"^`load` takes .* found numbers beyond all measure"):
        model.pose(q, force=[0, 0, np.nan])


def test_progress_is_told(model):
    told = []
    ec.identify(model, "data.csv", progress=told.append)
    assert "finding the start" in told


def test_what_a_user_guesses(folder):
    """A data frame for a table, pickles, and the words that other libraries have for a fit."""
    import pandas as pd

    model = ec.Model(folder / "cell.toml")
    frame = pd.read_csv(folder / "data.csv", comment="#")
    fit = ec.identify(model, frame)
    again = pickle.loads(pickle.dumps(fit))
    assert again.params == fit.params == dict(zip(model.names, fit.x, strict=True))
    assert np.array_equal(again.model.B(model.read(frame), fit.x), fit.B)
    assert fit == again and len({fit, again}) == 1
    assert fit.residuals.shape == (270, 3)
    assert fit.to_dict()["schema"] == "elastocal/identification/1"
    assert fit.summary() == str(fit)
    plan = model.read_plan(folder / "plan.csv")
    assert ec.simulate(model, plan.to_dataframe()) == ec.simulate(model, plan)
    assert "540 of 540 readings" in ec.identify(model, frame, test=frame).warnings[0]
    assert fit.predict(plan.q, [0, 0, -2600]).shape == (len(plan), 3)
    table = fit.observations.table
    assert np.allclose(fit.predict(table), fit.observations.value.reshape(-1, 3) - fit.residuals)
    assert np.allclose(fit.predict(table.to_dataframe()), fit.predict(table), atol=1e-9)
    told = "joint3.compliance = (4.167 ± 0.014)e-07 rad/(N*m) (standard deviation)"
    assert str(fit["joint3.compliance"]) == told
    assert str(fit["joint1.compliance"]) == "joint1.compliance: no value"
    for wrong in (ec.read_cell, ec.init, fit.save, fit.report, fit.certificate):
        with pytest.raises(ec.InputError, match="path"):
            wrong(5)
    with pytest.raises(ec.InputError, match="`load` goes with joints"):
        fit.predict(table, load=[0, 0, -1])
    with pytest.raises(ec.InputError, match="DataFrame"):
        model.read(frame.drop(columns=[c for c in frame if c.startswith("q1_")]))


def test_what_is_the_same_is_equal(folder, model, fit, plan, tmp_path):
    """By what it holds: made again, pickled, and read from copies of its files elsewhere."""
    for name in ("cell.toml", "data.csv", "kr270_2.urdf"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    elsewhere = ec.Model(tmp_path / "cell.toml")
    data, copy = model.read("data.csv"), elsewhere.read(tmp_path / "data.csv")
    again = ec.identify(elsewhere, copy, fixed=["joint1.compliance"])
    once = ec.identify(model, data, fixed=["joint1.compliance"])
    fit.save(tmp_path / "result.json")
    pairs = [
        (ec.read_cell("cell.toml"), ec.read_cell("cell.toml")), (ec.Tool(), ec.Tool()),
        (model, elsewhere), (data, copy), (once, again), (once.arm, again.arm),
        (fit.arm, ec.load(tmp_path / "result.json")),
        (ec.compensate(once, TARGETS), ec.compensate(again, TARGETS)),
        (ec.compare(once, fit), ec.compare(again, fit)),
        (once.position(np.zeros(6)), again.position(np.zeros(6))),
    ]  # fmt: skip
    for one, other in pairs:
        assert one == other and hash(one) == hash(other) and len({one, other}) == 1, type(one)
        assert pickle.loads(pickle.dumps(one)) == other
    # And what differs is not, by however little.
    assert data != replace(data, position=data.position + 1e-12) and data != "data.csv"
    assert data != replace(data, marker_names=("M1", "M3", "M2")) and data != data[:-1]
    heavier = replace(model.cell.tool, load_point=[0.2, 0.0, 0.26])
    assert ec.Model(replace(model.cell, tool=heavier)) != model != fit and once != fit


def test_a_file_is_loaded_by_what_it_is(fit, tmp_path):
    fit.save("result.json")
    model, arm, data = (ec.load(name) for name in ("cell.toml", "result.json", "data.csv"))
    assert model.names == fit.model.names and np.array_equal(arm.x, fit.x)
    assert np.array_equal(data.position, model.read("data.csv").position)
    (tmp_path / "copy.json").write_text(Path("result.json").read_text())
    assert np.array_equal(ec.load(tmp_path / "copy.json", cell="cell.toml").x, fit.x)
    with pytest.raises(ec.InputError, match=r"no cell\.toml beside .*copy\.json"):
        ec.load(tmp_path / "copy.json")
    with pytest.raises(ec.InputError, match=r"kr270_2\.urdf: give a cell file"):
        ec.load("kr270_2.urdf")


def test_the_ending_says_what_is_saved(fit, plan, tmp_path):
    data = fit.model.read("data.csv")
    data = replace(data, configuration_labels=("'=1", *data.configuration_labels[1:]))
    data.save(tmp_path / "data.parquet")
    again = fit.model.read(tmp_path / "data.parquet")
    assert again.configuration_labels == data.configuration_labels
    assert all(np.array_equal(getattr(again, k), getattr(data, k)) for k in ("q", "position"))
    for result, name, allowed in ((fit, "y.parquet", ".json or .csv"), (plan, "x.xlsx", ".csv"),
                                  (data, "d.csv.gz", ".csv or .parquet or .pq")):  # fmt: skip
        with pytest.raises(ec.InputError, match=f"is saved as {allowed}; name the file so"):
            result.save(tmp_path / name)
        assert not (tmp_path / name).exists()


def test_arrays_of_many_markers_are_what_their_file_is(model):
    data = replace(model.read("data.csv"), sigma=None)
    names = [data.marker_names[k] for k in data.marker]
    table = ec.table(data.q, data.position, data.force, marker=names)
    for name in ("q", "position", "force", "configuration", "repeat", "marker"):
        assert np.array_equal(getattr(table, name), getattr(data, name)), name
    with pytest.raises(ec.InputError, match="`marker` takes a value for each row"):
        ec.table(data.q, data.position, marker=["M1"])


def spoken_for(name: str, what: object) -> Iterator[tuple[str, object]]:
    """A name of the door and, of a class, its public methods and properties."""
    yield name, what
    own = [c for c in getattr(what, "__mro__", ()) if c.__module__.startswith("elastocal")]
    for key, value in ((k, v) for c in own for k, v in vars(c).items() if not k.startswith("_")):
        plain = next(
            (f for f in (getattr(value, a, None) for a in ("fget", "func", "__func__")) if f), value
        )
        if inspect.isfunction(plain) and plain.__module__.startswith("elastocal"):
            yield f"{name}.{key}", plain


@pytest.mark.parametrize("door", [ec, plugins], ids=["elastocal", "elastocal.plugins"])
def test_type_hints_of_all_that_is_public_are_resolved(door):
    """As tools for documentation and validation ask for them."""
    for name in door.__all__:
        for told, what in spoken_for(name, getattr(door, name)):
            hints = typing.get_type_hints(what)
            unresolved = [k for k, v in hints.items() if "ForwardRef" in repr(v)]
            assert not unresolved, f"{told}: {unresolved}"
    assert typing.get_type_hints(ec.identify)["return"] is ec.Calibration
    assert ec.Knowledge in typing.get_args(typing.get_type_hints(ec.design)["knowledge"])


def test_whatever_a_verb_returns_is_a_result():
    """Its `save`, `report`, `plot` and `to_dataframe` find what they need by the class's name."""
    verbs = ["design", "simulate", "identify", "diagnose", "compensate", "compare", "next_poses"]
    returned = {inspect.signature(getattr(ec, name)).return_annotation for name in verbs}
    assert returned == set(FRAMES) == set(WRITERS) - {"CalibratedArm"}


@pytest.mark.parametrize(
    ("verb", "kind", "renamed"),
    [
        ("identify", Options, {"faulty": "outliers"}),
        ("design", DesignOptions, {"done": "augment", "notes": "knowledge", "pins": "keep",
                                   "asked": "model", "hold": "effort"}),
        ("design", DesignSpec, {"taught": "candidates"}),
        ("diagnose", DiagnosisOptions, {}),
    ],
)  # fmt: skip
def test_every_option_of_the_packages_is_a_keyword(verb, kind, renamed):
    keywords = set(inspect.signature(getattr(ec, verb)).parameters)
    assert {renamed.get(f.name, f.name) for f in fields(kind)} <= keywords
