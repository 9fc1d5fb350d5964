"""How long behaviours last: laws of durations, and a prior that learns order and durations together."""
