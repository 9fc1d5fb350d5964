"""Statistics of executed plans: how actions follow each other, how far back that reaches, and where it changes."""

__all__: list[str] = []
