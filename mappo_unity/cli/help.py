"""The text of --help, from the tables of options and choices.

Neither torch nor Hydra is imported, so that help comes at once.
"""

from __future__ import annotations

import shutil
import textwrap

from mappo_unity.config.option_table import Option, option_table, short_type, show_value
from mappo_unity.config.presets import all_groups, describe_choices

TRAIN_USAGE = """\
Train policies with MAPPO on an ML-Agents environment.

Usage:
  mappo-train [option=value ...]                train; the results are in outputs/<env>/<date>_<time>
  mappo-train -m [option=value,value ...]       sweep: one run for each combination
  mappo-train resume=RUN [option=value ...]     resume a run folder or a checkpoint
  mappo-train --config FILE [option=value ...]  with the options of a YAML file, such as a run's config.yaml
  mappo-train --completion bash|zsh|fish        print a script with which the shell completes what is typed
  mappo-train --help | --version

Examples:
  mappo-train env=3DBall seed=1
  mappo-train env=unity env.file_name=builds/Game
  mappo-train env=custom env.factory=package.module:function env.params.size=3
  mappo-train env=pettingzoo env.factory=mpe2.simple_spread_v3:parallel_env env.num_areas=32
  mappo-train -m env=3DBall seed=0,1,2 ppo.lr=1e-4,3e-4
  mappo-train -m env=3DBall recipe=none,mappo_paper,benchmarl
  mappo-train -m env=3DBall seed=0,1,2 hydra/launcher=joblib
  mappo-train resume=outputs/3DBall/2026-11-20_12-00-00 max_steps=2000000
"""

EVAL_USAGE = """\
Play episodes with a trained policy and print their statistics: a table, then one line of JSON.

Usage:
  mappo-eval run=RUN [option=value ...]     a run folder (its best checkpoint) or a checkpoint
  mappo-eval run=FILE.onnx [env=NAME ...]   an ONNX file, or a folder of them (NAME.onnx for each behavior)
  mappo-eval --help | --version

Examples:
  mappo-eval run=outputs/3DBall/2026-11-20_12-00-00 episodes=100 deterministic=true
  mappo-eval run=outputs/3DBall/2026-11-20_12-00-00 env.params.mass=10   environment parameters of its scene
  mappo-eval run=outputs/SoccerTwos/2026-11-20_12-00-00 opponent=random episodes=200
  mappo-eval run=zoo env=Basic          a trained policy that the package brings
"""

PLAY_USAGE = """\
Show a policy in its embedded scene: in a window, or in a video file, which needs no display. Or record
what it does as a demonstration, which ML-Agents reads, too.

Usage:
  mappo-play run=RUN [video=FILE]           a run folder (its best checkpoint) or a checkpoint
  mappo-play env=NAME [policy=ONNX]         random actions, an ONNX file or a folder of NAME.onnx
  mappo-play ... record=FILE.demo           a demonstration; with video=FILE also that, else nothing is shown
  mappo-play --help | --version

Examples:
  mappo-play run=outputs/3DBall/2026-11-20_12-00-00 video=3DBall.mp4
  mappo-play env=SoccerTwos policy=SoccerTwos.onnx video=match.gif seconds=8 width=480 height=272
  mappo-play env=PushBlock policy=zoo video=push.gif                a trained policy that the package brings
  mappo-play run=outputs/3DBall/2026-11-20_12-00-00 record=expert.demo seconds=300
"""

EXPORT_USAGE = """\
Write a trained policy as an ONNX file, which Unity loads: one file for each behavior name.

Usage:
  mappo-export run=RUN [out=PATH]           a run folder (its best checkpoint) or a checkpoint
  mappo-export --help | --version

Examples:
  mappo-export run=outputs/3DBall/2026-11-20_12-00-00 out=3DBall.onnx
  mappo-export run=outputs/WallJump/2026-11-20_12-00-00 out=exported episodes=100    a file a behavior
"""

LEAGUE_USAGE = """\
Let policies play one another, each pair on both sides, and rate them: Bradley-Terry ratings on the Elo scale
with 95 % intervals. The folder gets matches.csv, league.csv, league.svg and league.html.

Usage:
  mappo-league POLICY POLICY ... [option=value ...]   random, run folders, checkpoints and ONNX files
  mappo-league --help | --version

Examples:
  mappo-league outputs/SoccerTwos/2026-11-20_12-00-00 SoccerTwos.onnx random matches=200 out=leagues/soccer
  mappo-league A.onnx B.onnx random env=SoccerTwos env.num_areas=8 seed=1
  mappo-league A.onnx B.onnx env=unity env.file_name=builds/Game      in a player, started for each pair
"""

PLOT_USAGE = """\
Draw curves of runs as a picture: the mean over seeds and its standard deviation. Runs that differ only in
their seed are one line; the legend names the options in which lines differ. Needs the extra [plot].

Usage:
  mappo-plot RUN ... [option=value ...]     run folders, sweep folders, folders of runs
  mappo-plot --help | --version

Examples:
  mappo-plot outputs/multirun/3DBall/2026-11-20_12-00-00
  mappo-plot outputs/learn x=time metric=return_mean,entropy out=learn.svg
"""

