"""Evaluation of trajectories and loops against a ground truth."""
