"""Priors over the patterns of a board."""
