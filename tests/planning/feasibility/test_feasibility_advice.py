"""When nothing is feasible: the rule to relax, what that frees, and what is in the way."""

import re

from planning.feasibility.small_cells import (
    DOWN,
    KR270_CHAIN,
    NOTHING,
    box,
    freed_by,
    kr270_poses,
    sphere,
)
from planning.feasibility.test_margins_of_pairs import kr270_cell
from planning.feasibility.test_single_rules import full_cell

from elastocal.planning.feasibility import Feasibility


def advised(given, q, force=NOTHING):
    rules = Feasibility(given, KR270_CHAIN)
    verdict = rules.check(q, force)
    return rules, verdict, rules.advice(verdict)


def test_dropping_the_advised_rule_frees_as_many_as_it_says():
    q = kr270_poses(3000)
    rules, verdict, text = advised(full_cell(), q, DOWN)
    name, count = re.search(r"relax '(\w+)', which alone stops (\d+)", text).groups()
    assert int(count) == max(freed_by(verdict).values()) == freed_by(verdict)[name]
    rules.rules = tuple(rule for rule in rules.rules if rule.name != name)
    assert rules.check(q, DOWN).ok.sum() - verdict.ok.sum() == int(count)
    assert f"{verdict.ok.sum()} of 3000" in text


def test_an_obstacle_that_swallows_the_robot_is_named():
    swallowed = kr270_cell(
        obstacles=(box("pallet", (4, 4, 4), (0, 0, 1)), sphere("x", 0.1, (3, 0, 0)))
    )
    rules, verdict, text = advised(swallowed, kr270_poses(500))
    assert not verdict.ok.any()
    assert "'obstacle'" in text and "link1 and pallet" in text
    assert '["link1", "pallet"]' in text and "[workspace] ignored_pairs" in text
    assert ("link1", "pallet") in rules.always_in_contact
