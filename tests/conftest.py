"""Examples that hypothesis draws are the same in every run, so that a test finds an error always or never."""

from hypothesis import settings

settings.register_profile("same", derandomize=True, database=None)
settings.load_profile("same")
