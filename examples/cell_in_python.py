"""A cell built in Python: no file but the robot's, then what a campaign with it would tell.

The same classes, keys and checks as in a cell file, in SI units.  The KR 270 of the demo stands
three metres from a polar tracker; base, tool and geometry are unknown.
"""

from importlib.resources import files

import numpy as np

import elastocal as ec
from elastocal.cell_tables import ModelSpec, Nominal, PolarNoise

cell = ec.Cell(
    name="KR 270 beside the press",
    robot=ec.Robot.from_urdf(files("elastocal.demo") / "kr270_2.urdf", "base_link", "flange"),
    tool=ec.Tool(
        load_point=[0.20, 0.0, 0.25],  # in the flange frame, as the markers
        markers={"M1": [0.25, 0.0, 0.05], "M2": [-0.12, 0.22, 0.10], "M3": [-0.05, -0.10, 0.25]},
    ),
    tracker=ec.Tracker(
        noise=PolarNoise(range=10e-6, range_per_m=0, transverse=15e-6, transverse_per_m=6e-6)
    ),
    model=ModelSpec(
        effects=["base_frame", "joint_offset", "joint_compliance", "marker_position"],
        nominal=Nominal(base_position=[3.0, 0.5, -0.8]),
    ),
    limits={"joint1": np.radians([-60, 60])},
)
model = ec.Model(cell)
print(model)

home = np.radians([0, -90, 90, 0, 0, 0])
turned = np.random.default_rng(0).uniform(-1, 1, (25, 6)) * np.radians([60, 40, 40, 120, 80, 120])
truth = {"joint2.compliance": 2.9e-7, "joint3.compliance": 4.2e-7, "joint2.offset": 4e-4}
data = ec.simulate(model, home + turned, values=truth, load=[0, 0, -2600], seed=1)
fit = ec.identify(model, data)
for name, value in truth.items():
    found = fit[name]
    print(f"{name:18} true {value:.3e}, found {found.value:.3e} ± {found.std:.1e} {found.unit}")
