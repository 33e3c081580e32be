"""The symbolic manipulator: nominal chain, effects on it, exact B_i for whole tables."""
