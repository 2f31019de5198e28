"""Batches of pairs: search, matching, storage, resumption."""
