"""Compare loop detectors on images of places under changes of light, viewpoint and scene."""
