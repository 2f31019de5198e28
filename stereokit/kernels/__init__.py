"""What the compiled stages share: compiler flags and vector types."""
