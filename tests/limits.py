"""How long tests wait for what may hang."""

HANG_S = 900
"""Seconds after which another process is taken to hang: far beyond what any processor needs. Nothing else is timed."""
