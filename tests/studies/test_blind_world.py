"""The worlds of the blind check: an arm of its own, at rest, that obeys the stated physics."""

# ruff: noqa: E402  (the study is a script: its folder has to be found first)

import ast
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco")
FOLDER = Path(__file__).resolve().parents[2] / "experiment_design" / "blind_diagnosis"
sys.path.insert(0, str(FOLDER))

from afterwards import plain_fit, true_reduction
from arm_data import ARMS
from draw import ALIKE, CATALOGUE, Recipe, World
from instrument import OUTLIER_SIZE, REPEATABILITY, VARIANTS, draw_noise
from suites import named, tasks
from world_files import write_table, write_world

import elastocal as ec
from elastocal.cell import read_cell
from elastocal.cell_tables import EffectChoice
from elastocal.diagnosis.diagnose import write_extended_cell
from elastocal.measurements import Measurements, read_measurements
from elastocal.model.manipulator import Model

WORLD_MODULES = {
    "arm_data", "draw", "inside", "instrument", "mechanics", "outside", "places",
    "skeleton", "whole_columns", "whole_draw", "whole_oracle",
    "whole_score", "world", "world_files",
}  # fmt: skip
CASES = [
    pytest.param(name, arm, marks=() if k % len(ARMS) == i else pytest.mark.long)
    for k, name in enumerate(CATALOGUE)
    for i, arm in enumerate(ARMS)
    if name != "gravity_compensator" or arm == "heavy"
]


def signal(world: World) -> np.ndarray:
    """What the effects move each noise-free reading by, (n, M, 3) m."""
    return world.noise_free(world.visits) - replace(world, effects=()).noise_free(world.visits)


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


def true_values(world: World) -> dict[str, float]:
    """The true arm and its effects, as elastocal's parameters name them."""
    true, nominal = world.specimen.true, world.spec.skeleton
    turn = Rotation.from_matrix(true.base_rotation).as_rotvec()
    rows = [("base", ("x", "y", "z", "rx", "ry", "rz"), [*true.base_position, *turn])]
    for j in range(nominal.n_joints):
        R = nominal.rotation[j + 1].T
        shift = R @ (true.skeleton.position[j + 1] - nominal.position[j + 1])
        turn = Rotation.from_matrix(R @ true.skeleton.rotation[j + 1]).as_rotvec()
        rows.append((f"link{j + 1}", ("dx", "dy", "dz", "rx", "ry", "rz"), [*shift, *turn]))
        elastic = [true.offset[j], true.compliance[j]]
        rows.append((f"joint{j + 1}", ("offset", "compliance"), elastic))
    for name, point in zip(true.marker_names, true.markers, strict=True):
        rows.append((f"marker:{name}", ("x", "y", "z"), list(point)))
    rows += [(e.where, tuple(e.values), list(e.values.values())) for e in world.effects]
    return {f"{p}.{k}": v for p, keys, vs in rows for k, v in zip(keys, vs, strict=True)}


def model_with(
    effects: list[tuple[str, str, dict[str, float]]], world: World, folder: Path
) -> tuple[Model, Measurements]:
    """elastocal's model of the world's cell with effects (name, where, settings) added, and the
    world's noise-free readings."""
    observed = folder / "seen"
    write_world(world, observed, folder / "sealed")
    write_table(world, world.visits, world.noise_free(world.visits), observed / "data.csv")
    kinds = ("revolute",) * world.spec.skeleton.n_joints
    table = read_measurements(observed / "data.csv", joint_kinds=kinds)
    cell = read_cell(observed / "cell.toml")
    added = tuple(EffectChoice(name, where) for name, where, _ in effects)
    nominal = replace(cell.model.nominal, settings={w: s for _, w, s in effects if s})
    spec = replace(cell.model, effects=cell.model.effects + added, nominal=nominal)
    return Model(replace(cell, model=spec)), table


def model_error(world: World, folder: Path) -> np.ndarray:
    """Noise-free readings minus elastocal's prediction at the true values, (n, M, 3) m."""
    model, table = model_with([(e.name, e.where, e.settings) for e in world.effects], world, folder)
    values = true_values(world)
    assert set(values) == set(model.names)
    predicted = model.predict(table, np.array([values[name] for name in model.names]))
    return table.position.reshape(-1, 3, 3) - predicted.reshape(-1, 3, 3)


