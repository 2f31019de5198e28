"""The paper's study: configurations, runs, tables."""
