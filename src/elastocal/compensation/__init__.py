"""Commands that put the real tool where the nominal arm was told to go."""
