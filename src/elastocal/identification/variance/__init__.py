"""Noise models whose variances are estimated from the residuals, and intervals that know it."""
