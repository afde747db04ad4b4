"""mappo-hub: bring policies to the Hugging Face hub, and from there."""

from __future__ import annotations

import tempfile
from pathlib import Path

from mappo_unity.config.overrides import shell_argument
from mappo_unity.config.schema import ExportConfig, PullConfig, PushConfig
from mappo_unity.config.text_lines import quoted_path
from mappo_unity.errors import ConfigError
from mappo_unity.signals import interrupts_end


def help_text() -> str:
    """Return the text of --help."""
    from mappo_unity.cli.help import hub_help

    return hub_help(PushConfig, PullConfig)


def run(lines: list[str]) -> int:
    """Push or pull; return the exit code."""
    action, *rest = lines or [""]
    if action == "push":
        return _push(_named(rest, "what"))
    if action == "pull":
        return _pull(_named(rest, "repo"))
    raise ConfigError(
        f"{action!r} is nothing that mappo-hub does: mappo-hub push RUN repo=user/name, or mappo-hub pull "
        "user/name"
    )


def _push(lines: list[str]) -> int:
    with interrupts_end("mappo-hub"):
        from mappo_unity.config.compose import compose_plain
        from mappo_unity.policies.first_checks import check_export
        from mappo_unity.policies.policy_files import Kind, locate
        from mappo_unity.sharing.hub import check_login, check_repo, push

        wanted = "a run folder, a checkpoint (.pt), an ONNX file or a folder of them"
        options = compose_plain(lines, PushConfig)
        check_repo(options.repo)
        source = locate(options.what, "what", wanted)
        if source.kind is Kind.random:
            raise ConfigError(f"what={options.what} has nothing to upload: give {wanted}")
        is_trained = source.kind in (Kind.run, Kind.checkpoint)
        if is_trained:
            check_export(ExportConfig(run=options.what))
        check_login()

        # torch comes only now: mistakes in the options are told at once
        from mappo_unity.sharing.upload import upload_of

    with tempfile.TemporaryDirectory(prefix="mappo-hub-") as folder:
        path = _export(Path(options.what), Path(folder)) if is_trained else source.path
        pushed = push(upload_of(path), options.repo, options.private, options.message)

    print(f"{options.repo}: {', '.join(pushed.files)}")
    print(pushed.url)
    return 0


def _export(run: Path, folder: Path) -> Path:
    """Export a run with its cards; return the folder."""
    from mappo_unity.policies.export import export_checkpoint
    from mappo_unity.policies.policy_files import choose_checkpoint
    from mappo_unity.sharing.beside import write_cards

    checkpoint = choose_checkpoint(run, "what")
    list(write_cards(checkpoint, export_checkpoint(checkpoint, folder), episodes=None, video=False))
    return folder


def _pull(lines: list[str]) -> int:
    with interrupts_end("mappo-hub"):
        from mappo_unity.config.compose import compose_plain
        from mappo_unity.sharing.hub import check_repo, pull

        options = compose_plain(lines, PullConfig)
        check_repo(options.repo)
        out = Path(options.out or options.repo.split("/")[1])

    for path in pull(options.repo, out, options.revision):
        print(path)
    print(f"play it: mappo-eval {shell_argument('run', out)} env=NAME")
    return 0


def _named(lines: list[str], option: str) -> list[str]:
    """Return the lines with a word before the options as that option."""
    if lines and not lines[0].startswith("-") and ("=" not in lines[0] or Path(lines[0]).exists()):
        return [f"{option}={quoted_path(lines[0])}", *lines[1:]]
    return lines
