"""Siamese networks that decide whether two images show the same place: inference without torch.

Training is in :mod:`vslam.loopclosure.training`.
"""