@pytest.mark.parametrize("arm", ARMS)
def test_a_plain_world_is_what_elastocal_predicts(arm, tmp_path):
    assert np.abs(model_error(Recipe("plain", (5,), arm=arm).draw(), tmp_path)).max() < 1e-7


@pytest.mark.parametrize(("name", "arm"), CASES)
def test_a_catalogue_effect_is_the_one_that_elastocal_knows(name, arm, tmp_path):
    """To 2 % of its own signal; 5 % for hysteresis, whose |τ| elastocal rounds off at zero.

    elastocal rounds the step of backlash too: compared only where the load on the joint is above
    a quarter of its largest.
    """
    world = Recipe(name, (6,), (name,), 1.0, 40, arm=arm).draw()
    error, moved = model_error(world, tmp_path), signal(world)
    if name == "backlash":
        load = np.abs(world.physics.rest(world.visits)[0].load[:, world.effects[0].index])
        error, moved = (x[load > 0.25 * load.max()] for x in (error, moved))
    assert rms(moved) > 1e-6
    assert rms(error) < (0.05 if name == "hysteresis" else 0.02) * rms(moved)


@pytest.mark.parametrize(
    "effect", [pytest.param(e, marks=pytest.mark.long if k else ()) for k, e in enumerate(ALIKE)]
)
def test_an_effect_said_to_be_alike_is_imitated(effect, tmp_path):
    """Its signal, off what the plain cell fits, lies in the rival's span to 2 %."""
    world = Recipe("alike", (15,), (effect,), 1.0, arm="heavy").draw()
    name, _, where = ALIKE[effect].partition(":")
    left = []
    for rivals in ([], [(name, where, world.effects[0].settings)]):
        model, table = model_with(rivals, world, tmp_path)
        B = model.regressor(table).B
        U, size, _ = np.linalg.svd(B / np.linalg.norm(B, axis=0).clip(1e-12), full_matrices=False)
        U = U[:, size > 1e-7]
        moved = signal(world).ravel()
        left.append(rms(moved - U @ (U.T @ moved)))
    assert left[1] < 0.02 * left[0]


@pytest.mark.parametrize("variant", VARIANTS)
def test_noise_is_of_the_kind_and_size_stated(variant):
    rng = np.random.default_rng(11)
    noise = draw_noise(variant, 6, 4.0, rng, level=5e-5)
    points = 4.0 * np.array([0.6, 0.64, 0.48]) + np.zeros((4000, 3, 3))
    error = noise.add(points, rng) - points
    size = np.linalg.norm(error, axis=-1)
    kept = error[size < OUTLIER_SIZE[0]] if variant == "outliers" else error
    assert rms(kept) == pytest.approx(5e-5, rel=0.1)
    assert rms(noise.sigma(points)) == pytest.approx(5e-5)
    far = np.mean(np.abs(error) > 4.5 * noise.sigma(points).max())
    assert (far > 1e-3) == (variant in ("outliers", "heavy_tails"))
    pose = np.repeat(np.arange(2000), 2)
    jitter = noise.jitter(pose, rng)
    together = np.corrcoef(jitter[0::2, 0], jitter[1::2, 0])[0, 1]
    assert together == pytest.approx(1.0 if variant == "shared_scatter" else 0.0, abs=0.1)
    even = np.allclose(jitter.std(axis=0), REPEATABILITY, rtol=0.1)
    assert even == (variant != "joint_pattern")


def test_the_tool_sees_nothing_of_the_truth(tmp_path):
    """Cell and arm are those of the same world without effects; no file names an effect."""
    recipes = [task.recipe for task in tasks("pairs", 12, 1)][:3]
    for world in [r.draw() for r in (*recipes, Recipe("outside", (12,), ("floor_wave",)))]:
        observed, sealed = tmp_path / "seen" / world.name, tmp_path / "sealed" / world.name
        write_world(world, observed, sealed)
        write_world(replace(world, effects=()), tmp_path / "clean", tmp_path / "none")
        assert {p.name for p in observed.iterdir()} == {"arm.urdf", "cell.toml", "data.csv"}
        for name in ("arm.urdf", "cell.toml"):
            assert (observed / name).read_bytes() == (tmp_path / "clean" / name).read_bytes()
        text = "".join(p.read_text() for p in observed.iterdir())
        text = text.replace("gear_ripple_orders", "")  # a key of every cell
        truth = json.loads((sealed / "truth.json").read_text())
        assert len(truth["effects"]) == len(world.effects)
        for effect in truth["effects"]:
            assert effect["effect"] not in text
        assert world.name not in text


