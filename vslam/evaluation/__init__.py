"""Evaluation of trajectories and loop closures against ground truth."""
