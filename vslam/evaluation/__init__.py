"""Evaluates trajectories and loop closures against ground truth."""
