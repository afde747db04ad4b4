"""Whether a video can be drawn and written, or a window be opened, here: checked before torch is loaded."""

from __future__ import annotations

from pathlib import Path

from mappo_unity.config.schema import PlayConfig
from mappo_unity.scenes.mujoco_check import check_mujoco


def check_screen(cfg: PlayConfig) -> None:
    """Raise ConfigError if the video cannot be written or drawn, or no window can be opened."""
    check_mujoco()

    if cfg.video is None and cfg.record is not None:
        return  # it is recorded, and not shown
    if cfg.video is None:
        from mappo_unity.viewing.window import check_display

        return check_display()
    from mappo_unity.viewing.render import check_opengl
    from mappo_unity.viewing.video import check_video

    check_video(Path(cfg.video))
    check_opengl()
