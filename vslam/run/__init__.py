"""Runs SLAM over a sequence: prepares, tracks and records the frames, and collects the results."""
