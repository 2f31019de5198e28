"""The commands of this package; each is a thin function."""
