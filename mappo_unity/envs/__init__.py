"""Environments: any BaseEnv as a TorchRL environment of batched slots.

In: options, a BaseEnv. Out: TensorDicts, one entry a behavior. Knows nothing of learning.
"""
