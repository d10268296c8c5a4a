"""Image sources for training and for comparing loop detectors."""
