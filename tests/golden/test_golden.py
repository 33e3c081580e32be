"""The contract: what commands and the front door print, write and return is what it was."""

import os

import numpy as np
import pytest
from golden import runner
from golden.goldens import GOLDENS

WHOLE_SEARCH = True  # goldens hold the plans that the commands find


@pytest.mark.parametrize("name", GOLDENS)
def test_golden(name: str) -> None:
    golden = GOLDENS[name]
    if golden.needs and not os.environ.get(golden.needs):
        pytest.skip(f"{golden.needs} is unset")
    tested = f"numpy=={np.__version__}\n" in (runner.ROOT / "constraints.txt").read_text("utf-8")
    if golden.tied and not tested:
        pytest.skip(f"rounding decides between poses in two orders; numpy is {np.__version__}")
    told = runner.compare(name, golden, runner.run(golden))
    if told:
        pytest.fail(runner.report(name, golden, told), pytrace=False)
