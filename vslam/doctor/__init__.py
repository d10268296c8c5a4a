"""What to look at before a run: images, calibration and times, each with a verdict and a fix."""
