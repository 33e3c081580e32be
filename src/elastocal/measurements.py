"""What the user measured: one validated, frozen table in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Measurements:
    """n rows: one per pose, load state, repeat and marker.

    `q` (n, joints) rad or m; `position` (n, 3) m in the tracker frame (z vertical);
    `force` (n, 3) N in the tracker frame at the load point; `rotation` (n, 3) rotation
    vector in rad; `distance` (n,) m; `torque` (n, joints) N m; `sigma` (n, 3) m along
    x, y, z ("cartesian") or range, azimuth, elevation ("polar", transverse lengths);
    `time` (n,) s; `approach` (n, joints) in {-1, 0, +1}; `temperature` (n,) °C.
    `configuration` and `marker` are integer codes into their label tuples; `row` is the
    line number in the source file, for messages.
    """

    source: str
    row: IntArray
    q: Array
    configuration: IntArray
    configuration_labels: tuple[str, ...]
    repeat: IntArray
    marker: IntArray
    marker_names: tuple[str, ...]
    force: Array
    position: Array | None = None
    rotation: Array | None = None
    distance: Array | None = None
    torque: Array | None = None
    sigma: Array | None = None
    sigma_frame: str = "cartesian"
    time: Array | None = None
    approach: Array | None = None
    temperature: Array | None = None

    def __len__(self) -> int:
        return len(self.row)

    def to_dataframe(self, joint_kinds: Sequence[str] | None = None) -> pd.DataFrame:
        """The table with the columns of the canonical CSV: SI units, which stand in the names.

        `joint_kinds`: "revolute" (default for all joints) or "prismatic".
        """
        from elastocal.measurement_frame import frame_of

        return frame_of(self, joint_kinds)

    def _repr_html_(self) -> str:
        """The first and last rows, as notebooks show a data frame."""
        return str(self.to_dataframe()._repr_html_())

    def take(self, index: NDArray) -> Measurements:
        """The rows `index` (integers or a mask) as a table of their own; labels are kept."""
        changes = {
            f.name: getattr(self, f.name)[index]
            for f in fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        return replace(self, **changes)
