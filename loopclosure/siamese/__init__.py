"""Inference, without torch, of Siamese networks that decide whether two images show the same place.

Training code is in :mod:`vslam.loopclosure.training`.
"""
