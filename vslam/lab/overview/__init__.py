"""One report of many runs: medians, comparisons of systems, trajectories, strength curves."""
