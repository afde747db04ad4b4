"""The scene SoccerTwos and StrikersVsGoalie: `scene` plays it, `drawing` says how it looks."""