@pytest.mark.parametrize(
    "world", [pytest.param("pair-60-018", marks=pytest.mark.long), "pair-60-028"]
)
def test_a_small_effect_is_found_before_a_large_one_that_hides_it(world, tmp_path):
    """Beside 2 mm of a spring that is missing yet a jump of the frame does not lower the error of
    poses left out, nor bending that of a hysteresis; both together do."""
    drawn = named("pairs", 20271215, world).recipe.draw()
    write_world(drawn, tmp_path / "seen", tmp_path / "sealed")
    found = ec.diagnose(tmp_path / "seen" / "cell.toml", tmp_path / "seen" / "data.csv")
    assert found.verdict == "explained"
    assert {(e.effect, e.where) for e in found.effects} == {
        (e.name, e.where) for e in drawn.effects
    }


def test_the_reduction_told_is_that_at_new_poses(tmp_path):
    """Of a small effect the fit's own error is most of that at new poses, before and after."""
    drawn = named("catalogue", 20271310, "gear_second_harmonic-60-000").recipe.draw()
    seen, sealed = tmp_path / "seen", tmp_path / "sealed"
    write_world(drawn, seen, sealed)
    why = ec.diagnose(seen / "cell.toml", seen / "data.csv")
    why.save(tmp_path / "why.json")
    write_extended_cell(seen / "cell.toml", seen / "found.toml", why.effects, why.model_keys)
    answer = json.loads((tmp_path / "why.json").read_text(encoding="utf-8"))
    true = true_reduction(plain_fit(seen), answer, seen / "found.toml", sealed / "fresh.csv")
    (found,) = why.effects
    low, high = found.gap_reduction_ci90
    assert low < true < high and high - low < 0.3
    assert abs(found.gap_reduction - true) < 0.1


def test_a_ripple_that_the_catalogue_lacks_is_an_unknown_effect_of_its_joint(tmp_path):
    """Of so high an order that no smooth function of the angle follows it, and the same whenever
    the arm comes back: it fits as if the joint scattered, twenty times as much as the others."""
    task = named("left_out", 20281401, "gear_ripple-60-x2-000")
    drawn = replace(task.recipe, poses=40).draw()
    seen = tmp_path / "seen"
    write_world(drawn, seen, tmp_path / "sealed")
    why = ec.diagnose(seen / "cell.toml", seen / "data.csv", without=("gear_ripple",))
    assert why.verdict == "unknown_effect" and not why.effects
    assert why.location.where == drawn.effects[0].where and why.location.stage == "transmission"
    assert [(f.effect, f.where) for f in why.fields] == [("gear_spectrum", why.location.where)]


@pytest.mark.long
@pytest.mark.parametrize(("seed", "effect", "corrected_by"), [
    (20281601, "hysteresis", "approach_response"),
    (20281603, "hysteresis", "approach_response"),  # the rows are not in the order of the visits
    (20281603, "encoder_scale", "joint_curve"),  # harmonics imitate it, which the verdict rejects
    (20281604, "gear_ripple", "gear_spectrum"),  # its joint scatters, by less than the instrument
])  # fmt: skip
def test_what_the_catalogue_lacks_is_corrected_without_a_name(tmp_path, seed, effect, corrected_by):
    """At new poses as well as with its name; and what is left out is not found."""
    seen, sealed = tmp_path / "seen", tmp_path / "sealed"
    write_world(named("left_out", seed, f"{effect}-60-x2-000").recipe.draw(), seen, sealed)

    def error(*without):
        why = ec.diagnose(seen / "cell.toml", seen / "data.csv", without=without)
        found = (*why.effects, *why.fields)
        write_extended_cell(seen / "cell.toml", seen / "found.toml", found, why.model_keys)
        fit = ec.identify(seen / "found.toml", seen / "data.csv", test=sealed / "fresh.csv")
        return {f.effect for f in why.fields}, fit.test.rms

    (_, whole), (fields, without) = error(), error(effect)
    assert fields == {corrected_by} and without < 1.1 * whole
    fields, neither = error(effect, corrected_by, "residual_field")
    assert corrected_by not in fields and neither > 1.1 * without


def test_the_world_shares_no_code_with_elastocal():
    for name in WORLD_MODULES:
        for node in ast.walk(ast.parse((FOLDER / f"{name}.py").read_text())):
            used = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            used += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(module.startswith("elastocal") for module in used), name
