"""The worked example of Klimchik et al. 2013: its files, and `example`, which runs it."""
