"""Training of refiners on data sets and synthetic streets."""
