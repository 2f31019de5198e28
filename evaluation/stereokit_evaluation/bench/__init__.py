"""Times, beside those of other matchers."""
