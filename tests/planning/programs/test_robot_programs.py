"""Robot programs: what they move to is what was planned, in the controllers' own syntax."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.cells import kr270_cell, kr270_chain, random_poses
from support.discs import Discs

from elastocal.cell_tables import Motion
from elastocal.messages import ElastocalError, InputError
from elastocal.model.chain import Chain, joint_limits
from elastocal.planning.execution import schedule
from elastocal.saving import (
    RESERVED,
    check_program,
    program_name,
    program_steps,
    robot_program,
    steps_of,
)

FORCES = np.array([[0.0, 0, 0], [0, 0, -2600.0]])
HOME = np.radians([0.0, -90, 90, 0, 45, 0])
NAMES = [f"c{i}" for i in range(1, 6)]
LIMITS = joint_limits(kr270_cell(), kr270_chain())


def written(suffix, execution, chain, names=NAMES, limits=LIMITS):
    return robot_program(suffix, execution, chain, names, FORCES, limits, "plan")


KRL, URSCRIPT = (partial(written, suffix) for suffix in (".src", ".SCRIPT"))


@pytest.fixture(scope="module")
def chain():
    return kr270_chain()


def execution_of(chain, **motion):
    q = random_poses(chain, 5, seed=1)
    limits = np.full(6, -9.0), np.full(6, 9.0)
    return schedule(q, Motion(**motion), Discs(), loads=FORCES, limits=limits)


def planned(execution):
    home = execution.motion.home
    moves = [] if home is None else [home]
    for stop in execution.stops:
        moves += [*stop.via, stop.q]
    return np.array(moves if home is None else [*moves, *execution.home_via, home])


@pytest.mark.parametrize("write", [KRL, URSCRIPT])
def test_the_text_is_the_same_every_time_and_names_cannot_break_it(chain, write):
    execution = execution_of(chain)
    assert write(execution, chain) == write(execution, chain)
    evil = ['"; HALT', "a\nEND", 'b")\nend', "Höhe µ", "\x00"]
    text = write(execution, replace(chain, name='r"\nEND'), evil)
    assert text.isascii()
    ours = write(execution, chain)
    assert text.count("\n") == ours.count("\n") and text.count('"') == ours.count('"')


@pytest.mark.parametrize("write", [KRL, URSCRIPT])
def test_other_arms_than_six_revolute_joints_are_refused(chain, write):
    execution = execution_of(chain)
    seven = Chain("seven", (*chain.joints, chain.joints[0]), np.eye(4))
    sliding = replace(chain, joints=(replace(chain.joints[0], kind="prismatic"), *chain.joints[1:]))
    with pytest.raises(InputError, match="has 7"):
        write(execution, seven)
    with pytest.raises(InputError, match=f"joint {chain.joints[0].name} slides"):
        write(execution, sliding)


@given(
    st.text()
    | st.sampled_from(
        ["", "1plan", "my plan", "a" * 25, "plän", "a\nb", "END", "p", "A" * 23 + ":0"]
    )
)
def test_any_name_is_reduced_to_one_that_both_languages_allow(name):
    reduced = program_name(name)
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,23}", reduced, re.ASCII)
    assert reduced.lower() not in RESERVED
    assert program_name(reduced) == reduced


@pytest.mark.parametrize("write", [KRL, URSCRIPT])
def test_a_joint_value_outside_the_limits_is_refused(chain, write):
    execution = execution_of(chain)
    beyond = replace(execution.stops[2], q=execution.stops[2].q + np.array([0, 0, 9.0, 0, 0, 0]))
    stops = (*execution.stops[:2], beyond, *execution.stops[3:])
    for wrong in (
        replace(execution, stops=stops),
        replace(execution, stops=(replace(beyond, q=np.full(6, np.nan)),)),
    ):
        with pytest.raises(InputError, match=r"moves joint \d to .*, outside its limits"):
            write(wrong, chain)
    tight = np.full(6, -1e-3), np.full(6, 1e-3)
    with pytest.raises(InputError, match="outside its limits"):
        write(execution, chain, limits=tight)


@pytest.mark.parametrize("write", [KRL, URSCRIPT])
def test_a_program_read_back_is_the_plan_to_a_millionth_of_a_radian(chain, write):
    execution = execution_of(chain, home=HOME, both_directions=True)
    lower, upper = (f(planned(execution), axis=0) for f in (np.min, np.max))
    text = write(execution, chain, limits=(lower, upper))
    check_program(text, steps := steps_of(execution, NAMES, FORCES))
    moves = np.array([values for kind, values in program_steps(text) if kind == "move"])
    assert np.abs(moves - planned(execution)).max() < 1e-7
    assert ((lower <= moves) & (moves <= upper)).all()
    move = next(line for line in text.splitlines() if re.search(r"[\[{].*-?\d\.\d{3}", line))
    digit = re.search(r"\d\.\d{3}", move).end() - 1
    moved = move[:digit] + str((int(move[digit]) + 5) % 10) + move[digit + 1 :]
    wait = next(line for line in text.splitlines() if "WAIT" in line or "sleep" in line)
    for wrong in (
        text.replace(move, moved, 1), text.replace(move + "\n", "", 1),
        text.replace(wait, f"{wait}\n{move}", 1), text.replace(wait, wait.replace("30", "31"), 1),
        text.replace(wait, f"{wait}\n$OV_PRO = 100", 1), text + "set_digital_out(0, True)\n",
    ):  # fmt: skip
        assert wrong != text
        with pytest.raises(ElastocalError, match="do not run it"):
            check_program(wrong, steps)
