"""Tensors copied by name and shape into networks, and what is said of each."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

_WRAPPERS = re.compile(r"^(module\.|0\.)+")  # TorchRL's modules around a network, before the names of its own


class Row(NamedTuple):
    """What became of a tensor; `reason`: why it was skipped, "" where it was copied."""

    name: str
    shape: tuple[int, ...] | None
    reason: str = ""


@torch.no_grad()
def copy_fitting(
    net: nn.Module, label: str, tensors: Mapping[str, Tensor], misfits: Mapping[str, str]
) -> list[Row]:
    """Copy the tensors whose name and shape fit those of a network; return a row for each of its own.

    Args:
        net: what is copied into.
        label: what its tensors are called in the rows.
        tensors: by the names of the network's `state_dict`.
        misfits: beginnings of names, and why such ones are not among the tensors.
    """
    own = {name: value for name, value in net.state_dict().items() if value.numel()}
    reasons = {name: _why_not(name, value, tensors, misfits) for name, value in own.items()}

    # the parts of a normaliser belong together: its count would fit any other, too
    for name in [name for name, reason in reasons.items() if reason and name.endswith(".mean")]:
        stem = name.removesuffix("mean")
        reasons |= {other: reasons[name] for other in own if other in (f"{stem}var", f"{stem}count")}

    for name, value in own.items():
        if not reasons[name]:
            value.copy_(tensors[name])
    return [
        Row(f"{label}.{_WRAPPERS.sub('', name)}", tuple(value.shape), reasons[name])
        for name, value in own.items()
    ]


def _why_not(name: str, value: Tensor, tensors: Mapping[str, Tensor], misfits: Mapping[str, str]) -> str:
    if name not in tensors:
        told = [reason for start, reason in misfits.items() if name.startswith(start)]
        return told[0] if told else "there is none of that name"
    if tensors[name].shape != value.shape:
        return f"there it is {_shape(tuple(tensors[name].shape))}"
    return ""


def table(rows: Sequence[Row]) -> list[str]:
    """Return lines that say of each tensor whether it was copied, and why not."""
    shapes = ["" if row.shape is None else _shape(row.shape) for row in rows]
    width, wide = max(len(row.name) for row in rows), max(map(len, shapes))
    lines = []
    for row, shape in zip(rows, shapes):
        what = "skipped" if row.reason else "copied"
        lines.append(f"  {what:7}  {row.name:{width}}  {shape:{wide}}  {row.reason}".rstrip())
    return lines


def _shape(shape: tuple[int, ...]) -> str:
    return f"[{', '.join(map(str, shape))}]"
