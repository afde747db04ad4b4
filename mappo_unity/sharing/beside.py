"""The files beside exported ONNX files: a card for each, and a film for all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from mappo_unity.config.schema import EvalConfig, ExportConfig, PlayConfig
from mappo_unity.errors import ConfigError
from mappo_unity.policies.export import Exported
from mappo_unity.policies.first_checks import check_evaluation, check_film
from mappo_unity.runs.atomic import write_atomically
from mappo_unity.sharing.card import card_text, is_ours
from mappo_unity.sharing.facts import Trained, gather, make_film
from mappo_unity.viewing.video import check_video

CARD, FILM = ".md", ".mp4"


def check_card(options: ExportConfig, checkpoint: Path) -> None:
    """Raise ConfigError if what a card needs cannot be played, before anything is written."""
    if options.episodes is None and not options.video:
        return

    trained = Trained.read(checkpoint)
    if options.episodes is not None:
        check_evaluation(EvalConfig(run=str(checkpoint), env=trained.env, episodes=options.episodes))
    if options.video:
        check_film(PlayConfig(run=str(checkpoint), env=trained.env))

        # The folder that the file comes into, or the nearest above it that is there.
        wanted = Path(options.out or checkpoint).absolute()
        folder = next(place for place in (wanted, *wanted.parents) if place.is_dir())
        check_video(folder / f"{checkpoint.stem}{FILM}", caption=True)


def write_cards(
    checkpoint: Path, exported: Sequence[Exported], episodes: int | None, video: bool
) -> Iterator[str]:
    """Write the card of each file, and the film; yield a line for each.

    A text that lies there and is no card of ours stays as it is.

    Raises:
        ConfigError: a file cannot be written, or the policy does not play.
    """
    trained = Trained.read(checkpoint)
    film = _film_path(trained, exported) if video else None
    if film is not None:
        make_film(trained, film)
        yield f"{film}: the film"

    facts = gather(trained, {file.policy: file.path for file in exported}, episodes, film)
    for file, known in zip(exported, facts):
        path = file.path.with_suffix(CARD)
        if path.exists() and not is_ours(_text(path)):
            yield f"{path} is no card of mappo-export, and stays as it is; without it a card is written there"
            continue
        write(path, card_text(known).encode())
        yield f"{path}: the card"


def write(path: Path, data: bytes) -> None:
    """Write a file whole or not at all; raise ConfigError, which names it."""
    try:
        write_atomically(path, data)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror or error}") from error


def _film_path(trained: Trained, exported: Sequence[Exported]) -> Path:
    """Return where the film goes: beside a single file under its name, else under the environment's."""
    first = exported[0].path
    if len(exported) == 1:
        return first.with_suffix(FILM)
    return first.with_name(f"{trained.state['env_name']}{FILM}")


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:  # a folder, say: nothing of ours
        return ""
