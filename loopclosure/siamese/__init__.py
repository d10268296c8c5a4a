"""Siamese networks that tell whether two images show one place, as runs ask them: without torch.

Their training is in :mod:`vslam.loopclosure.training`.
"""
