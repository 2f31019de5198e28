"""Many pairs: found, matched, stored, resumed."""
