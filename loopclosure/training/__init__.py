"""Training of the Siamese networks in torch, their pruning and their export to ONNX.

Only ``vslam train`` and ``vslam export`` import this package. It needs the extra ``train``.
"""
