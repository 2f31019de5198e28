"""``python -m stereokit.cli``."""

from stereokit.cli.app import main

if __name__ == "__main__":
    main()
