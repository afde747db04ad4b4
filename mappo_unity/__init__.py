"""Train multi-agent policies (MAPPO) on Unity ML-Agents environments."""

__version__ = "0.1.0"
