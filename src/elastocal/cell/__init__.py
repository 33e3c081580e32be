"""The cell: what the user has (robot, tool, tracker, model, workspace) and asks of a plan.

A cell is read from a TOML file, `Cell.read("cell.toml")`, or built in Python from the same classes
in SI units.  Either way it is checked once and then frozen.
"""
