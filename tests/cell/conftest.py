"""A cell file beside empty files of every kind, read or refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from elastocal.cell.work_cell import Cell, read_cell
from elastocal.errors import InputError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("arm.urdf", "dh.csv", "links.csv", "path.csv", "part.stl", "fixture.stl"):
        (tmp_path / name).write_text("content is read by others")
    return tmp_path


@pytest.fixture
def read(folder: Path) -> Callable[..., Cell]:
    def read(text: str | bytes, **options) -> Cell:
        data = text if isinstance(text, bytes) else text.encode()
        (folder / "cell.toml").write_bytes(data)
        return read_cell(folder / "cell.toml", **options)

    return read


@pytest.fixture
def refusal(read: Callable[..., Cell]) -> Callable[..., str]:
    """The message with which a text is refused; it must name the file, on one line."""

    def refusal(text: str | bytes, **options) -> str:
        with pytest.raises(InputError) as caught:
            read(text, **options)
        message = str(caught.value)
        assert "cell.toml" in message
        assert "\n" not in message
        return message

    return refusal
