"""Cost aggregation: each sweeps over the rows that a cost produces."""

__all__: list[str] = []
