"""Covariances and intervals of a least-squares fit, under different assumptions on the errors."""
