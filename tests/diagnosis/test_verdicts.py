"""Verdicts on small tables whose answer is known: no more is claimed than they carry."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import elastocal as ec
from elastocal import Diagnosis
from elastocal.cell_tables import EffectChoice
from elastocal.export.exportable import keep
from elastocal.measurements import in_any_order
from elastocal.model.calibrated import Conditions
from elastocal.model.effects.catalogue import CATALOGUE, effect_of

CASES = Path(__file__).parents[1] / "cases"


@cache
def diagnosed(case: str, **options: Any) -> Diagnosis:
    return ec.diagnose(CASES / case / "cell.toml", CASES / case / "train.csv", **options)


@pytest.mark.long
def test_what_imitates_a_withheld_effect_of_many_is_not_sure() -> None:
    """What stands in for an arm's weights leaves more than the noise, and is no name above 0.9."""
    whole = Path(__file__).parents[1] / "golden" / "inputs" / "whole"
    weights = ("link_mass_error", "gravity_sag", "link_weights")
    why = ec.diagnose(whole / "cell.toml", whole / "data.csv", without=weights)
    assert why.verdict == "unknown_effect" and why.gap.unexplained > why.gap.noise_floor
    assert max(e.probability for e in why.effects) < 0.9


def test_noise_of_poses_is_nothing() -> None:
    why = diagnosed("pose_noise_claimed")
    assert why.verdict == "nothing_significant" and not why.effects
    assert "measure more poses" in why.findings[0].remedy  # nothing would have been seen
    assert why.probability_nothing > max(c.probability for c in why.candidates)


def test_a_gap_of_twelve_times_the_noise_is_not_nothing() -> None:
    """A joint jumped, and no effect that jumps is in the catalogue; errors add up."""
    why = diagnosed(
        "jump_untimed", without=tuple(n for n in CATALOGUE if "jump" in n or "slip" in n)
    )
    gap = why.gap
    assert why.verdict == "unknown_effect" and why.probability_nothing < 0.02
    left = (gap.explained**2 - gap.noise_floor**2) ** 0.5
    assert max(5 * gap.noise_floor, 0.5 * left) < gap.unexplained < 1.05 * left


def test_readings_of_a_loaded_arm_that_lies_are_told() -> None:
    """A camera whose y points down: weights act along −z of its frame, the base says −y is up."""
    cell = CASES / "without_ignored" / "cell.toml"
    table = ec.Model(cell).read(cell.with_name("train.csv"))
    loads = np.tile([0, 0, -50.0], (len(table), 1))
    camera = replace(table, position=table.position[:, [0, 2, 1]] * [1, -1, 1], force=loads)
    (told,) = (text for text in ec.identify(cell, camera).warnings if "−y" in text)
    assert "−y of that frame points up" in told


@pytest.mark.parametrize("night", [None, 0.0, 86400.0])
def test_a_jump_is_found_by_the_rows_or_by_times_of_readings(night, tmp_path: Path) -> None:
    """Between configurations 33 and 34; its cell fits, and holds after it, whatever times say."""
    case = CASES / "jump_untimed"
    table = ec.Model(case / "cell.toml").read(case / "train.csv")
    late = replace(table.take(table.row > 101), time=60.0 * np.arange(80))
    time = None if night is None else 60.0 * table.row + night * (table.row > 100)
    why = ec.diagnose(case / "cell.toml", replace(table, time=time))
    (jump,) = why.effects
    assert (why.verdict, jump.effect, jump.where) == ("explained", "encoder_jump", "joint3")
    assert jump.gap_reduction_ci95[0] > 0.6
    if night is None:
        assert 98 < jump.settings["jump_time_s"] < 101 and why.model_keys == {"clock": "rows"}
        why.save(tmp_path / "found.toml")
        fit = ec.identify(tmp_path / "found.toml", table, test=late)
        assert fit.test is not None and fit.test.rms < 1.2 * fit.heldout_rms
        assert not keep(fit.arm, False, Conditions()).omissions
    fit = ec.identify(case / "cell.toml", case / "train.csv")
    assert "as after a jump: ask diagnose" in fit.finding("faulty_readings").remedy


@pytest.mark.parametrize("what", ["link_jump:link2.jump_x", "tool_jump:tool.jump_y"])
def test_what_happened_between_two_days_is_named(what: str) -> None:
    """Among more visits than changes are searched between at first."""
    plain, (effect, where) = ec.Model(CASES / "jump_untimed" / "cell.toml"), what.split(":")
    place, _, _ = where.partition(".")
    true = plain.specified(plain.cell.model.with_effect(effect, place, {"jump_time_s": 74.5}))
    q = plain.table(np.random.default_rng(4).uniform(-1.0, 1.0, (150, 6)))
    timed = ec.simulate(true, replace(q, time=np.arange(150.0)), values={where: 3e-3}, seed=1)
    (jump,) = ec.diagnose(plain, replace(timed, time=None)).effects
    assert jump.effect == effect and jump.settings["jump_time_s"] == pytest.approx(225.5, abs=1)


def test_in_a_sorted_table_a_step_is_no_jump() -> None:
    """What changes from row to row there may be the pose."""
    case = CASES / "jump_untimed"
    table = ec.Model(case / "cell.toml").read(case / "train.csv")
    assert in_any_order(table.take(np.repeat(np.arange(len(table)), 2)))  # each pose twice
    by_joint_1 = np.lexsort((table.configuration, table.q[:, 0]))
    moved = replace(table.take(by_joint_1), row=table.row, move=None, direction=None)
    why = ec.diagnose(case / "cell.toml", moved)
    assert why.verdict == "unknown_effect" and "jump" not in str([c.effect for c in why.candidates])


def test_what_only_the_prior_holds_of_a_cause_is_no_number() -> None:
    """Masses wrong at four links: gravity shows one moment of each, and that well."""
    arm = ec.Model(CASES.parents[1] / "experiment_design/blind_diagnosis/example/cell.toml")
    true = arm.with_effects((*arm.cell.model.effects, EffectChoice("link_mass_error")))
    values = {f"link{k}.moment_z": 4.0 for k in range(3, 7)}
    table = ec.simulate(true, arm.read(arm.cell.path.with_name("data.csv")), values=values)
    told = {p.name: p for e in ec.diagnose(arm, table).effects for p in e.parameters}
    known = {name: p for name, p in told.items() if p.std < np.inf}
    assert values.keys() <= known.keys() < told.keys()
    assert all(abs(p.value - values.get(n, 0.0)) < 4 * p.std for n, p in known.items())


def test_no_weight_bends_an_upright_first_joint() -> None:
    """Its size would be free: nothing moves, and anything of its shape would be explained."""
    model = ec.Model(CASES / "jump_untimed" / "cell.toml")
    sag = effect_of("gravity_sag")
    assert not sag.acts("joint1", model.chain, model.cell)
    assert all(sag.acts(f"joint{j}", model.chain, model.cell) for j in range(2, 6))
