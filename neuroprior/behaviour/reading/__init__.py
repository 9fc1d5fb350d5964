"""Reads recordings from the files of laboratories; imports no torch."""

from neuroprior.behaviour.reading.columns import Columns
from neuroprior.behaviour.reading.options import Options
from neuroprior.behaviour.reading.problems import ReadingError
from neuroprior.behaviour.reading.read import read

__all__ = ["Columns", "Options", "ReadingError", "read"]
