"""The files of the worked example, which `elastocal.simulation.run_demo` runs."""
