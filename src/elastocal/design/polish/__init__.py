"""Continuous improvement of a plan's poses: local search with joint limits and clearances."""
