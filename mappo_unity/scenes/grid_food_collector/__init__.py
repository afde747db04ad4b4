"""The scene GridFoodCollector: `scene` plays it, `drawing` says how it looks."""
