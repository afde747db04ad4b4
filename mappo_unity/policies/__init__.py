"""Trained policies: loaded, played, evaluated, shown and exported.

In: checkpoints, ONNX files, environments. Out: figures, videos, ONNX files. Knows nothing of training.
"""
