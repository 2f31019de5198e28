"""Live matching: sources of frames, an engine that matches the newest one, and a local page that shows it."""
