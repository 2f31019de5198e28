"""What several rooms use: progress, folders, sizes, versions."""
