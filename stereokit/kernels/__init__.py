"""Foundations of the compiled stages: compiler flags, vectors, threads, buffers, spans of time."""
