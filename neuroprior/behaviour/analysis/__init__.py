"""Statistics of sequences: how behaviours follow each other, how far back that reaches, what changes it."""
