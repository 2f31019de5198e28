"""An interpreter of PTX: launches run on the CPU, and every access is checked."""
