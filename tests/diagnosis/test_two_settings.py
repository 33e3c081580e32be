"""Effects with several settings are searched over all of them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from support.cells import kr270_chain
from support.diagnosis_data import VISIT_TIME, Fault, cell, measured, plan
from support.registered import forgotten, write_example

from elastocal.diagnosis.diagnose import diagnose
from elastocal.measurements import Measurements
from elastocal.model.manipulator import Model
from elastocal.plugin_loader import load_plugins

FROM, TIME = 900.0, 400.0
SETTLED = Fault(
    "settling_joint", "joint3", {"settled": 3e-4},
    {"settling_from_s": FROM, "settling_time_s": TIME},
)  # fmt: skip


@pytest.fixture(scope="module")
def readings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Model, Measurements]]:
    """A joint that gave way after 900 s, and the model that does not have it."""
    folder = tmp_path_factory.mktemp("plugins")
    with forgotten():
        load_plugins(None, [str(write_example(folder, "settling_joint.py"))])
        chain, plain = kr270_chain(), cell()
        table = measured(chain, plain, [SETTLED], plan(chain, 40, 1), 1)
        yield Model.assembled(chain, plain), table


def test_it_is_found_with_both_of_its_settings(readings) -> None:
    why = diagnose(*readings)
    assert why.verdict == "explained"
    (found,) = why.effects
    assert (found.effect, found.where) == SETTLED.key
    assert abs(found.settings["settling_from_s"] - FROM) < 6 * VISIT_TIME
    assert found.settings["settling_time_s"] == pytest.approx(TIME, rel=0.5)
    (settled,) = found.parameters
    assert abs(settled.value - 3e-4) < 4 * settled.std
