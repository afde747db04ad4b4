"""Options of the commands that play policies or hand them on: mappo-eval, -league, -play, -export, -hub."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Optional

from mappo_unity.config.schema.checks import above, at_least, at_most, not_empty, rule, within
from mappo_unity.errors import ConfigError


@dataclass
class EvalConfig:
    """Options of an evaluation."""

    run: str = "???"
    """Run folder (its best checkpoint is played), checkpoint, ONNX file or zoo; must be given."""
    episodes: int = 100
    """Agent episodes to play; matches, when there is an opponent."""
    opponent: Optional[str] = None
    """Play matches, both sides in turn, against random, zoo, a run folder, checkpoint or ONNX file."""
    deterministic: bool = False
    """Take the most likely action instead of a sampled one."""
    seed: int = 0
    """Seed of the environment and the sampling."""
    env: Optional[str] = None
    """Environment to play in, a preset in conf/env; null: that of the run."""

    def __post_init__(self) -> None:
        not_empty(run=self.run, opponent=self.opponent, env=self.env)
        at_least("episodes", self.episodes, 1)
        if self.opponent is not None and self.episodes < 2:
            raise ConfigError(
                f"episodes={self.episodes} must be >= 2 with an opponent: half of the matches are played as "
                "each side"
            )
        within("seed", self.seed, 0, 2**31 - 1)


@dataclass
class LeagueConfig:
    """Options of a league."""

    policies: list[str] = field(default_factory=list)
    """Who plays: random, zoo, run folders (best checkpoints), checkpoints, ONNX files; before options."""
    env: Optional[str] = None
    """Environment, a preset in conf/env; null: that of the first run. env.NAME=... sets its options."""
    matches: int = 100
    """Matches of each pair, half of them with the sides swapped."""
    out: Optional[str] = None
    """Folder for the results, new or that of the same league, which goes on; null: outputs/league."""
    deterministic: bool = False
    """Take the most likely action instead of a sampled one."""
    seed: int = 0
    """Seed of the environments and the sampling."""
    workers: Optional[int] = None
    """Processes that play side by side, a pair each; null: one for each core. Results do not depend on it."""

    def __post_init__(self) -> None:
        if len(self.policies) < 2:
            raise ConfigError(
                f"a league needs two policies or more, and has {', '.join(self.policies) or 'none'}: name "
                "them before the options, mappo-league RUN_A RUN_B random env=SoccerTwos"
            )
        if "" in self.policies:
            raise ConfigError("a policy is empty: give random, a run folder, a checkpoint or an ONNX file")
        not_empty(env=self.env, out=self.out)
        at_least("matches", self.matches, 2)
        within("seed", self.seed, 0, 2**31 - 1)
        at_least("workers", self.workers, 1)


@dataclass
class PlayConfig:
    """Options of a video."""

    run: Optional[str] = None
    """Run folder (its best checkpoint is played), checkpoint or ONNX file; null: env is played by policy."""
    env: Optional[str] = None
    """Environment to play in, a preset in conf/env; null: that of the run."""
    policy: Optional[str] = None
    """With env: zoo (trained policies that the package brings), an ONNX file, or a folder with NAME.onnx for
    each behavior; null: random actions."""
    video: Optional[str] = None
    """File to write, NAME.mp4 or NAME.gif; null: a window on the display, or with record nothing."""
    record: Optional[str] = None
    """New demonstration to write, NAME.demo, or a folder for the NAME.demo of each of several behaviors."""
    seconds: float = 20.0
    """Length of the video or recording, at the scene's own pace."""
    caption: bool = True
    """Write a line into the picture: scene, time, return of the episode so far (in soccer: goals)."""
    deterministic: bool = False
    """Take the most likely action instead of a sampled one."""
    seed: int = 0
    """Seed of the environment and the sampling."""
    width: int = 960
    """Width of the picture in pixels, even."""
    height: int = 544
    """Height of the picture in pixels, even."""

    def __post_init__(self) -> None:
        not_empty(run=self.run, env=self.env, policy=self.policy, video=self.video, record=self.record)
        above("seconds", self.seconds, 0)
        at_most("seconds", self.seconds, 1e6)
        within("seed", self.seed, 0, 2**31 - 1)

        for option, size in (("width", self.width), ("height", self.height)):
            rule(option, size, 64 <= size <= 4096 and size % 2 == 0, "must be even and from 64 to 4096")

        if self.run is None and self.env is None:
            raise ConfigError(
                "neither run nor env is given: run=FOLDER plays what was trained there, env=NAME random "
                "actions, env=NAME policy=FILE.onnx an ONNX file"
            )

        if self.run is not None and self.policy is not None:
            raise ConfigError(f"run={self.run} and policy={self.policy} both say who plays: give one of them")


@dataclass
class ExportConfig:
    """Options of an export."""

    run: str = "???"
    """Run folder (its best checkpoint is exported) or checkpoint file; must be given."""
    out: Optional[str] = None
    """File (NAME.onnx) or folder to write; null: beside the checkpoint, under its name."""
    card: bool = True
    """Write a model card beside each file, NAME.md."""
    episodes: Optional[int] = None
    """Episodes to play for the score in the card; with two sides matches against random; null: none."""
    video: bool = False
    """Film the policy for the card, NAME.mp4, in an embedded scene; extra [video]."""

    def __post_init__(self) -> None:
        not_empty(run=self.run)
        if self.out == "":
            raise ConfigError("out= is empty: it must name a file or a folder (null: beside the checkpoint)")
        at_least("episodes", self.episodes, 1)
        if not self.card and (self.episodes is not None or self.video):
            raise ConfigError("episodes and video=true are for the card, which card=false takes away")


@dataclass
class PushConfig:
    """Options of an upload."""

    what: str = "???"
    """Run folder or checkpoint (exported first), ONNX file or a folder of them; before the options."""
    repo: str = "???"
    """Repository on the hub, user/name; made if it is not there."""
    private: bool = False
    """Make the repository private, if it is made; one that is there stays as it is."""
    message: str = "Upload policies of mappo-unity"
    """Message of the commit."""

    def __post_init__(self) -> None:
        not_empty(what=self.what, repo=self.repo, message=self.message)


@dataclass
class PullConfig:
    """Options of a download."""

    repo: str = "???"
    """Repository on the hub, user/name; before the options."""
    out: Optional[str] = None
    """New or empty folder to write; null: one with the name of the repository, here."""
    revision: Optional[str] = None
    """Branch, tag or commit; null: the newest of the main branch."""

    def __post_init__(self) -> None:
        not_empty(repo=self.repo, out=self.out, revision=self.revision)
