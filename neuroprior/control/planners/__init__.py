"""Planners of vectors."""
