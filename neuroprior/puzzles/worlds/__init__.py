"""Sokoban and sliding tiles."""
