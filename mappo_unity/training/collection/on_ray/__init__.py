"""Workers as actors of Ray, on one machine or several; imported for `collect.engine=ray` alone."""
