"""A report of many runs, with medians, comparisons of systems, trajectories and error curves."""
