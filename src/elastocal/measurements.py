"""What the user measured: one validated, frozen table in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from elastocal.measurement_columns import column, families

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

SI_UNITS = ("m", "rad", "s", "N", "Nm", "C", "")


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
        """The table with the columns of the canonical CSV, one row per reading, in SI units.

        `joint_kinds`: "revolute" (default for all joints) or "prismatic", which decides q1_rad or
        q1_m.
        """
        import pandas as pd

        known = families(joint_kinds or ("revolute",) * self.q.shape[1])
        blocks: dict[str, np.ndarray | None] = {
            "repeat": self.repeat,
            "q": self.q,
            "force": self.force,
            "position": self.position,
            "rotation": self.rotation,
            "distance": self.distance,
            "torque": self.torque,
            f"sigma_{self.sigma_frame}": self.sigma,
            "time": self.time,
            "approach": None if self.approach is None else self.approach.astype(np.int64),
            "temperature": self.temperature,
        }
        columns: dict[str, object] = {
            "configuration": np.array(self.configuration_labels, dtype=object)[self.configuration],
            "marker": np.array(self.marker_names, dtype=object)[self.marker],
        }
        for name, values in blocks.items():
            if values is None:
                continue
            stems = known[name].units
            for stem, numbers in zip(stems, values.reshape(len(self), len(stems)).T, strict=True):
                unit = next(unit for unit in SI_UNITS if unit in stems[stem])
                columns[column(stem, unit)] = numbers
        return pd.DataFrame(columns, copy=False)

    def _repr_html_(self) -> str:
        """The first and last rows, as notebooks show a data frame."""
        return str(self.to_dataframe()._repr_html_())

    def take(self, index: NDArray | slice) -> Measurements:
        """The rows `index` (integers, mask or slice) as a table of their own; labels are kept."""
        changes = {
            f.name: getattr(self, f.name)[index]
            for f in fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        return replace(self, **changes)
