"""Puzzles solved by policy-guided search: which prior needs how many expansions, and how long."""
