"""The arm in MuJoCo whose mechanics share nothing with the model: that of the study."""

import sys
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "experiment_design" / "compensation"
sys.path.insert(0, str(FOLDER))

import elastic_arm  # noqa: E402

MujocoArm = elastic_arm.MujocoArm
