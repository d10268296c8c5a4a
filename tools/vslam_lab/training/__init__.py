"""Trains the Siamese networks in torch, prunes them, and exports them to ONNX.

Only ``vslam train`` and ``vslam export`` import this package. It needs the optional dependencies
``train`` of vslam.
"""
