"""Leagues: policies that play one another on both sides, and the ratings that follow.

`words`: what the players are called. `checks`: what a league is, and what can be known before torch is
loaded. `play`: the matches, in processes side by side. `table`: the results, kept in a file. `ratings` and
`standings`: what they say. `report`, `picture` and `page`: what is written at the end. `growing`: the league
of a policy that still learns.
"""
