"""Every option, as one dataclass field with its type, default and description.

Values are checked when `Config` and its sections are built. This package must stay importable without torch,
so that ``--help`` and errors about options come at once.
"""

from mappo_unity.config.schema.collect import CollectConfig, Engine
from mappo_unity.config.schema.env import BACKENDS, Backend, EnvConfig
from mappo_unity.config.schema.log import LogConfig, LoggerKind, TagKind
from mappo_unity.config.schema.mirror import MirrorConfig, show_mirror, show_numbers
from mappo_unity.config.schema.model import (
    LOG_STD_RANGE,
    Activation,
    CriticKind,
    DistributionKind,
    GoalKind,
    ImageKind,
    MemoryKind,
    ModelConfig,
    WeightInit,
    bounded_log_std,
)
from mappo_unity.config.schema.pages import PlotConfig, ReportConfig, XAxis
from mappo_unity.config.schema.policies import (
    EvalConfig,
    ExportConfig,
    LeagueConfig,
    PlayConfig,
    PullConfig,
    PushConfig,
)
from mappo_unity.config.schema.ppo import (
    AdvantageKind,
    EntropyKind,
    ObjectiveKind,
    ObsNormUpdate,
    Optimizer,
    PPOConfig,
    RatioKind,
    Schedule,
    ValueLoss,
    ValueNormKind,
    ValueNormUpdate,
)
from mappo_unity.config.schema.rewards import (
    BCConfig,
    CuriosityConfig,
    ExtrinsicConfig,
    GAILConfig,
    IntrinsicConfig,
    RewardsConfig,
    RNDConfig,
)
from mappo_unity.config.schema.run import Config, MatmulPrecision
from mappo_unity.config.schema.search import Pruner, SearchConfig, SearchObjective
from mappo_unity.config.schema.self_play import MatchConfig, OpponentDraw, SelfPlayConfig

__all__ = [
    "Activation",
    "AdvantageKind",
    "BACKENDS",
    "BCConfig",
    "Backend",
    "CollectConfig",
    "Config",
    "CriticKind",
    "CuriosityConfig",
    "DistributionKind",
    "Engine",
    "EntropyKind",
    "EnvConfig",
    "EvalConfig",
    "ExportConfig",
    "ExtrinsicConfig",
    "GAILConfig",
    "GoalKind",
    "ImageKind",
    "IntrinsicConfig",
    "LOG_STD_RANGE",
    "LeagueConfig",
    "LogConfig",
    "LoggerKind",
    "MatchConfig",
    "MatmulPrecision",
    "MemoryKind",
    "MirrorConfig",
    "ModelConfig",
    "ObjectiveKind",
    "ObsNormUpdate",
    "OpponentDraw",
    "Optimizer",
    "PPOConfig",
    "PlayConfig",
    "PlotConfig",
    "Pruner",
    "PullConfig",
    "PushConfig",
    "RNDConfig",
    "RatioKind",
    "ReportConfig",
    "RewardsConfig",
    "Schedule",
    "SearchConfig",
    "SearchObjective",
    "SelfPlayConfig",
    "TagKind",
    "ValueLoss",
    "ValueNormKind",
    "ValueNormUpdate",
    "WeightInit",
    "XAxis",
    "bounded_log_std",
    "show_mirror",
    "show_numbers",
]
