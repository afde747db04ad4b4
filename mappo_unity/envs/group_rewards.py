"""What departed members earn of the group rewards that reach their team.

Unity adds a group reward to every member at once; a member reports what came since its own last report. Two
members that report at different times tell of the same reward twice: so a team's sum is kept, and how much of
it each member's reports have covered.
"""

from __future__ import annotations

import numpy as np


class GroupRewards:
    """Group rewards of teams of A slots.

    Args:
        num_teams, team_size: G and A.
    """

    ARRAYS = ("team_total", "seen")

    def __init__(self, num_teams: int, team_size: int) -> None:
        self.team_size = team_size
        self.team_total = np.zeros(num_teams)  # paid to the team in its episode, as far as is known
        self.seen = np.zeros(num_teams * team_size)  # of that, what a slot's reports have covered
        self._even = True  # no member lags behind its team; False where that is not known

    def changes_nothing(self, reward: np.ndarray) -> bool:
        """Whether these reports say nothing: mostly nobody earns anything, and nobody lags behind."""
        return self._even and not np.count_nonzero(reward)

    def report(
        self, slots: np.ndarray, reward: np.ndarray, known: np.ndarray, playing: np.ndarray
    ) -> np.ndarray:
        """Take in what members report in one result.

        Args:
            slots: int64 ``[n]``; reward: float32 ``[n]``, since their last reports.
            known: bool ``[n]``, False for members that join with this report. Where others of their
                team report too, it is those that tell what the team earned.
            playing: bool ``[N]``, slots that will report again.

        Returns:
            float64 ``[G]``, what each team earned beyond what was known of it.
        """
        teams = slots // self.team_size
        new = self.seen[slots] + reward
        before, total = self.team_total, self.team_total.copy()
        # of several the last one counts, and `known` ones are the last
        total[teams[~known]] = new[~known]
        total[teams[known]] = new[known]

        self.team_total = total
        self.seen[slots] = total[teams]
        lags = self.seen != np.repeat(total, self.team_size)
        self._even = not np.count_nonzero(lags & playing)
        return total - before

    def join(self, slots: np.ndarray) -> None:
        """Let members begin with what their teams have."""
        self.seen[slots] = self.team_total[slots // self.team_size]

    def end(self, teams: np.ndarray) -> None:
        """Begin anew with teams, bool ``[G]``, whose episode has ended."""
        self.team_total[teams] = 0
        self.seen[np.repeat(teams, self.team_size)] = 0

    def forget(self) -> None:
        """Begin anew with all teams."""
        self.end(np.ones(len(self.team_total), bool))
        self._even = True

    def get_state(self) -> dict[str, np.ndarray]:
        """Return the arrays by name."""
        return {name: getattr(self, name).copy() for name in self.ARRAYS}

    def set_state(self, state: dict) -> None:
        """Go back to arrays that `get_state` returned, among others; older snapshots have none."""
        self.forget()
        for name in self.ARRAYS:
            if name in state:
                setattr(self, name, np.array(state[name], np.float64))
        self._even = False
