"""Warm starts: networks that begin with the tensors of a run, a checkpoint or an ONNX file."""
