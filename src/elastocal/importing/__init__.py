"""Exports of trackers and robot controllers → the measurement table."""