REPORT_USAGE = """\
Write one page of HTML about runs: outcome, curves to hover and zoom, options, timing, versions, videos.
It holds everything and loads nothing; any browser shows it.

Usage:
  mappo-report RUN ... [out=FILE.html]      a run folder, a sweep folder, a folder of runs
  mappo-report --help | --version

Examples:
  mappo-report outputs/3DBall/2026-11-20_12-00-00
  mappo-report outputs/multirun/3DBall/2026-11-20_12-00-00 out=sweep.html
  mappo-train env=3DBall log.dashboard=true    the same page of a run while it trains
"""


HUB_USAGE = """\
Bring trained policies to the Hugging Face hub with their cards, and from there. Extra [hub]; the token comes
from HF_TOKEN or from `hf auth login`.

Usage:
  mappo-hub push WHAT repo=user/name [option=value ...]   a run (exported first), an ONNX file or a folder
  mappo-hub pull user/name [option=value ...]             into a folder, which mappo-eval and mappo-play play
  mappo-hub --help | --version

Examples:
  mappo-hub push outputs/3DBall/2026-11-20_12-00-00 repo=user/3DBall
  mappo-hub push exported repo=user/WallJump private=true
  mappo-hub pull user/3DBall out=policies/3DBall
"""


SEARCH_USAGE = """\
Look for good options: trials in several processes, chosen by Optuna (extra [search]), each an ordinary run.
The same call goes on with the search in its folder; trials=N with a larger N adds to it.

Usage:
  mappo-search search=SPACE [option=value ...]   its own options, and any of mappo-train for all trials
  mappo-search --help | --version

Examples:
  mappo-search search=ppo env=PushBlock trials=40 seeds=2 out=searches/push
  mappo-search search=3DBall env=3DBall max_steps=250_000 goal=95 trials=20 workers=2 out=searches/ball
  mappo-search search=my_space.yaml --config my.yaml trials=100
"""


def train_help(schema: type) -> str:
    """Return the help of mappo-train: usage, choices, options."""
    choices = [_group_text(group) for group in all_groups()]
    return "\n".join([TRAIN_USAGE, "Choices (presets in conf/):", *choices, "", option_text(schema)])


def eval_help(schema: type) -> str:
    """Return the help of mappo-eval: usage, options."""
    return f"{EVAL_USAGE}\n{option_text(schema)}"


def play_help(schema: type) -> str:
    """Return the help of mappo-play: usage, options."""
    return f"{PLAY_USAGE}\n{option_text(schema)}"


def export_help(schema: type) -> str:
    """Return the help of mappo-export: usage, options."""
    return f"{EXPORT_USAGE}\n{option_text(schema)}"


def league_help(schema: type) -> str:
    """Return the help of mappo-league: usage, options."""
    return f"{LEAGUE_USAGE}\n{option_text(schema)}"


def plot_help(schema: type) -> str:
    """Return the help of mappo-plot: usage, options."""
    return f"{PLOT_USAGE}\n{option_text(schema)}"


def report_help(schema: type) -> str:
    """Return the help of mappo-report: usage, options."""
    return f"{REPORT_USAGE}\n{option_text(schema)}"


def hub_help(push: type, pull: type) -> str:
    """Return the help of mappo-hub: usage, options of push and of pull."""
    return f"{HUB_USAGE}\nmappo-hub push\n{option_text(push)}\n\nmappo-hub pull\n{option_text(pull)}"


def search_help(schema: type) -> str:
    """Return the help of mappo-search: usage, spaces, options."""
    return "\n".join([SEARCH_USAGE, "Spaces (conf/search/):", _group_text("search"), "", option_text(schema)])


def option_text(schema: type) -> str:
    """Return every option of a dataclass with type, default and description, section by section."""
    table = option_table(schema)
    lines = ["Options (name: type = default):"]

    # what stands in no section comes first
    sections = [option for option in table.values() if option.is_section]
    lines += [
        _option_text(option) for key, option in table.items() if "." not in key and option not in sections
    ]

    for section in sections:
        inside = [option for option in table.values() if option.key.rpartition(".")[0] == section.key]
        lines += ["", f"{section.key}.*  {section.description}"]
        lines += [_option_text(option) for option in inside if not option.is_section]

    return "\n".join(lines)


def _option_text(option: Option) -> str:
    head = f"  {option.key}: {short_type(option.type)}"
    default = show_value(option.default)

    # ??? marks what must be given, and has no default
    if default != "???":
        head += f" = {default}"

    return f"{head}\n{_wrap(option.description, 6)}"


def _group_text(group: str) -> str:
    about = describe_choices(group)
    lines = [f"  {group}={'|'.join(about)}"]
    lines += [_wrap(f"{name}: {text}", 6) for name, text in about.items() if text]
    return "\n".join(lines)


def _wrap(text: str, indent: int) -> str:
    width = min(shutil.get_terminal_size((100, 24)).columns, 110)
    margin = " " * indent
    return textwrap.fill(
        text, max(width, 40), initial_indent=margin, subsequent_indent=margin, break_on_hyphens=False
    )
