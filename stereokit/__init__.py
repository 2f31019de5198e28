"""Placeholder while the stages are written."""
