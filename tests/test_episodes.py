"""Figures of finished episodes."""

import numpy as np
import pytest

from mappo_unity.envs.rounds import Episode
from mappo_unity.policies.episodes import standard_error, summarize


def test_episodes_of_agents_alone_have_the_textbook_s_standard_error():
    figures = summarize([Episode(0, value, 0.0, 10, False) for value in (1.0, 2.0, 3.0, 6.0)])
    assert figures["mean_return"] == 3.0
    assert figures["stderr"] == pytest.approx(np.sqrt(3.5) / 2)


def test_team_mates_are_not_counted_twice():
    values = np.random.default_rng(1).normal(size=8_000)
    twice = np.repeat(values, 2)
    figures = summarize([Episode(i, 0.0, value, 10, False, 1) for i, value in enumerate(twice)])
    assert figures["stderr"] == pytest.approx(standard_error(values, teams=True), rel=1e-6)
    assert figures["stderr"] == pytest.approx(1 / np.sqrt(8_000), rel=0.35)  # from 40 batches
