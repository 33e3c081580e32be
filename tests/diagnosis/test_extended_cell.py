"""The cell with effects added: the same cell otherwise, wherever and however it was written."""

from __future__ import annotations

import os
import re
import tempfile
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.diagnoses import ECCENTRICITY, JUMP
from support.robots import KR270

from elastocal.cell import read_cell
from elastocal.cell_tables import EffectChoice
from elastocal.diagnosis.diagnose import write_extended_cell
from elastocal.messages import InputError
from elastocal.model.manipulator import Model

ROOT = Path(__file__).parents[2]
SLIP = replace(JUMP, effect="marker_slip", where="marker:M1", settings={"slip_time_s": 61.5})
DRIFT = replace(JUMP, effect="base_drift", where="base", settings={"time_constant_s": 900.0})
FOUND = (ECCENTRICITY, JUMP, SLIP, DRIFT)
FILES = ("arm.urdf", "fixture.stl", "path.csv", "dh.csv", "links.csv", "load.stl")

# The same things said in the ways that TOML has.
LAYOUTS = (
    '[robot]\nurdf = "arm.urdf"\n',
    'robot = { dh = "dh.csv", masses = "./links.csv" }\nmodel.effects = []\n'
    "model.nominal.base_position_m = [0, 0, 1]\n",
    "[model.nominal.settings.joint1]\njump_time_s = 3\nripple_order = 101.0\n"
    '[robot]\nurdf = "../cell/arm.urdf"\n'
    '[model]\neffects = ["base_frame", "gear_eccentricity:joint2"]  # one is there already\n',
    'model = { nominal = { settings = { "marker:M1" = { slip_time_s = 1.0 } } } }\n'
    '[robot]\nurdf = "arm.urdf"\n[workspace.load]\nshape = "mesh"\nfile = "load.stl"\n'
    '[[workspace.body]]\nname = "b"\nshape = "mesh"\nfile = "fixture.stl"\n',
    '[robot]\nurdf = "arm.urdf"\n[design]\ncandidates = [100, "path.csv"]\n',
)


def documented() -> str:
    """The cell of docs/file-formats.md with every table it shows."""
    text = (ROOT / "docs" / "file-formats.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```toml(?: workspace| design)?\n(.*?)```", text, re.S)
    assert len(blocks) == 3
    return "\n".join(blocks)


def alike(one: Any, other: Any) -> bool:
    """Equal, with arrays by value and paths by the file they lead to."""
    if is_dataclass(one):
        return type(one) is type(other) and all(
            alike(getattr(one, f.name), getattr(other, f.name)) for f in fields(one)
        )
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    if isinstance(one, Path):
        return os.path.samefile(one, other)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(alike(one[k], other[k]) for k in one)
    return one == other


@given(
    layout=st.sampled_from((*LAYOUTS, documented())),
    found=st.lists(st.sampled_from(FOUND), unique_by=id),
    folder=st.sampled_from(("cell", ".", "other", "cell/deep/er", "link", "link/../..")),
    absolute=st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_reading_it_back_gives_the_same_cell_and_the_additions(layout, found, folder, absolute):
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        for path in ("cell/deep/er", "other", "far/away"):
            (root / path).mkdir(parents=True)
        (root / "link").symlink_to(root / "far" / "away")
        for file in FILES:
            (root / "cell" / file).write_text("x")
        source = root / "cell" / "kr.toml"
        text = layout.replace('"arm.urdf"', f'"{root}/cell/arm.urdf"') if absolute else layout
        source.write_text(text, encoding="utf-8")
        target = root / folder / "new.toml"
        before, after = read_cell(source), write_extended_cell(source, target, found)

        model, added = before.model, [EffectChoice(f.effect, f.where) for f in found]
        constants = {place: dict(keys) for place, keys in model.nominal.settings.items()}
        for f in (f for f in found if f.settings):
            constants.setdefault(f.where, {}).update(f.settings)
        nominal = replace(model.nominal, settings=constants)
        effects = tuple(dict.fromkeys((*model.effects, *added)))
        model = replace(model, effects=effects, nominal=nominal)
        expected = replace(before, path=target, model=model)
        assert alike(after, expected) and alike(read_cell(target), expected)
        assert source.read_text(encoding="utf-8") == text


@pytest.mark.parametrize("text", ["[robot", "[robot]\n", '[robot]\nurdf = "missing.urdf"\n'])
def test_a_bad_cell_is_refused_and_nothing_written(tmp_path, text):
    (tmp_path / "cell.toml").write_text(text)
    with pytest.raises(InputError, match=r"cell\.toml"):
        write_extended_cell(tmp_path / "cell.toml", tmp_path / "new.toml", FOUND)
    assert [p.name for p in tmp_path.iterdir()] == ["cell.toml"]


def test_the_cell_says_where_its_smooth_functions_end(tmp_path):
    (tmp_path / "arm.urdf").write_bytes(KR270.read_bytes())
    source = tmp_path / "cell.toml"
    own = '# hall 3\n[robot]\nurdf = "arm.urdf"  # of June\n[model]\n'
    source.write_text(own + 'effects = ["base_frame"]  # so far\n# the end\n', encoding="utf-8")
    settings = {"curve_low_rad": -1.5, "curve_high_rad": 1.5}
    curve = replace(ECCENTRICITY, effect="joint_curve", parameters=(), settings=settings)
    cell = write_extended_cell(source, tmp_path / "new.toml", (curve,))
    text = (tmp_path / "new.toml").read_text()
    assert f"{curve.where} from -85.9° to 85.9°;" in text.partition("# hall 3\n")[0]
    added = 'effects = ["base_frame", "joint_curve:joint2"]  # so far\n# the end\n\n[model.nominal'
    assert added in text and 'urdf = "arm.urdf"  # of June\n' in text
    assert cell.model == read_cell(tmp_path / "new.toml").model


def test_a_spring_begins_where_it_was_found(tmp_path):
    """From the example's geometry a fit would not find it again.  The other end of the arm is the
    same spring, anchored on the other side."""
    (tmp_path / "cell.toml").write_text(f'[robot]\nurdf = "{KR270}"\n', encoding="utf-8")
    values = {"stiffness": 2.5e4, "anchor_x": 0.2, "anchor_y": -0.5, "arm": -0.3,
              "free_length": -0.4}  # fmt: skip
    fitted = tuple(
        replace(ECCENTRICITY.parameters[0], name=f"joint2.compensator_{k}", value=v)
        for k, v in values.items()
    )
    found = replace(ECCENTRICITY, effect="gravity_compensator", parameters=fitted)
    spring = Model(write_extended_cell(tmp_path / "cell.toml", tmp_path / "new.toml", [found]))
    at = dict(zip(spring.names, spring.nominal, strict=True))
    assert at["joint2.compensator_arm"] == 0.3 and at["joint2.compensator_anchor_y"] == 0.5
    assert at["joint2.compensator_free_length"] == -0.4
    assert at["joint2.compensator_stiffness"] == 2.5e4
