"""Generated calls and mutated files: nothing but right values and stereokit's own errors may come back.

``make fuzz`` runs both for ten minutes; ``python -m fuzz --help`` in ``tests/`` has the options. Each case follows from
the seed and its number alone, and every finding is printed with the command that repeats it.
"""
