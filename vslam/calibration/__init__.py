"""Cameras as they are: distortion, where two of them stand, and images rectified on the way in."""
