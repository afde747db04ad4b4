"""The states of the global random generators, as checkpoints hold them."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch


def seed_everything(seed: int) -> None:
    """Seed torch's, numpy's and Python's global generators."""
    random.seed(seed)
    # numpy takes 32 bits of seed at most.
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def get_rng_state() -> dict[str, Any]:
    """Return the states of torch's, numpy's and Python's global generators, and of the GPUs' in use."""
    kind, keys_, position, has_gauss, cached = np.random.get_state()
    version, internal, gauss_next = random.getstate()

    return {
        "torch": torch.get_rng_state(),
        # asking would start every GPU, and take memory of it
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],
        "numpy": [
            str(kind),
            np.asarray(keys_).astype(np.int64),
            int(position),
            int(has_gauss),
            float(cached),
        ],
        "python": [int(version), list(internal), gauss_next],
    }


def set_rng_state(state: dict[str, Any]) -> None:
    """Go back to what `get_rng_state` returned."""
    torch.set_rng_state(state["torch"])
    if torch.cuda.is_initialized():
        # a run may go on where there are fewer GPUs, or more
        for index, generator in zip(range(torch.cuda.device_count()), state["cuda"]):
            torch.cuda.set_rng_state(generator, index)

    kind, keys_, position, has_gauss, cached = state["numpy"]
    np.random.set_state((kind, np.asarray(keys_).astype(np.uint32), position, has_gauss, cached))

    version, internal, gauss_next = state["python"]
    random.setstate((version, tuple(internal), gauss_next))
