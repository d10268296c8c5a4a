"""Training of the Siamese networks in torch, their pruning and their export to ONNX.

No run needs it: only ``vslam train`` and ``vslam export`` import it. It needs the extra ``train``.
"""
