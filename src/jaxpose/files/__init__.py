"""Files of runs and of other programs."""
