"""The program that compares priors: `python -m eval`."""
