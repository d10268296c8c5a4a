"""Compares loop detectors on images of places with changes in lighting, viewpoint and scene."""
