"""Simulated measurements."""
