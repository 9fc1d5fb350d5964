"""Planners of vectors with learned proposals, in simulators with continuous actions."""
