"""The study.py of a folder of experiment_design as a module of its own name.

Several folders have one: imported as `study`, the second test file would get the first one's.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def study_of(folder: Path) -> ModuleType:
    """study.py of the folder, whose other scripts it can import."""
    name = f"study_of_{folder.name}"
    if name not in sys.modules:
        if str(folder) not in sys.path:
            sys.path.insert(0, str(folder))
        spec = importlib.util.spec_from_file_location(name, folder / "study.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    return sys.modules[name]
