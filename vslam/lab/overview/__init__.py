"""One report of many runs: medians, loop detectors compared, trajectories, strength curves."""
