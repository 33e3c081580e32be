"""The study.py of a folder of experiment_design as a module of its own name.

Several folders have one: imported as `study`, the second test file would get the first one's.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any


def study_of(folder: Path) -> Any:
    """study.py of the folder, whose other scripts it can import."""
    spec: Any = importlib.util.spec_from_file_location(f"{folder.name}_study", folder / "study.py")
    sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
