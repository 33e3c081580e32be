"""The symbolic manipulator: nominal chain, effects on it, exact B, fast batch evaluation."""
