"""Images on the way in: checks, grey, half size."""
