"""How a player is started."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mappo_unity.config.parameters.samplers import Value


@dataclass
class PlayerOptions:
    """How to start a player; `executable` None waits for the Unity Editor on `port`."""

    executable: Path | None
    log_file: Path
    port: int = 0
    timeout_s: float = 60.0
    arguments: list[str] = field(default_factory=list)
    no_graphics: bool = False
    num_areas: int = 1
    parameters: dict[str, Value] = field(default_factory=dict)
    engine: dict[str, Any] = field(default_factory=dict)
    """Arguments of EngineConfigurationChannel.set_configuration_parameters."""

    @property
    def own_log_file(self) -> Path | None:
        """The log that `arguments` choose in place of `log_file`."""
        pairs = zip(self.arguments, self.arguments[1:])
        return next((Path(path) for name, path in pairs if name.lower() == "-logfile"), None)

    def command_line(self, port: int) -> list[str]:
        """Return the arguments of the player's command line, with the port that it is to connect to."""
        arguments = ["-nographics", "-batchmode"] if self.no_graphics else []
        arguments += ["--mlagents-port", str(port)]
        if self.own_log_file is None:
            arguments += ["-logFile", str(self.log_file)]

        return arguments + self.arguments
