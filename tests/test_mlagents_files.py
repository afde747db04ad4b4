"""What mappo-learn reads beside plain files: anchors, values that follow from others, files of its own."""

import pytest

from mappo_unity.config.mlagents.flags import parse_flags
from mappo_unity.config.mlagents.read import read_settings
from mappo_unity.errors import ConfigError


def settings_of(tmp_path, text, *flags):
    path = tmp_path / "my.yaml"
    path.write_text(text)
    return read_settings(parse_flags([str(path), *flags]))


# --- anchors


def test_an_anchor_with_a_merge_key_may_be_used_again(tmp_path):
    text = "behaviors: {A: &a {max_steps: 5}, B: &b {<<: *a, max_steps: 6}, C: *b, D: {<<: *b, max_steps: 7}}"
    settings = settings_of(tmp_path, text)
    assert [section["max_steps"] for section in settings.behaviors.values()] == [5, 6, 6, 7]

    # the anchor's own place is within a merge
    text = "behaviors: {A: &a {max_steps: 5}, B: {<<: &b {<<: *a, max_steps: 6}}, C: *b}"
    settings = settings_of(tmp_path, text)
    assert [section["max_steps"] for section in settings.behaviors.values()] == [5, 6, 6]


def test_what_is_given_twice_below_an_anchor_is_told(tmp_path):
    text = "behaviors:\n  A: &a {max_steps: 5, max_steps: 6}\n  B: *a\n"
    with pytest.raises(ConfigError, match="line 2: max_steps is given twice, first in line 2"):
        settings_of(tmp_path, text)
