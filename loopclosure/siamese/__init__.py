"""Runs Siamese networks, without torch, to decide whether two images show the same place.

Training code is in :mod:`vslam_lab.training`.
"""
