"""Studies of other tests are forgotten: at every further one all modules are held against the
folders of all before, which after a hundred tests took half a second each time."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from elastocal.studies import study_folder


@pytest.fixture(autouse=True)
def no_earlier_studies() -> Iterator[None]:
    yield
    if study_folder._FOLDERS:
        study_folder._forget_others()
        study_folder._FOLDERS.clear()
