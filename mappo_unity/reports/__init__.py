"""Runs shown to people: curves over seeds, pictures, pages of HTML, a page that follows a training run."""
