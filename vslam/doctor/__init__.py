"""Checks of images, calibration and timestamps before a run.

Each check gives a verdict, and a fix if there is a fault.
"""
