"""Times of our matchers and of other libraries."""
