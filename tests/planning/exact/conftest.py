"""Small pools with a known best plan are those of the study."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3] / "experiment_design" / "exact_quality"))
