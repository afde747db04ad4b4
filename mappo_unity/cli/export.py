"""mappo-export: write a trained policy as ONNX files, with a card beside each."""

from __future__ import annotations

from pathlib import Path

from mappo_unity.config.schema import ExportConfig
from mappo_unity.signals import interrupts_end


def help_text() -> str:
    """Return the text of --help."""
    from mappo_unity.cli.help import export_help

    return export_help(ExportConfig)


def run(lines: list[str]) -> int:
    """Export the policy; return the exit code."""
    with interrupts_end("mappo-export"):
        from mappo_unity.config.compose import compose_plain
        from mappo_unity.policies.first_checks import check_export
        from mappo_unity.policies.policy_files import choose_checkpoint

        options = compose_plain(lines, ExportConfig)
        check_export(options)

        # torch comes only now: mistakes in the options are told at once
        from mappo_unity.policies.export import export_checkpoint
        from mappo_unity.sharing.beside import check_card, write_cards

        checkpoint = choose_checkpoint(Path(options.run))
        check_card(options, checkpoint)

    written = export_checkpoint(checkpoint, Path(options.out) if options.out else None)
    for file in written:
        print(
            f"{file.path}: {file.policy} after {file.agent_steps:,} agent steps; plays as {checkpoint} does "
            f"(on {file.rows} observations: actions to {file.error:.1e}, samples in distribution)"
        )

    if options.card:
        for line in write_cards(checkpoint, written, options.episodes, options.video):
            print(line)

    return 0
