"""Learners in processes of their own beside the run's, each of which learns from some of the teams."""
