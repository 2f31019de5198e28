"""Error measures, and the runs that take them."""
