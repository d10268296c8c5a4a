"""Makes a report of many runs: medians, comparisons of systems, trajectories and error curves."""
