"""Priors over vectors."""
