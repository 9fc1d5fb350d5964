"""Planners of vectors: random shooting, iCEM and MPPI, each of which may sample from a prior."""

from neuroprior.planners.continuous.vector_planner import Memory, VectorDecision, VectorPlanner

__all__ = ["Memory", "VectorDecision", "VectorPlanner"]
