"""Common parts of several packages: progress, folders, sizes, versions."""
