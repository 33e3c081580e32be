"""Measurement plans: criteria, certified relaxation, exchange, polish, feasibility, order."""
