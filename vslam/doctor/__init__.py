"""Checks of images, calibration and timestamps before a run, each with a verdict and a fix."""
