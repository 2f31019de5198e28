"""What training needs of the data."""
