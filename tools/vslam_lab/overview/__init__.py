"""Makes a report that summarises many runs.

The report has medians of the errors, comparisons of systems, trajectories and error curves."""
