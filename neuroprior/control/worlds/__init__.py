"""Worlds whose actions are vectors."""
