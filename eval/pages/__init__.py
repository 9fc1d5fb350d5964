"""What the pages of results show, run again from the commands that they name."""
