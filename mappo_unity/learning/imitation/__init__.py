"""Learning from demonstrations: what experts saw and did as tensors, and cloning of it."""
