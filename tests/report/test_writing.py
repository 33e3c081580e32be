"""Writing the page: whole or not at all, and with the hashes of what was read."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import pytest

from elastocal.errors import InputError
from elastocal.report.page import write_page

# Writing does not depend on what the figures show, and drawing takes its time.
pytestmark = pytest.mark.usefixtures("no_figures")


def test_inputs_are_hashed(case: Any, tmp_path: Path) -> None:
    data = tmp_path / "data.csv"
    data.write_bytes(b"q1_deg\n1\n")
    write_page(case.result, tmp_path / "r.html", inputs=[data])
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert hashlib.sha256(data.read_bytes()).hexdigest() in text
    with pytest.raises(InputError, match="no such file"):
        write_page(case.result, tmp_path / "other.html", inputs=[tmp_path / "missing.csv"])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["data.csv", "r.html"]


def test_failure_while_writing_leaves_nothing(
    case: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(source: object, target: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full_disk)
    with pytest.raises(InputError, match="cannot be written"):
        write_page(case.result, tmp_path / "r.html")
    assert list(tmp_path.iterdir()) == []
