"""What mappo-doctor is made of: the findings it collects, the look at a running player."""
