"""Packages that are imported where they are needed, and what to say where one is missing."""

from __future__ import annotations

import importlib
from typing import Any

from mappo_unity.config.extras import install_command
from mappo_unity.errors import ConfigError

PER_MEMBER = (
    "a policy with a network for each member of a team cannot be exported: Unity's Agents of a behavior "
    "share one model; train with model.share_parameters=true"
)


class ExportError(ConfigError):
    """A policy cannot be exported; the message says which part of it, or what is missing."""


def import_package(name: str) -> Any:
    """Return the package onnx or onnxruntime.

    Raises:
        ExportError: it is not installed; names the extra that brings it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ExportError(
            f"the package {name} is needed for ONNX files, but cannot be imported ({error}): "
            f"{install_command('export')}"
        ) from error
