"""Workers as actors of Ray, driven as those in processes of this machine are."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import ray
import torch
from tensordict import TensorDictBase

from mappo_unity.config.schema import Config
from mappo_unity.training.collection.on_ray.cluster import Cluster
from mappo_unity.training.collection.on_ray.handle import ActorHandle
from mappo_unity.training.collection.processes import RemoteWorkers
from mappo_unity.training.collection.slab import Layout


class RayWorkers(RemoteWorkers):
    """Workers as actors of Ray; see `RemoteWorkers`. What all of them get is put into Ray's store once.

    Raises:
        ConfigError: there is no cluster, or no room for the workers in it.
    """

    def __init__(self, cfg: Config, folder: Path) -> None:
        self._cluster = Cluster(cfg.collect.workers)
        try:
            super().__init__(cfg, folder)
        except BaseException:
            self._cluster.leave()
            raise

    def close(self) -> None:
        """Close all environments, end all actors and leave the cluster."""
        super().close()
        self._cluster.leave()

    def _open(self, number: int, restarts: int) -> ActorHandle:
        return ActorHandle(self._cfg, number, self._folder, restarts)

    def _published(self, data: bytes) -> Any:
        return ray.put(data)

    def _rounds(self, number: int, length: int, where: tuple[Layout, np.ndarray]) -> TensorDictBase:
        layout, block = where
        with warnings.catch_warnings():
            # of Ray's store, and read-only; joining copies it
            warnings.filterwarnings("ignore", "The given NumPy array is not writable")
            return layout.rounds(torch.from_numpy(block), length)
