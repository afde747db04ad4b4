"""Workers in processes of this machine, which write their rounds into memory that the learner sees."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from mappo_unity.config.schema import Config
from mappo_unity.training.collection.processes import RemoteWorkers
from mappo_unity.training.collection.slab import Layout, SharedBytes, make_layout
from mappo_unity.training.collection.worker_handle import WorkerProcess
from mappo_unity.training.collection.worker_process import SLAB, SPACE

ROOM = 2
"""Rounds that shared memory has room for, in units of the first batch; unused pages take no memory."""

_Slabs = dict[int, tuple[Layout, SharedBytes]]  # by their capacity


class WorkerProcesses(RemoteWorkers):
    """Workers in processes of this machine; see `RemoteWorkers`."""

    def __init__(self, cfg: Config, folder: Path) -> None:
        self._slabs: tuple[_Slabs, _Slabs] = ({}, {})
        self._written: dict[int, int] = {}  # capacity of the memory that each worker wrote its batch to
        super().__init__(cfg, folder)

    def close(self) -> None:
        """Close all environments, end all processes and free the memory."""
        super().close()
        for slabs in self._slabs:
            for _, block in slabs.values():
                block.close()
            slabs.clear()

    def _open(self, number: int, restarts: int) -> WorkerProcess:
        return WorkerProcess(self._cfg, number, self._folder, restarts)

    def _rounds(self, number: int, length: int, where: int) -> TensorDictBase:
        self._written[number] = where
        layout, block = self._slabs[self._set][where]
        return layout.rounds(block.bytes, length, number)

    def _side_by_side(self, lengths: list[int]) -> TensorDictBase | None:
        if len(set(lengths)) > 1 or len(set(self._written.values())) > 1:
            return None
        layout, block = self._slabs[self._set][self._written[0]]
        return layout.rounds(block.bytes, lengths[0])

    def _answer(self, number: int) -> Any:
        """Return a worker's answer, and give it memory where it asks for that."""
        kind, content = self.processes[number].receive()
        if kind == SPACE:
            length, rows = content
            slabs = self._slabs[self._set]
            capacity = max(slabs, default=0)
            if capacity < length:
                # smaller memory stays: others may write to it
                capacity = ROOM * length
                layout = make_layout(rows, self.parts, capacity)
                slabs[capacity] = layout, SharedBytes(layout.size)
                if self._cfg.device != "cpu":
                    slabs[capacity][1].pin()
            layout, block = slabs[capacity]
            self.processes[number].send(SLAB, block.path, layout)
            kind, content = self.processes[number].receive()
        return content
