"""The study that docs/studies.md shows is a study, and runs."""

import re
from pathlib import Path

from support.study_folders import run_study, write_study

from elastocal.studies import read_results, read_study

PAGE = Path(__file__).parents[2] / "docs" / "studies.md"


def test_the_study_shown_runs(tmp_path):
    text = PAGE.read_text(encoding="utf-8")
    script = re.search(r"```python\n(.*?)```", text, re.S).group(1)
    toml = re.search(r"```toml\n(.*?)```", text, re.S).group(1)
    folder = write_study(tmp_path / "repeats", script, toml)
    ending = run_study(folder, tmp_path / "r", only=1)
    assert (ending.done, ending.failed) == (1, 0)
    frame = read_results(tmp_path / "r")
    assert frame["error"].abs().max() < 1.0  # µrad/(N·m)
    assert read_study(folder).module.summary(frame).startswith("| readings per pose |")
