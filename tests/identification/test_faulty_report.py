"""What is wrong with the readings, as the result of `identify` reports it."""

from dataclasses import replace

import numpy as np
import pytest
from identification.test_methods import campaign

from elastocal.identification.identify import identify
from elastocal.identification.options import Options


def shifted(table, rows, by):
    position = table.position.copy()
    position[rows] += by
    return replace(table, position=position)


@pytest.mark.parametrize("effect", [0.0, 1e-4])
def test_a_block_of_lines_is_one_finding(effect):
    """Eight lines off by 3 mm, under noise of 50 µm with and without a shared deviation."""
    model, table, _ = campaign(1, effect=effect)
    order = np.argsort(table.configuration, kind="stable")
    table = replace(table.take(order), row=np.arange(len(table)) + 2)
    rows = np.arange(36, 44)
    result = identify(model, shifted(table, rows, [0.0, 3e-3, 0.0]), Options(noise="auto"))
    report = result.faulty_report
    lines = sorted(line for f in report.findings for line in f.lines)
    assert lines == [int(r) + 2 for r in rows]
    assert [o.line for o in result.excluded] == lines
    largest = report.findings[0]
    assert largest.level in ("block", "configuration") and largest.pattern == "common"
    assert largest.influence > 1 and largest.p_value < 0.01
    # 3 mm over 50 µm is 60; where deviations are shared, the best guess of this one is taken off.
    assert 5 < largest.sigmas < 100


def test_a_third_of_the_table_that_one_shift_explains_is_set_apart_and_named():
    """Unlike errors of as many would be kept; kept readings are reported alike."""
    model, table, _ = campaign(3)
    rows = np.flatnonzero(table.configuration < 4)
    wrong = shifted(table, rows, [0.0, 0.0, 4e-3])
    for faulty in ("auto", "keep"):
        result = identify(model, wrong, Options(faulty=faulty))
        told = result.excluded if faulty == "auto" else result.outliers
        assert {o.line for o in told} == set(table.row[rows]) and len(result.faulty) == len(told)
        lines = {line for f in result.faulty_report.findings for line in f.lines}
        assert lines == {int(r) for r in table.row[rows]}
