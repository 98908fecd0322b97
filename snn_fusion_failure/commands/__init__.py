"""The commands that a user types: `sff NAME`, or `python scripts/NAME.py` in a checkout."""
