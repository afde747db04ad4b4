"""Lines with which a fault of faulty_env is trained; scripts/score_doctor.py counts those that are found."""

from __future__ import annotations

import faulty_env

COMMON = [
    *("env=custom", "env.factory=faulty_env:make", "max_steps=30000", "collect.batch_size=1024"),
    *("ppo.minibatch_size=256", "ppo.lr=1e-3", "model.hidden=[32]", "log.loggers=[]", "log.progress=false"),
    *("export_onnx=false", "num_threads=1", "update_threads=1"),
]


def lines_of(fault: str, *more: str) -> list[str]:
    """Return the options of a run with a fault, or with none (""); later ones win."""
    if fault in faulty_env.IN_THE_OPTIONS:
        options = faulty_env.IN_THE_OPTIONS[fault][1]
    else:
        options = [f"env.params.fault={fault}"] if fault else []
        options = [*options, *faulty_env.WITH_OPTIONS.get(fault, [])]
    lines = {line.partition("=")[0]: line for line in [*COMMON, *options, *more]}
    return list(lines.values())
